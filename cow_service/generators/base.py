"""The door for whoever makes frames. Stages know this Protocol, never an implementation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from cow_service.records import GeneratorInfo, Grounding, Motion, Trajectory
from cow_service.vision.obstacles import Obstacle
from cow_service.vision.scene import Scene


@dataclass(frozen=True)
class Shot:
    """All that a generator may know. Clip length and rate are those of the trajectory."""

    scene: Scene
    grounding: Grounding
    motion: Motion
    trajectory: Trajectory
    obstacles: tuple[Obstacle, ...]  # the other objects of the scene
    seed: int
    options: BaseModel  # an instance of the generator's own `options_model`


class Generator(Protocol):
    """Makes the frames of a clip."""

    options_model: type[BaseModel]  # what `generator_options` of a request may hold
    concurrency: int | None  # clips at the same time; None where a clip is computed like everything else

    def describe(self, shot: Shot) -> GeneratorInfo:
        """Who would make this clip, and what would have to be the same to make it again."""
        ...

    def nearest_lengths(self, num_frames: int) -> tuple[int, ...]:
        """`(num_frames,)` where it can make a clip of that many frames, else the lengths next to it that it can."""
        ...

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height (px) of the frames it makes for an image of this size."""
        ...

    def render(
        self, shot: Shot, wanted: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[NDArray[np.uint8]]:
        """The wanted clip frames, RGB [h, w, 3] of `size`, in the order of their ascending indices.

        `progress` hears 0 to 1 after each step of the work, and may raise `Canceled`: then no more is computed.
        """
        ...
