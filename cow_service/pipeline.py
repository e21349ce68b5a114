"""One request's way through the house: the only file that names the stages in order."""

from __future__ import annotations

import collections.abc
import time
import uuid
from collections.abc import Callable
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial

import numpy as np
from numpy.typing import NDArray

from cow_service.artifacts import ArtifactStore
from cow_service.drawing import draw_overlay
from cow_service.errors import Canceled, CowError, InvalidRequest, MllmUnavailable, ReaderUnavailable
from cow_service.generators.base import Generator, Shot
from cow_service.images import DecodedImage, encode_png
from cow_service.readers.base import Asked, Look, Reader
from cow_service.readers.choices import read_choices
from cow_service.records import Answer, Artifact, ReaderInfo, Simulation, Usage
from cow_service.requests import AnswerRequest, GroundingRequest, SimulateRequest, Stage
from cow_service.stages import answering
from cow_service.stages.doubts import doubts
from cow_service.stages.generation import generate
from cow_service.stages.grounding import ground
from cow_service.stages.motion import read_motion
from cow_service.stages.options import check_frames, read_options
from cow_service.stages.trajectory import compute_trajectory
from cow_service.vision.obstacles import obstacles_of
from cow_service.vision.scene import Scene

Progress = Callable[[Stage, float], None]


def _silent(stage: Stage, done: float) -> None:
    """Nobody listens."""


@dataclass(frozen=True)
class Backends:
    """Who does the work of one request. Each backend is made only when a stage needs it."""

    reader_name: str
    reader: Callable[[], Reader]
    generator: Callable[[], Generator]
    artifacts: ArtifactStore
    elsewhere: Callable[[], AbstractContextManager[None]] = nullcontext  # around waits for a multimodal LLM


@dataclass
class _Clock:
    """Seconds per stage, and whoever wants to hear how far each is."""

    progress: Progress
    timings: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: Stage) -> collections.abc.Generator[Callable[[float], None]]:
        """Times a stage and reports its start, its progress and its end."""
        started = time.perf_counter()
        self.progress(name, 0.0)
        yield lambda done: self.progress(name, min(done, 0.999))
        self.timings[name] = round(time.perf_counter() - started, 4)
        self.progress(name, 1.0)


@dataclass
class _Eyes:
    """The reader's look at the image of one request, begun when a stage first needs it; one for all stages."""

    request: SimulateRequest
    scene: Scene
    backends: Backends
    progress: Progress
    used: list[Stage] = field(default_factory=list[Stage])
    _look: Look | None = None

    def look_for(self, stage: Stage) -> Look:
        """The look, asked on behalf of a stage."""
        if stage not in self.used:
            self.used.append(stage)
        if self._look is None:
            asked = Asked(
                question=self.request.question,
                stages=_needed(self.request),
                seed=self.request.seed,
                still_wanted=lambda: self.progress(self.used[-1], 0.0),
                elsewhere=self.backends.elsewhere,
            )
            self._look = self.backends.reader().look(self.scene, asked)
        return self._look

    def info(self, *stages: Stage) -> ReaderInfo:
        """Who read, and for which of some stages; a reader that none of them needed is named but was never made."""
        if self._look is None:
            return ReaderInfo(name=self.backends.reader_name)
        return self._look.info.model_copy(update={"stages": tuple(stage for stage in stages if stage in self.used)})

    @property
    def usage(self) -> Usage:
        """What was asked of a multimodal LLM so far."""
        return Usage() if self._look is None else self._look.usage


def simulate(
    request: SimulateRequest, image: DecodedImage, backends: Backends, progress: Progress = _silent
) -> Simulation:
    """Imagines the future of an image. `progress` hears each stage's name with 0 at its start and 1 at its end.

    Raises the errors of its stages: `InvalidRequest`, `CannotGround`, `CannotReadDirection`, `GeneratorUnavailable`...
    """
    scene = Scene(image.pixels)
    clock = _Clock(progress)
    return _simulate(request, image, scene, _Eyes(request, scene, backends, progress), clock)


