"""One request's way through the house: the only file that names the stages in order."""

from __future__ import annotations

import collections.abc
import time
import uuid
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cow_service import __version__
from cow_service.errors import Canceled, CowError, InvalidRequest, MllmUnavailable, ReaderUnavailable
from cow_service.generators.base import Generator, Shot
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import DecodedImage, decode_own, encode_png
from cow_service.media.overlay import draw_overlay
from cow_service.readers.base import Reader
from cow_service.readers.question.choices import read_choices
from cow_service.records import Answer, Artifact, Simulation
from cow_service.requests import AnswerRequest, SimulateRequest, Stage
from cow_service.stages import answering
from cow_service.stages.checks import check_frames, read_options
from cow_service.stages.generation import generate
from cow_service.stages.grounding import ground
from cow_service.stages.motion import read_motion
from cow_service.stages.reading import Eyes, place_of
from cow_service.stages.results import Answered, Checkpoints, Grounded, Moved, Rendered, Traced, digest_of, keep_nothing
from cow_service.stages.trajectory import compute_trajectory
from cow_service.stages.warnings import doubts
from cow_service.vision.obstacles import obstacles_of
from cow_service.vision.scene import Scene

Progress = Callable[[Stage, float], None]
StillWanted = Callable[[], None]


def ignore_progress(stage: Stage, done: float) -> None:
    """Nobody listens."""


def _at_once(still_wanted: StillWanted) -> AbstractContextManager[None]:
    return nullcontext()


@dataclass(frozen=True)
class Backends:
    """Who does the work of one request. Each backend is made only when a stage needs it."""

    reader_name: str
    reader: Callable[[], Reader]
    generator: Callable[[], Generator]
    artifacts: ArtifactStore
    weights: Callable[[], str] = str  # what tells the generator's weights from others, where its own words do not
    elsewhere: Callable[[], AbstractContextManager[None]] = nullcontext  # around waits for a multimodal LLM
    rendering: Callable[[StillWanted], AbstractContextManager[None]] = _at_once  # around a clip: waits for its turn


def now() -> str:
    """RFC 3339, UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


@dataclass(frozen=True)
class Stamp:
    """What a result is called, and when it was asked for."""

    id: str = field(default_factory=lambda: str(uuid.uuid4()))
    created_at: str = field(default_factory=now)

    def inner(self) -> Stamp:
        """That of a simulation inside an answer: the same every time that the answer is made again."""
        return replace(self, id=str(uuid.uuid5(uuid.NAMESPACE_OID, self.id)))


@dataclass
class _Run:
    """One request on its way: seconds per stage, who wants to hear how far each is, and what was found again."""

    image: DecodedImage
    progress: Progress
    checkpoints: Checkpoints
    timings: dict[str, float] = field(default_factory=dict[str, float])
    reused: list[Stage] = field(default_factory=list[Stage])

    @contextmanager
    def stage(self, name: Stage) -> collections.abc.Generator[Callable[[float], None]]:
        """Times a stage and reports its start, its progress and its end."""
        started = time.perf_counter()
        self.progress(name, 0.0)
        yield lambda done: self.progress(name, min(done, 0.999))
        self.timings[name] = round(time.perf_counter() - started, 4)
        self.progress(name, 1.0)

    def kept(self, stage: Stage, inputs: Mapping[str, Any] | None, model: type[Any], compute: Callable[[], Any]) -> Any:
        """The stage's result, computed or found again."""
        known = None if inputs is None else {"version": __version__, "image": self.image.info.sha256, **inputs}
        result, reused = self.checkpoints(stage, known, model, compute)
        if reused:
            self.reused.append(stage)
        return result


def simulate(
    request: SimulateRequest,
    image: DecodedImage,
    backends: Backends,
    progress: Progress = ignore_progress,
    checkpoints: Checkpoints = keep_nothing,
    stamp: Stamp | None = None,
) -> Simulation:
    """Imagines the future of an image. `progress` hears each stage's name with 0 at its start and 1 at its end.

    What it raises ends the work. `checkpoints` may keep each stage's result and give it back.
    Raises the errors of its stages: `InvalidRequest`, `CannotGround`, `CannotReadDirection`, `GeneratorUnavailable`...
    """
    scene = Scene(image.pixels)
    run = _Run(image, progress, checkpoints)
    return _simulate(request, scene, _eyes(request, scene, backends, progress), backends, run, stamp or Stamp())


