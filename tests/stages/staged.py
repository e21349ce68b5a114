"""Stages one after the other, for tests of drawn scenes; and a generator that notes what it is given."""

from __future__ import annotations

from typing import Any

import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import CutoutGenerator
from cow_service.media.images import decode_own
from cow_service.media.types import Image
from cow_service.records import Clip, Trajectory
from cow_service.stages.generation import generate
from cow_service.stages.grounding import ground
from cow_service.stages.keys import StageResult
from cow_service.stages.motion import settle_motion
from cow_service.stages.run import Run
from cow_service.stages.trajectory import compute_trajectory

RED, BLUE, GREEN, YELLOW = (200, 30, 30), (40, 60, 200), (40, 160, 60), (210, 190, 40)


def computed(run: Run) -> StageResult[Trajectory]:
    """Stages 1 to 3, with the warnings of all."""
    grounded = ground(run)
    motion = settle_motion(run, grounded.value, grounded.motion)
    found = compute_trajectory(run, grounded.value, motion.value)
    warnings = (*grounded.warnings, *motion.warnings, *found.warnings)
    return StageResult(value=found.value, warnings=warnings)


def clip_of(run: Run) -> tuple[Trajectory, Clip]:
    """Stages 1 to 4."""
    grounding = ground(run).value
    motion = settle_motion(run, grounding, None).value
    told = compute_trajectory(run, grounding, motion).value
    return told, generate(run, grounding, motion, told).value


def pixels(run: Run, artifact: Any) -> Image:
    """The picture that a frame or an overlay names."""
    return decode_own(run.backends.artifacts.read(artifact.sha256))


class VideoModel(CutoutGenerator):
    """A generator on a device of its own, which notes what it is given."""

    concurrency = 1

    def __init__(self) -> None:
        self.given: list[GeneratorInput] = []

    def render(self, given: GeneratorInput, indices: Any, progress: Any) -> Any:
        self.given.append(given)
        return super().render(given, indices, progress)


def is_red(pixels: Any) -> Any:
    return pixels[..., 0].astype(int) > pixels[..., 2].astype(int) + 40


def is_green(pixels: Any) -> Any:
    return pixels[..., 1].astype(int) > np.maximum(pixels[..., 0], pixels[..., 2]).astype(int) + 25
