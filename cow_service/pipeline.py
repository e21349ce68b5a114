"""One request's way through the house: the only file that names the stages in order."""

from __future__ import annotations

import collections.abc
import time
import uuid
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache

import numpy as np
from numpy.typing import NDArray

from cow_service.artifacts import ArtifactStore
from cow_service.drawing import draw_overlay
from cow_service.generators.base import Generator, Shot
from cow_service.images import DecodedImage, encode_png
from cow_service.readers.base import Reader
from cow_service.records import Artifact, ReaderInfo, Simulation
from cow_service.requests import GroundingRequest, SimulateRequest, Stage
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
    """Who does the work of one request. The reader is made only when a stage needs it."""

    reader_name: str
    reader: Callable[[], Reader]
    generator: Generator
    artifacts: ArtifactStore


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


def simulate(
    request: SimulateRequest, image: DecodedImage, backends: Backends, progress: Progress = _silent
) -> Simulation:
    """Imagines the future of an image. `progress` hears each stage's name with 0 at its start and 1 at its end.

    Raises the errors of its stages: `InvalidRequest`, `CannotGround`, `CannotReadDirection`, `GeneratorUnavailable`...
    """
    options = read_options(backends.generator, request.generator_options)
    check_frames(backends.generator, request)
    scene = Scene(image.pixels)
    clock = _Clock(progress)
    used: list[Stage] = []

    def reader_for(stage: Stage) -> Callable[[], Reader]:
        @cache
        def reader() -> Reader:
            used.append(stage)
            return backends.reader()

        return reader

    def keep(pixels: NDArray[np.uint8] | NDArray[np.bool_]) -> Artifact:
        return backends.artifacts.put(encode_png(pixels), "image/png")

    with clock.stage("grounding"):
        grounding, unsure = ground(scene, request.question, _place(request), reader_for("grounding"), keep)
    with clock.stage("motion"):
        motion, warnings = read_motion(
            scene, request.question, grounding, request.motion, request.trajectory, reader_for("motion")
        )
    with clock.stage("trajectory"):
        obstacles = obstacles_of(scene, grounding.bbox, grounding.others)
        trajectory = compute_trajectory(
            scene, grounding, motion, obstacles, request.trajectory, request.num_frames, request.fps
        )
    shot = Shot(scene, grounding, motion, trajectory, obstacles, request.seed, options)
    with clock.stage("generation") as progressed:
        clip = generate(shot, backends.generator, request.frames, request.video, backends.artifacts, progressed)
        overlay = keep(draw_overlay(scene.image, grounding, motion, trajectory))
    return Simulation(
        id=str(uuid.uuid4()),
        created_at=datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"),
        question=request.question,
        image=image.info,
        grounding=grounding,
        motion=motion,
        trajectory=trajectory,
        frames=clip.frames,
        video=clip.video,
        overlay=overlay,
        generator=backends.generator.describe(shot),
        reader=_reader_info(backends, used),
        timings=clock.timings,
        warnings=(*unsure, *warnings, *doubts(scene, request, grounding, obstacles)),
    )


def _place(request: SimulateRequest) -> GroundingRequest | None:
    """Where the request says the object is. A given path begins on it, so that it grounds the object too."""
    if request.grounding is None and request.trajectory is not None:
        return GroundingRequest(point=request.trajectory.points[0])
    return request.grounding


def _reader_info(backends: Backends, used: list[Stage]) -> ReaderInfo:
    """Who read, and for which stages; a reader that no stage needed is named but was never made."""
    stages = tuple(stage for stage in ("grounding", "motion") if stage in used)
    if not stages:
        return ReaderInfo(name=backends.reader_name)
    return backends.reader().info.model_copy(update={"stages": stages})