def answer(
    request: AnswerRequest,
    image: DecodedImage,
    backends: Backends,
    progress: Progress = ignore_progress,
    checkpoints: Checkpoints = keep_nothing,
    stamp: Stamp | None = None,
) -> Answer:
    """Imagines, unless the request says never, then answers. `progress` and `checkpoints` as in `simulate`.

    A simulation that fails does not lose the answer: it is then given from the image alone, with a warning. Raises
    `InvalidRequest`, `Canceled`, `MllmBadReply`, `MllmUnavailable`.
    """
    scene = Scene(image.pixels)
    run = _Run(image, progress, checkpoints)
    eyes = _eyes(request, scene, backends, progress)
    stamp = stamp or Stamp()
    options = read_choices(request.question, request.options)
    simulation, warnings = None, ()
    if request.imagine == "always":
        simulation, warnings = _imagined(request, scene, eyes, backends, run, stamp.inner())

    def ask() -> Answered:
        before = eyes.used
        look = eyes.look_for("answering")
        imagined = None if simulation is None else answering.frames_of(simulation, backends.artifacts)
        verdict, notes = answering.answer(look, options, imagined, request.votes)
        compared = None
        if request.baseline:
            compared = verdict if imagined is None else answering.baseline(look, options, request.votes)
        if isinstance(compared, CowError):
            notes = (f"There is no baseline: {compared.detail}", *notes)
            compared = None
        return Answered(verdict=verdict, baseline=compared, warnings=notes, reading=eyes.reading("answering", before))

    with run.stage("answering"):
        answered = run.kept("answering", _answering_inputs(request, eyes, simulation), Answered, ask)
        eyes.note("answering", answered.reading, reused="answering" in run.reused)
    return Answer(
        **dict(answered.verdict),
        id=stamp.id,
        created_at=stamp.created_at,
        question=request.question,
        options=options,
        image=image.info,
        simulation=simulation,
        baseline=answered.baseline,
        reader=eyes.info("grounding", "motion", "answering"),
        usage=eyes.usage,
        timings=run.timings,
        reused=tuple(run.reused),
        warnings=(*warnings, *answered.warnings),
    )


def _eyes(request: SimulateRequest, scene: Scene, backends: Backends, progress: Progress) -> Eyes:
    return Eyes(
        request, scene, backends.reader_name, backends.reader, lambda stage: progress(stage, 0.0), backends.elsewhere
    )


def _imagined(
    request: AnswerRequest, scene: Scene, eyes: Eyes, backends: Backends, run: _Run, stamp: Stamp
) -> tuple[Simulation | None, tuple[str, ...]]:
    """The simulation, or none and a warning that says why. Raises what is wrong with the request itself."""
    try:
        return _simulate(request, scene, eyes, backends, run, stamp), ()
    except (InvalidRequest, Canceled, MllmUnavailable, ReaderUnavailable):
        raise  # without the reader there is no answer either
    except CowError as error:
        return None, (f"Nothing was imagined, the answer is from the image alone. {error.code}: {error.detail}",)


