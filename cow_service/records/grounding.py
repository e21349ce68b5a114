"""Records of stage 1: what moves and where it is, what else matters, and what is asked."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from cow_service.records.values import BBox, Finite, ObjectWords, Point, Record, Sha256

Position = tuple[float, float, float]
State = tuple[float, float, float, float, float, float]


class Artifact(Record):
    """A reference to bytes that the service keeps."""

    sha256: Sha256
    url: str = Field(description="Path of the bytes on the server that made them.")
    media_type: str
    size: int = Field(ge=0, description="Bytes.")


class ImageInfo(Record):
    """The input image, upright. `sha256` is the digest of the bytes as sent."""

    width: int = Field(gt=0, description="Pixels.")
    height: int = Field(gt=0, description="Pixels.")
    sha256: Sha256
    focal: float | None = Field(default=None, gt=0, description="Focal length in its EXIF data, px; null: none.")


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
Language = Literal["en", "de", "es", "fr", "zh", "ja"]
MAX_OBJECTS = 64
MAX_WITHIN = 1e9  # s


AskedRelation = Literal["touches", "covers", "covered", "inside", "tips", "moves", "leaves", "lands"]
AskedForm = Literal[
    "whether", "which-first", "which", "which-to-remove", "when", "how-many", "where", "what-happens", "changes"
]


class Asked(Record):
    """The event that a question asks about, and what it wants to know of it. Objects are named in words."""

    form: AskedForm = Field(
        default="whether",
        description="`which`: with which of `among` it happens; `which-to-remove`: which of `among`, taken away alone, "
        "keeps it from happening.",
    )
    relation: AskedRelation = Field(
        description="`touches`: the subject hits it or lands on it; `covers`: the subject hides it; `covered`: the "
        "subject is hidden by it; `inside`: the subject fits or ends up in it; `tips`: the target is knocked over; "
        "`moves`: the target is set in motion; `leaves`: the subject leaves the image; `lands`: the subject "
        "comes down on the floor."
    )
    subject: ObjectWords | None = Field(default=None, description="The acting object; null: the moving object.")
    target: ObjectWords | None = Field(default=None, description="The object in question; null: any.")
    negated: bool = Field(default=False, description="The event is that it does not happen: to miss, to stay visible.")
    among: tuple[ObjectWords, ...] = Field(
        default=(), max_length=MAX_OBJECTS, description="The objects in question, if several; empty: any."
    )
    every: bool = Field(default=False, description="It counts only if it happens with each of `among`.")
    partly: bool = Field(default=False, description="For `covers` and `covered`: any hidden part counts.")
    within: Annotated[Finite, Field(gt=0, le=MAX_WITHIN)] | None = Field(
        default=None, description="Time limit for the event, s; null: until everything is at rest or out of view."
    )


class Estimate(Record):
    """An estimated value: a prior, never taken as truth."""

    value: float
    deviation: float = Field(ge=0, description="One standard deviation, in the unit of the value.")


class ObjectPrior(Record):
    """What is known about an object besides its place in the image. Null values are estimated from the image."""

    shape: Shape | None = None
    size: Estimate | None = Field(default=None, description="Its longest side, m.")
    stands_on: str | None = Field(default=None, description="`floor`, `air`, or an object in words.")
    height: Estimate | None = Field(default=None, description="Height of its lower end above its support, m.")
    elongated: bool = Field(default=False, description="Longer along its heading than across, as vehicles are.")
    equal_sided: bool = Field(default=False, description="As wide as high, as cubes are.")
    opening: Opening | None = Field(
        default=None, description="Shape of a container's opening; `none`: nothing fits into it."
    )


class LocatedObject(Record):
    """Something in the image, in words and with its box."""

    object: str
    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    role: ObjectRole = Field(default="target", description="target: in the question; obstacle: it could be in the way.")
    mask: Artifact | None = Field(default=None, description="PNG of the image's size, white where the object is.")
    prior: ObjectPrior | None = None
    source: Source | None = Field(default=None, description="Who located it; null in results of older versions.")
    bbox_deviation: float = Field(
        default=0.0, ge=0, le=1, description="Of the edges of an estimated box, one standard deviation in its sides."
    )
    is_doubtful: bool = Field(default=False, description="It may not be the named one: no answer about it is sure.")


class Intervention(Record):
    """A change of the scene before anything moves. Putting the moving object somewhere can be the whole motion."""

    kind: InterventionKind
    object: LocatedObject = Field(description="The object to take away or put somewhere.")
    relation: PlaceRelation | None = Field(
        default=None, description="With `place`: where it goes, relative to the `targets`."
    )
    targets: tuple[LocatedObject, ...] = Field(default=(), description="With `place`: two for `between`, else one.")


class Grounding(Record):
    """Stage 1, grounding: which object moves and where it is, not how it moves."""

    object: str = Field(description="Words that single it out.")
    point: Point = Field(description="[x, y], px: the centre of the box, or the point of a reader that gave no box.")
    bbox: BBox = Field(description="[x0, y0, x1, y1], px.")
    mask: Artifact | None = Field(default=None, description="PNG of the image's size, white where the object is.")
    others: tuple[LocatedObject, ...] = Field(
        default=(), description="Other objects that the question names or that matter, if they were found."
    )
    objects_complete: bool = Field(default=False, description="`others` are all: nothing else shown is a thing.")
    interventions: tuple[Intervention, ...] = Field(
        default=(), description="Objects taken away or put somewhere before the motion; not in `others`."
    )
    prior: ObjectPrior | None = None
    asked: Asked | None = Field(
        default=None, description="What the question wants to know; null if that was not understood."
    )
    trail_named: bool = Field(
        default=False, description="The question mentions a trail: similar balls in a row are one ball over time."
    )
    bbox_deviation: float = Field(default=0.0, ge=0, le=1, description="As `LocatedObject.bbox_deviation`.")
    is_doubtful: bool = Field(default=False, description="As `LocatedObject.is_doubtful`, for the moving object.")
    question_is_doubtful: bool = Field(default=False, description="Its words say otherwise than it was read.")
    language: Language | None = Field(default=None, description="Of the question, where a multimodal LLM says it.")
    source: Source
