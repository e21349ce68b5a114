"""Stages 1 and 2: what moves, where it is, and how it moves."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cow_service.records.base import Artifact, BBox, Point, Record, Vector

Source = Literal["mllm", "embedded", "request"]
MotionKind = Literal["linear", "projectile", "fall", "static"]
DIRECTED_KINDS: tuple[MotionKind, ...] = ("linear", "projectile")  # these need a direction, and have a speed
FALLING_KINDS: tuple[MotionKind, ...] = ("projectile", "fall")  # these are in the air, and gravity acts on them
Law = Literal["contact", "ballistic"]
Shape = Literal["sphere", "box", "cylinder", "cone"]
ObjectRole = Literal["target", "obstacle"]
Cue = Literal["arrow", "trail", "orientation", "text", "gravity", "request"]


class Estimate(Record):
    """A value that somebody estimated: a prior, never taken as truth."""

    value: float
    deviation: float = Field(ge=0, description="One standard deviation, in the unit of the value.")


class ObjectPrior(Record):
    """What is said of an object beside its place in the image. What is null is left to the image."""

    shape: Shape | None = None
    size: Estimate | None = Field(default=None, description="Its longest side, m.")
    stands_on: str | None = Field(default=None, description="`floor`, `air`, or an object in words.")
    height: Estimate | None = Field(default=None, description="Of its lower end above what it stands on, m.")


class LocatedObject(Record):
    """Something in the image, in words and with its box."""

    object: str
    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    role: ObjectRole = Field(default="target", description="target: the question asks about it; obstacle: it is there.")
    mask: Artifact | None = Field(default=None, description="PNG of the image's size, white where the object is.")
    prior: ObjectPrior | None = None
    source: Source | None = Field(default=None, description="Who located it; null in results of older versions.")


class Grounding(Record):
    """Stage 1: which object moves, and where it is. It does not say how it moves."""

    object: str = Field(description="Words that single it out.")
    point: Point = Field(description="[x, y], px: the centre of the box, or where a reader pointed that gave no box.")
    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    mask: Artifact | None = Field(default=None, description="PNG of the image's size, white where the object is.")
    others: tuple[LocatedObject, ...] = Field(
        default=(), description="Other things that the question names or that matter, where they were found."
    )
    prior: ObjectPrior | None = None
    source: Source


class MetresPerPixel(Record):
    """The scale of the scene at the object, and where it came from."""

    value: float = Field(gt=0, description="Metres per pixel at the object's depth.")
    source: Literal["default", "reference", "request"]
    note: str = Field(default="", description="What it was taken from, in words.")


class Motion(Record):
    """Stage 2: how the object moves. It does not say where it gets to."""

    kind: MotionKind
    law: Law = Field(
        default="ballistic",
        description="contact: floor, bounces, pushes, rolling, tipping; ballistic: constant velocity plus gravity, "
        "through everything.",
    )
    direction: Vector | None = Field(description="Unit vector in the image, px; null for a fall or a static object.")
    depth: float = Field(
        default=0.0,
        ge=-1,
        le=1,
        description="Sine of the angle out of the image plane: positive away from the camera, negative towards it.",
    )
    depth_deviation: float = Field(
        default=0.0, ge=0, le=90, description="Degrees, one standard deviation of that angle."
    )
    cue: Cue
    along_arrow: bool | None = Field(default=None, description="Along or against it, where the cue is an arrow.")
    speed: float = Field(ge=0, description="px/s at the depth of the first frame.")
    speed_deviation: float = Field(
        default=0.0, ge=0, le=3, description="One standard deviation of the speed's natural logarithm."
    )
    gravity: Vector = Field(default=(0.0, 0.0), description="px/s^2.")
    down: Vector = Field(default=(0.0, 1.0), description="Unit vector: which way things fall in the image.")
    metres_per_pixel: MetresPerPixel
    sentence: str = Field(description="The motion in one declarative sentence: the generator's prompt.")
    source: Source
