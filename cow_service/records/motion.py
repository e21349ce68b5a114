"""Stages 1 and 2: what moves, where it is, and how it moves."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from cow_service.records.base import Artifact, BBox, Point, Record, Vector

Source = Literal["mllm", "embedded", "request"]
MotionKind = Literal["linear", "projectile", "fall", "static", "place"]
DIRECTED_KINDS: tuple[MotionKind, ...] = ("linear", "projectile")  # these need a direction, and have a speed
FALLING_KINDS: tuple[MotionKind, ...] = ("projectile", "fall")  # these are in the air, and gravity acts on them
Law = Literal["contact", "ballistic"]
Shape = Literal["sphere", "box", "cylinder", "cone"]
ObjectRole = Literal["target", "obstacle"]
InterventionKind = Literal["remove", "place"]
PlaceRelation = Literal["into", "onto", "between", "in-front-of", "behind", "next-to", "left-of", "right-of"]
Until = Literal["contact", "out-of-view"]
Cue = Literal["arrow", "trail", "orientation", "text", "gravity", "request"]
Opening = Literal["round", "square", "none"]


AskedRelation = Literal["touches", "covers", "covered", "inside", "tips", "moves", "leaves", "lands"]
AskedForm = Literal["whether", "which-first", "when", "how-many", "where", "what-happens", "changes"]


class Asked(Record):
    """The event that a question asks about, and what it wants to know of it."""

    form: AskedForm = "whether"
    relation: AskedRelation = Field(
        description="`touches`: the subject hits it or lands on it; `covers`: the subject hides it; `covered`: the "
        "subject is hidden by it; `inside`: the subject fits or ends up in it; `tips`: the target is knocked over; "
        "`moves`: the target is set in motion; `leaves`: the subject leaves the image; `lands`: the subject "
        "comes down on the floor."
    )
    subject: str | None = Field(
        default=None, description="Who does it, in the question's words, where that is not the mover; null: the mover."
    )
    target: str | None = Field(default=None, description="The thing asked about in the question's words; null: any.")
    negated: bool = Field(default=False, description="Asked is that it does not happen: to miss, to stay visible.")
    among: tuple[str, ...] = Field(
        default=(),
        description="The things that are meant where the question names several, or things of a kind; empty: any.",
    )
    every: bool = Field(default=False, description="It counts only where it happens with each of `among`.")
    partly: bool = Field(default=False, description="Of `covers` and `covered`: it counts where any part is hidden.")
    within: float | None = Field(
        default=None, gt=0, description="How long it may take to happen, s; null: as long as the clip."
    )


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
    elongated: bool = Field(default=False, description="Longer along its heading than across, as vehicles are.")
    equal_sided: bool = Field(default=False, description="As wide as high, as cubes are.")
    opening: Opening | None = Field(
        default=None, description="Of a container, the form of its opening; `none`: nothing goes into it."
    )


class LocatedObject(Record):
    """Something in the image, in words and with its box."""

    object: str
    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    role: ObjectRole = Field(default="target", description="target: the question asks about it; obstacle: it is there.")
    mask: Artifact | None = Field(default=None, description="PNG of the image's size, white where the object is.")
    prior: ObjectPrior | None = None
    source: Source | None = Field(default=None, description="Who located it; null in results of older versions.")


class Intervention(Record):
    """A change of the scene before anything moves; where the mover is put somewhere, that can be the motion."""

    kind: InterventionKind
    object: LocatedObject = Field(description="What is taken away or put somewhere.")
    relation: PlaceRelation | None = Field(default=None, description="Of `place`: how it is put to the `targets`.")
    targets: tuple[LocatedObject, ...] = Field(default=(), description="Of `place`: two for `between`, else one.")


class Grounding(Record):
    """Stage 1: which object moves, and where it is. It does not say how it moves."""

    object: str = Field(description="Words that single it out.")
    point: Point = Field(description="[x, y], px: the centre of the box, or where a reader pointed that gave no box.")
    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    mask: Artifact | None = Field(default=None, description="PNG of the image's size, white where the object is.")
    others: tuple[LocatedObject, ...] = Field(
        default=(), description="Other things that the question names or that matter, where they were found."
    )
    interventions: tuple[Intervention, ...] = Field(
        default=(), description="What is taken away or put in before the motion; not among `others`."
    )
    prior: ObjectPrior | None = None
    asked: Asked | None = Field(
        default=None, description="What the question wants to know; null where that was not understood."
    )
    trail_named: bool = Field(
        default=False, description="The question speaks of a trail: balls that look alike, one after another, are one."
    )
    source: Source


class MetresPerPixel(Record):
    """The scale of the scene at the object, and where it came from."""

    value: float = Field(gt=0, description="Metres per pixel at the object's depth.")
    source: Literal["default", "reference", "request"]
    note: str = Field(default="", description="What it was taken from, in words.")


class MotionStep(Record):
    """A further leg of a motion, after the one before has ended."""

    direction: Vector = Field(description="Unit vector in the image, px.")
    depth: float = Field(default=0.0, ge=-1, le=1, description="As `Motion.depth`.")
    distance: float | None = Field(default=None, gt=0, description="px at the depth of the first frame.")
    duration: float | None = Field(default=None, gt=0, description="s.")


class AlsoMoving(Record):
    """Another object that is set moving at the first frame."""

    object: LocatedObject
    kind: MotionKind
    direction: Vector | None = Field(default=None, description="As `Motion.direction`.")
    depth: float = Field(default=0.0, ge=-1, le=1, description="As `Motion.depth`.")
    speed: float = Field(ge=0, description="px/s at the depth of the first frame.")
    speed_deviation: float = Field(default=0.0, ge=0, le=3, description="As `Motion.speed_deviation`.")


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
    distance: float | None = Field(
        default=None, gt=0, description="px at the depth of the first frame, after which the object is stopped."
    )
    duration: float | None = Field(default=None, gt=0, description="s, after which the object is stopped.")
    until: Until | None = Field(
        default=None, description="contact: stopped where it first meets something; null: it goes on by itself."
    )
    steps: tuple[MotionStep, ...] = Field(default=(), description="Further legs; the first is this motion.")
    trail: tuple[Point, ...] = Field(
        default=(), description="[x, y], px: earlier positions of the object's centre that are shown, oldest first."
    )
    others: tuple[AlsoMoving, ...] = Field(default=(), description="What is set moving at the same time.")
    gravity: Vector = Field(default=(0.0, 0.0), description="px/s^2.")
    down: Vector = Field(default=(0.0, 1.0), description="Unit vector: which way things fall in the image.")
    metres_per_pixel: MetresPerPixel
    sentence: str = Field(description="The motion in one declarative sentence: the generator's prompt.")
    source: Source
