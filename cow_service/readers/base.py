"""The door for whoever looks at pictures. Stages know these Protocols, never an implementation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cow_service.records import (
    AnswerOption,
    BBox,
    Cue,
    Grounding,
    LocatedObject,
    MetresPerPixel,
    MotionKind,
    Point,
    ReaderInfo,
    Simulation,
    Source,
    Usage,
    Vector,
)
from cow_service.vision.scene import Scene


@dataclass(frozen=True)
class Asked:
    """What a reader is asked: the question, and for which stages it will be needed."""

    question: str
    stages: frozenset[str]
    seed: int
    still_wanted: Callable[[], None]  # called while the reader waits for others; raises `Canceled`
    elsewhere: Callable[[], AbstractContextManager[None]] = nullcontext  # around such waits: others may compute
    recalled: Grounding | None = None  # stage 1, where it was read before and this look is not asked for it


@dataclass(frozen=True)
class GroundingReading:
    """What a reader says of stage 1. The stage adds the point and the mask."""

    object: str
    bbox: BBox  # px of the upright image
    point: Point | None = None  # where the reader pointed, if it gave no box; by default the centre of the box
    others: tuple[LocatedObject, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class MotionReading:
    """What a reader says of stage 2. The stage adds speed and gravity, and the sentence where there is none."""

    kind: MotionKind
    direction: Vector | None  # any length; px of the upright image
    cue: Cue
    along_arrow: bool | None = None
    depth: float = 0.0  # see `Motion.depth`
    metres_per_pixel: MetresPerPixel | None = None  # null where the reader cannot tell
    down: Vector = (0.0, 1.0)  # unit vector: which way things fall in the image
    sentence: str | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Imagined:
    """What an answer may be drawn from besides the image: the simulation and its frames."""

    simulation: Simulation
    frames: tuple[NDArray[np.uint8], ...]  # RGB [h, w, 3] of `simulation.frames`, in their order


@dataclass(frozen=True)
class AnswerReading:
    """One answer as a reader gives it: the letter of an option, or text where the question offers none."""

    answer: str | None  # null where it is not sure and no option says so
    not_sure: bool
    reasoning: str = ""  # empty where the reader does not reason in words
    notes: tuple[str, ...] = ()  # what the answer rests on or lacks, in whole sentences: warnings for the caller


class Look(Protocol):
    """One image and one question under one reader's eyes. It may remember what it saw, and serves one request."""

    source: Source

    def ground(self) -> GroundingReading:
        """Which object moves and where it is. Raises `CannotGround` where that cannot be told."""
        ...

    def read_motion(self, grounding: Grounding) -> MotionReading:
        """How the grounded object moves. Raises `CannotReadDirection` where that cannot be told."""
        ...

    def answer(
        self, options: Sequence[AnswerOption], imagined: Imagined | None, votes: int
    ) -> tuple[AnswerReading, ...]:
        """`votes` answers, fewer where some could not be read; without `imagined` from the image alone."""
        ...

    @property
    def info(self) -> ReaderInfo:
        """Who reads, with what it has been asked so far."""
        ...

    @property
    def usage(self) -> Usage:
        """What has been asked of a multimodal LLM so far."""
        ...


class Reader(Protocol):
    """Reads images for questions. Safe to use from several threads at once."""

    fingerprint: str
    """All that decides what it reads, besides what it is asked: model, revision, prompts, options."""

    def look(self, scene: Scene, asked: Asked) -> Look:
        """Begins to read an image for a question. Nothing is read yet."""
        ...