def answer(request: AnswerRequest, image: DecodedImage, backends: Backends, progress: Progress = _silent) -> Answer:
    """Imagines, unless the request says never, then answers. `progress` as in `simulate`.

    A simulation that fails does not lose the answer: it is then given from the image alone, with a warning. Raises
    `InvalidRequest`, `Canceled`, `MllmBadReply`, `MllmUnavailable`.
    """
    scene = Scene(image.pixels)
    clock = _Clock(progress)
    eyes = _Eyes(request, scene, backends, progress)
    options = read_choices(request.question, request.options)
    simulation, warnings = None, ()
    if request.imagine == "always":
        simulation, warnings = _imagined(request, image, scene, eyes, clock)
    with clock.stage("answering"):
        look = eyes.look_for("answering")
        imagined = None if simulation is None else answering.frames_of(simulation, backends.artifacts)
        verdict, notes = answering.answer(look, options, imagined, request.votes)
        compared = None
        if request.baseline:
            compared = verdict if imagined is None else answering.baseline(look, options, request.votes)
        if isinstance(compared, CowError):
            warnings = (*warnings, f"There is no baseline: {compared.detail}")
            compared = None
    return Answer(
        **dict(verdict),
        id=str(uuid.uuid4()),
        created_at=_now(),
        question=request.question,
        options=options,
        image=image.info,
        simulation=simulation,
        baseline=compared,
        reader=eyes.info("grounding", "motion", "answering"),
        usage=eyes.usage,
        timings=clock.timings,
        warnings=(*warnings, *notes),
    )


def _imagined(
    request: AnswerRequest, image: DecodedImage, scene: Scene, eyes: _Eyes, clock: _Clock
) -> tuple[Simulation | None, tuple[str, ...]]:
    """The simulation, or none and a warning that says why. Raises what is wrong with the request itself."""
    try:
        return _simulate(request, image, scene, eyes, clock), ()
    except (InvalidRequest, Canceled, MllmUnavailable, ReaderUnavailable):
        raise  # without the reader there is no answer either
    except CowError as error:
        return None, (f"Nothing was imagined, the answer is from the image alone. {error.code}: {error.detail}",)


def _simulate(request: SimulateRequest, image: DecodedImage, scene: Scene, eyes: _Eyes, clock: _Clock) -> Simulation:
    backends = eyes.backends
    generator = backends.generator()
    options = read_options(generator, request.generator_options)
    check_frames(generator, request)

    def keep(pixels: NDArray[np.uint8] | NDArray[np.bool_]) -> Artifact:
        return backends.artifacts.put(encode_png(pixels), "image/png")

    with clock.stage("grounding"):
        grounding, unsure = ground(scene, _place(request), partial(eyes.look_for, "grounding"), keep)
    with clock.stage("motion"):
        motion, warnings = read_motion(
            scene, grounding, request.motion, request.trajectory, partial(eyes.look_for, "motion")
        )
    with clock.stage("trajectory"):
        obstacles = obstacles_of(scene, grounding.bbox, grounding.others)
        trajectory = compute_trajectory(
            scene, grounding, motion, obstacles, request.trajectory, request.num_frames, request.fps
        )
    shot = Shot(scene, grounding, motion, trajectory, obstacles, request.seed, options)
    with clock.stage("generation") as progressed:
        clip = generate(shot, generator, request.frames, request.video, backends.artifacts, progressed)
        overlay = keep(draw_overlay(scene.image, grounding, motion, trajectory))
    return Simulation(
        id=str(uuid.uuid4()),
        created_at=_now(),
        question=request.question,
        image=image.info,
        grounding=grounding,
        motion=motion,
        trajectory=trajectory,
        frames=clip.frames,
        video=clip.video,
        overlay=overlay,
        generator=generator.describe(shot),
        reader=eyes.info("grounding", "motion"),
        usage=eyes.usage,
        timings=dict(clock.timings),
        warnings=(*unsure, *warnings, *doubts(scene, request, grounding, obstacles)),
    )


def _place(request: SimulateRequest) -> GroundingRequest | None:
    """Where the request says the object is. A given path begins on it, so that it grounds the object too."""
    if request.grounding is None and request.trajectory is not None:
        return GroundingRequest(point=request.trajectory.points[0])
    return request.grounding


def _needed(request: SimulateRequest) -> frozenset[str]:
    """The stages of a simulation that the request leaves to the reader."""
    needed = {"grounding"} if _place(request) is None else set[str]()
    return frozenset(needed if request.motion is not None or request.trajectory is not None else needed | {"motion"})


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
