"""The Protocol of generators: what makes the frames of a clip. Stages know this file, never an implementation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from cow_service.media.types import Image, Mask
from cow_service.records import GeneratorInfo, Grounding, Motion, Trajectory

if TYPE_CHECKING:  # they need OpenCV, which a machine for video models may lack
    from cow_service.media.masks import CroppedMask
    from cow_service.perception.base import Inpainter
    from cow_service.perception.observation import Obstacle
    from cow_service.physics.bodies import Shadow


@dataclass(frozen=True, eq=False)
class Scene:
    """The picture that a clip begins with."""

    image: Image  # RGB [H, W, 3]
    clean: Image  # [H, W, 3] without its cues: neither drawings nor earlier positions of a trail
    cues: Mask  # [H, W] of what is drawn over the image
    mover: CroppedMask  # of what moves
    shadow: Shadow | None = None  # of a mover in the air, where that is all that tells of the light
    backdrop: Image | None = None  # [H, W, 3] of a drawing seen from the side, without what is drawn on it

    @property
    def width(self) -> int:
        """Pixels."""
        return int(self.image.shape[1])

    @property
    def height(self) -> int:
        """Pixels."""
        return int(self.image.shape[0])


@dataclass(frozen=True)
class GeneratorInput:
    """All that a generator may know. Clip length and rate are those of the trajectory."""

    scene: Scene
    grounding: Grounding
    motion: Motion
    trajectory: Trajectory
    obstacles: tuple[Obstacle, ...]  # the other objects of the scene
    seed: int
    options: BaseModel  # an instance of the generator's own `options_model`
    before: GeneratorInput | None = None
    """Where things were put elsewhere: the same from the scene as the image shows it, from which they can be cut. Its
    trajectory has one frame more, the first, in which they are still there."""
    inpainter: Inpainter | None = None  # paints what moving objects hide; None leaves it to the generator


class Limits(Protocol):
    """What a generator takes of a request: known without its libraries, where it says so in a place of its own.

    Entry points of the group `cow_service.generator_limits` are classes of this kind, by the generator's name.
    """

    options_model: type[BaseModel]  # what `generator_options` of a request may hold

    def nearest_lengths(self, num_frames: int, fps: float) -> tuple[int, ...]:
        """`(num_frames,)` where it can make such a clip, else the lengths next to it that it can, in frames."""
        ...


class Generator(Limits, Protocol):
    """Makes the frames of a clip."""

    concurrency: int | None  # clips at the same time on a device of its own; None if it computes on the CPU
    fingerprint: str
    """Everything that determines a clip besides its inputs: model, revision, weights, profile."""

    def describe(self, given: GeneratorInput) -> GeneratorInfo:
        """Who would make this clip, and what would have to be the same to make it again."""
        ...

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height (px) of the frames it makes for an image of this size."""
        ...

    def render(
        self, given: GeneratorInput, indices: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[NDArray[np.uint8]]:
        """The clip frames of these ascending indices, RGB [h, w, 3] of `size`, in their order.

        `progress` hears 0 to 1 after each step of the work, and may raise `Canceled`: then no more is computed.
        """
        ...
