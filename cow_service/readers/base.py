"""The door for whoever looks at pictures. Stages know this Protocol, never an implementation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from cow_service.records import (
    BBox,
    Cue,
    Grounding,
    LocatedObject,
    MetresPerPixel,
    MotionKind,
    ReaderInfo,
    Source,
    Vector,
)
from cow_service.vision.scene import Scene


@dataclass(frozen=True)
class GroundingReading:
    """What a reader says of stage 1. The stage adds the point and the mask."""

    object: str
    bbox: BBox  # px of the upright image
    others: tuple[LocatedObject, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class MotionReading:
    """What a reader says of stage 2. The stage adds speed, gravity and the sentence."""

    kind: MotionKind
    direction: Vector | None  # any length; px of the upright image
    cue: Cue
    along_arrow: bool | None = None
    depth: float = 0.0  # see `Motion.depth`
    metres_per_pixel: MetresPerPixel | None = None  # null where the reader cannot tell
    warnings: tuple[str, ...] = ()


class Reader(Protocol):
    """Reads an image for a question. Safe to call from several threads at once."""

    source: Source

    @property
    def info(self) -> ReaderInfo:
        """Who reads."""
        ...

    def ground(self, scene: Scene, question: str) -> GroundingReading:
        """Which object moves and where it is. Raises `CannotGround` where that cannot be told."""
        ...

    def read_motion(self, scene: Scene, question: str, grounding: Grounding) -> MotionReading:
        """How the grounded object moves. Raises `CannotReadDirection` where that cannot be told."""
        ...