def _simulate(
    request: SimulateRequest, scene: Scene, eyes: Eyes, backends: Backends, run: _Run, stamp: Stamp
) -> Simulation:
    generator = backends.generator()
    options = read_options(generator, request.generator_options)
    check_frames(generator, request)
    place, path = place_of(request), request.trajectory

    def keep(pixels: NDArray[np.uint8] | NDArray[np.bool_]) -> Artifact:
        return backends.artifacts.put(encode_png(pixels), "image/png")

    def read_place() -> Grounded:
        before = eyes.used
        grounding, warnings = ground(scene, place, partial(eyes.look_for, "grounding"), keep)
        return Grounded(grounding=grounding, warnings=warnings, reading=eyes.reading("grounding", before))

    with run.stage("grounding"):
        inputs = _read_inputs(eyes, request.question) if place is None else {"place": place.model_dump(mode="json")}
        grounded = run.kept("grounding", inputs, Grounded, read_place)
        grounding = grounded.grounding
        eyes.note("grounding", grounded.reading, reused="grounding" in run.reused)
        eyes.recalled = grounding
        if (mask := grounding.mask) is not None:
            scene.recall(grounding.bbox, lambda: decode_own(backends.artifacts.read(mask.sha256))[..., 0] > 0)

    def read_way() -> Moved:
        before = eyes.used
        motion, warnings = read_motion(scene, grounding, request.motion, path, partial(eyes.look_for, "motion"))
        return Moved(motion=motion, warnings=warnings, reading=eyes.reading("motion", before))

    with run.stage("motion"):
        given = request.model_dump(mode="json", include={"motion", "trajectory"}, exclude_none=True)
        inputs = given if given else _read_inputs(eyes, request.question)
        inputs = None if inputs is None else {**inputs, "grounding": digest_of(grounding)}
        moved = run.kept("motion", inputs, Moved, read_way)
        motion = moved.motion
        eyes.note("motion", moved.reading, reused="motion" in run.reused)

    @cache
    def surroundings() -> Any:
        return obstacles_of(scene, grounding.bbox, grounding.others)

    def trace() -> Traced:
        obstacles = surroundings()
        trajectory = compute_trajectory(scene, grounding, motion, obstacles, path, request.num_frames, request.fps)
        return Traced(trajectory=trajectory, warnings=doubts(scene, request, grounding, obstacles))

    with run.stage("trajectory"):
        traced_from: dict[str, Any] = {
            "grounding": digest_of(grounding),
            "motion": digest_of(motion),
            "request": digest_of({**given, "place": None if place is None else place.model_dump(mode="json")}),
            "question": request.question,
            "clip": [request.num_frames, request.fps],
        }
        traced = run.kept("trajectory", traced_from, Traced, trace)
        trajectory = traced.trajectory
    # Who makes the clip does not hang on the surroundings, which are costly to find.
    shot = Shot(scene, grounding, motion, trajectory, (), request.seed, options)
    info = generator.describe(shot)

    def render(progressed: Callable[[float], None]) -> Rendered:
        full = replace(shot, obstacles=surroundings())
        with backends.rendering(lambda: progressed(0.0)):
            clip = generate(full, generator, request.frames, request.video, backends.artifacts, progressed)
        overlay = keep(draw_overlay(scene.image, grounding, motion, trajectory))
        return Rendered(frames=clip.frames, video=clip.video, overlay=overlay, generator=info)

    with run.stage("generation") as progressed:
        inputs = {
            **traced_from,
            "generator": info.model_dump(mode="json"),
            "weights": backends.weights(),
            "frames": request.frames.model_dump(mode="json"),
            "video": request.video,
        }
        rendered = run.kept("generation", inputs, Rendered, lambda: render(progressed))
    return Simulation(
        id=stamp.id,
        created_at=stamp.created_at,
        question=request.question,
        image=run.image.info,
        grounding=grounding,
        motion=motion,
        trajectory=trajectory,
        frames=rendered.frames,
        video=rendered.video,
        overlay=rendered.overlay,
        generator=rendered.generator,
        reader=eyes.info("grounding", "motion"),
        usage=eyes.usage,
        timings=dict(run.timings),
        reused=tuple(run.reused),
        warnings=(*grounded.warnings, *moved.warnings, *traced.warnings),
    )


def _read_inputs(eyes: Eyes, question: str) -> dict[str, Any] | None:
    """What decides a reading of the image."""
    reader = eyes.inputs()
    return None if reader is None else {**reader, "question": question}


def _answering_inputs(request: AnswerRequest, eyes: Eyes, simulation: Simulation | None) -> dict[str, Any] | None:
    inputs = _read_inputs(eyes, request.question)
    if inputs is None:
        return None
    seen = None
    if simulation is not None:
        records = simulation.model_dump(mode="json", include={"grounding", "motion", "trajectory", "frames"})
        seen = digest_of(records)
    asked = request.model_dump(mode="json", include={"options", "votes", "baseline", "imagine"})
    return {**inputs, **asked, "seen": seen, "recalled": None if eyes.recalled is None else digest_of(eyes.recalled)}
