"""What is said of a scene, by a caller in a request or by a reader: the same fields in the same words."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BeforeValidator, Field, model_validator

from cow_service.records.grounding import (
    DIRECTED_KINDS,
    MAX_OBJECTS,
    Asked,
    Cue,
    Estimate,
    Grounding,
    InterventionKind,
    Language,
    Law,
    LocatedObject,
    MotionKind,
    ObjectPrior,
    ObjectRole,
    PlaceRelation,
    Shape,
    Source,
    Until,
)
from cow_service.records.values import (
    Box,
    Direction,
    Finite,
    Flag,
    ImageArtifact,
    MaskRef,
    ObjectWords,
    Record,
    Seconds,
)
from cow_service.records.world import AlsoMoving, Motion

MAX_STEPS = 16
MAX_CHANGES = 8

# --- things and their places


class PlaceRequest(Record):
    """An object's place in the image, and what is known about it. Omitted values are estimated."""

    bbox: Box | None = Field(default=None, description="[x0, y0, x1, y1], px of the upright image, x right, y down.")
    bbox_deviation: Annotated[Finite, Field(ge=0, le=1)] | None = Field(
        default=None, description="Of the edges of an estimated `bbox`, one standard deviation in its sides."
    )
    point: tuple[Finite, Finite] | None = Field(
        default=None, description="[x, y], px: a point on the object, from which its outline is found."
    )
    mask: MaskRef | None = Field(
        default=None, description="PNG of the upright image's size, white on the object and black elsewhere."
    )
    shape: Shape | None = None
    size: Annotated[Finite, Field(ge=1e-4, le=1000)] | None = Field(default=None, description="Its longest side, m.")
    stands_on: ObjectWords | None = Field(default=None, description="`floor`, `air`, or another object in words.")
    source: Source = Field(default="request", description="Who says it.")
    is_doubtful: Flag = Field(default=False, description="It may not be the named one: no answer about it is sure.")

    @property
    def has_place(self) -> bool:
        """Whether it says where the object is."""
        return self.bbox is not None or self.point is not None or self.mask is not None

    @property
    def prior(self) -> ObjectPrior | None:
        """What it says about the object besides its place, taken as exact."""
        if self.shape is None and self.size is None and self.stands_on is None:
            return None
        size = None if self.size is None else Estimate(value=self.size, deviation=0.0)
        return ObjectPrior(shape=self.shape, size=size, stands_on=self.stands_on)

    @model_validator(mode="after")
    def _in_one_place(self) -> PlaceRequest:
        if self.bbox is not None and self.point is not None:
            (x0, y0, x1, y1), (x, y) = self.bbox, self.point
            if not (x0 <= x <= x1 and y0 <= y <= y1):
                raise ValueError(f"the `point` {[x, y]} must lie in the `bbox` {[x0, y0, x1, y1]}")
        return self


class GroundingRequest(PlaceRequest):
    """The moving object, and where it is: a box, a mask or a point on it. Skips stage 1, grounding (finding it)."""

    object: ObjectWords | None = Field(default=None, description="Name of the object.")


class ObjectRequest(PlaceRequest):
    """Another object of the image, by its box, its mask, or a point on it."""

    object: ObjectWords
    role: ObjectRole = Field(
        default="target", description="target: the question asks about it; obstacle: it could be in the way."
    )


class InterventionRequest(Record):
    """A change of the scene before anything moves. Objects are named as in `objects`, or in words to look for."""

    kind: InterventionKind
    object: ObjectWords
    relation: PlaceRelation | None = Field(
        default=None, description="With `place`: where the object goes, relative to the `targets`."
    )
    targets: tuple[ObjectWords, ...] = Field(
        default=(), max_length=2, description="With `place`: the object or place it refers to; two for `between`."
    )

    @model_validator(mode="after")
    def _is_whole(self) -> InterventionRequest:
        if self.kind == "remove" and (self.relation is not None or self.targets):
            raise ValueError("`remove` takes only an `object`; `relation` and `targets` belong to `place`")
        if self.kind == "place":
            wanted = 2 if self.relation == "between" else 1
            if self.relation is None or len(self.targets) != wanted:
                raise ValueError(f"`place` needs a `relation`, and `targets` of length {wanted}")
            if len({" ".join(name.lower().split()) for name in (self.object, *self.targets)}) <= wanted:
                raise ValueError("`object` and `targets` must be different objects")
        return self


# --- motion

SpeedWord = Literal["slow", "normal", "fast"]


class Speed(Record):
    """A speed with its unit. `widths` are image widths."""

    value: Annotated[Finite, Field(ge=0, le=1_000_000)]
    unit: Literal["px/s", "m/s", "widths/s"]


class Distance(Record):
    """A length above 0 with its unit."""

    value: Annotated[Finite, Field(gt=0, le=1_000_000)]
    unit: Literal["px", "m", "widths"]


Quantity = Speed | Distance
MAX_SPEED, MAX_DISTANCE = 100_000, 1_000_000  # px/s, px


def _in_a_form(kind: type[Record], unit: str, words: tuple[str, ...] = ()) -> BeforeValidator:
    """One error for all forms of a quantity, in place of one for each."""
    units = get_args(kind.model_fields["unit"].annotation)
    told = (
        f'a number of {unit}, a value with its unit such as {{"value": 2, "unit": "{units[1]}"}} ({", ".join(units)})'
    )
    forms = ", or ".join((told, *filter(None, [", ".join(words)])))

    def checked(value: Any) -> Any:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if isinstance(value, kind) or (is_number if not isinstance(value, dict) else value.get("unit") in units):
            return value
        if isinstance(value, str) and value in words:
            return value
        raise ValueError(f"must be {forms}, got {str(value)[:40]!r}")

    return BeforeValidator(checked)


AnySpeed = Annotated[
    Annotated[Finite, Field(ge=0, le=MAX_SPEED)] | Speed | SpeedWord, _in_a_form(Speed, "px/s", get_args(SpeedWord))
]
AnyDistance = Annotated[Annotated[Finite, Field(gt=0, le=MAX_DISTANCE)] | Distance, _in_a_form(Distance, "px")]
Depth = Annotated[Finite, Field(ge=-1, le=1)]
Degrees = Annotated[Finite, Field(ge=0, le=90)]


class MotionStepRequest(Record):
    """A further leg of a motion, after the previous one has ended."""

    direction: Direction = Field(description="[dx, dy] in the image, any length but zero.")
    depth: Depth = Field(default=0.0, description="See `Motion.depth`.")
    distance: AnyDistance | None = Field(
        default=None, description="px at the depth of the first frame, or a value with its unit."
    )
    duration: Seconds | None = Field(default=None, description="s.")


class WayRequest(Record):
    """Which way something sets out, and how fast: by a direction, or by what the image shows."""

    direction: Direction | None = Field(
        default=None,
        description="[dx, dy] in the image, x right, y down, any length but zero: [-1, 0] is to the left. By default "
        "read from the question and from arrows drawn in the image. Not for a fall or a static object.",
    )
    direction_deviation: Degrees | None = Field(
        default=None, description="Degrees, one standard deviation of `direction`; by default that of its `cue`."
    )
    towards: ObjectWords | None = Field(
        default=None, description="Name of the object that it moves towards, instead of a `direction`."
    )
    depth: Depth = Field(default=0.0, description="See `Motion.depth`.")
    speed: AnySpeed | None = Field(
        default=None,
        description='px/s, a value with its unit such as {"value": 2, "unit": "m/s"}, or `slow`, `normal`, `fast`; by '
        "default 0.26 image widths per second, or 1.8 m/s for a throw under the contact law.",
    )
    speed_deviation: Annotated[Finite, Field(ge=0, le=3)] | None = Field(
        default=None, description="See `Motion.speed_deviation`; by default 0 for a given `speed`."
    )

    @property
    def has_way(self) -> bool:
        """Whether it says which way."""
        return self.direction is not None or self.towards is not None


class OtherMotionRequest(WayRequest):
    """Another object that is set moving at the first frame."""

    object: ObjectWords = Field(description="Its name in `objects`.")
    kind: Literal["linear", "projectile", "fall", "static"] | None = Field(
        default=None, description="By default linear; a fall takes no `direction`."
    )

    @property
    def stated_kind(self) -> MotionKind:
        """The kind of motion."""
        return self.kind or "linear"

    @model_validator(mode="after")
    def _goes_somewhere(self) -> OtherMotionRequest:
        if self.has_way != (self.stated_kind in DIRECTED_KINDS):
            needs = "needs a" if self.stated_kind in DIRECTED_KINDS else "takes no"
            raise ValueError(f"a {self.stated_kind} motion {needs} `direction`")
        return self


OF_A_LINE = ("distance", "duration", "until", "steps")  # what only a motion along a line can have


class MotionRequest(WayRequest):
    """How the object moves. What is left out is read from the question. A motion that says which way, or has a kind
    without a way, skips the reading of stage 2, motion."""

    kind: MotionKind | None = Field(
        default=None,
        description="linear: straight on; projectile: thrown; fall: dropped; static: stays; place: put somewhere. By "
        "default as the question has it; with a way, linear where the question does not tell.",
    )
    law: Law = Field(
        default="contact",
        description="Physics of the motion. contact: bounces, pushes, rolls, comes to rest; ballistic: constant "
        "velocity plus gravity, straight through everything.",
    )
    other_direction: Direction | None = Field(default=None, description="See `Motion.other_direction`.")
    along_arrow: Flag | None = Field(
        default=None, description="Along the arrow that is drawn at the object, or with false against it."
    )
    forward: Flag | None = Field(default=None, description="The way that a vehicle faces, or with false backward.")
    cue: Cue | None = Field(
        default=None,
        description="What tells the direction. `trail`: the earlier positions that the image shows of the object, from "
        "which direction and speed are measured.",
    )
    rises: Flag = Field(
        default=False, description="See `Motion.rises`; by default an object on the floor moves along the floor."
    )
    distance: AnyDistance | None = Field(
        default=None,
        description="Stops after this distance, px at the depth of the first frame, or a value with its unit such as "
        '{"value": 0.5, "unit": "m"}.',
    )
    duration: Seconds | None = Field(default=None, description="Stops after this time, s.")
    until: Until | None = Field(default=None, description="contact: stops at its first contact.")
    steps: tuple[MotionStepRequest, ...] = Field(
        default=(), max_length=MAX_STEPS, description="Further legs, after this one."
    )
    others: tuple[OtherMotionRequest, ...] = Field(
        default=(), max_length=MAX_STEPS, description="Other objects set moving at the same time."
    )
    metres_per_pixel: Annotated[Finite, Field(ge=1e-8, le=1000)] | None = Field(
        default=None, description="Scale at the object; by default the image is assumed to be 3 m wide there."
    )
    depth_deviation: Degrees | None = Field(
        default=None, description="See `Motion.depth_deviation`; by default 20 for a throw without `depth`, else 0."
    )
    down: Direction = Field(default=(0.0, 1.0), description="The direction of a fall in the image.")

    @property
    def has_way(self) -> bool:
        """Whether it says which way, or what in the image tells it."""
        told = (self.direction, self.towards, self.along_arrow, self.forward)
        return any(each is not None for each in told) or self.cue == "trail"

    @property
    def stated_kind(self) -> MotionKind | None:
        """The kind of motion; None where it is open."""
        return self.kind or ("linear" if self.has_way else None)

    @property
    def is_whole(self) -> bool:
        """Whether nothing of it is left to a reader."""
        return self.has_way or self.kind not in (None, *DIRECTED_KINDS)

    @model_validator(mode="after")
    def _goes_somewhere(self) -> MotionRequest:
        kind, is_led = self.stated_kind, self.has_way or bool(self.depth) or self.depth_deviation is not None
        if kind is None and is_led:
            raise ValueError("`depth` and `depth_deviation` need a `direction` [dx, dy]")
        is_sped = self.speed is not None or self.speed_deviation is not None
        if kind not in (None, *DIRECTED_KINDS) and (is_led or is_sped):
            raise ValueError(f"a {kind} motion takes no `direction`, `speed` or `depth`; a throw is a `projectile`")
        return self


# --- all of it


class Reading(Record):
    """What is said of a scene: what moves and how, what else matters, what is changed and asked. Null is not said."""

    grounding: GroundingRequest | None = None
    motion: MotionRequest | None = None
    objects: tuple[ObjectRequest, ...] = Field(
        default=(),
        max_length=MAX_OBJECTS,
        description="Other objects that matter, and their places, which take precedence over what the reader finds.",
    )
    objects_complete: Flag = Field(
        default=False, description="`objects` are all that could be hit or hide something: nothing else is looked for."
    )
    interventions: tuple[InterventionRequest, ...] | None = Field(
        default=None,
        max_length=MAX_CHANGES,
        description="Objects to take away or put somewhere before the motion, instead of what the question "
        "says; an empty list: none.",
    )
    asked: Asked | None = Field(
        default=None, description="What the question wants to know; by default it is read from the question."
    )
    question_is_doubtful: Flag = Field(
        default=False, description="The words of the question say otherwise than it was read: no answer is sure."
    )
    language: Language | None = Field(
        default=None,
        description="Of the narration, and of what the embedded reader answers. By default that of the header "
        "`Accept-Language`, unless it prefers English; else that of the question, where a multimodal LLM reads it; "
        "else English.",
    )


Said = TypeVar("Said", bound=Record)


def merged(given: Said | None, read: Said | None) -> Said | None:
    """What was read, with every field that was given in its place."""
    if given is None or read is None:
        return given or read
    said = {name: value for name in given.model_fields_set if (value := getattr(given, name)) is not None}
    return read.model_copy(update=said)


def as_said(thing: LocatedObject) -> ObjectRequest:
    """A thing that was located, as a caller would give it."""
    return ObjectRequest(role=thing.role, source=thing.source or "embedded", **_place_of(thing))


def _place_of(thing: LocatedObject | Grounding) -> dict[str, Any]:
    prior = thing.prior or ObjectPrior()
    return {
        "object": thing.object,
        "bbox": thing.bbox,
        "bbox_deviation": thing.bbox_deviation or None,
        "mask": None if thing.mask is None else ImageArtifact(artifact=thing.mask.sha256),
        "shape": prior.shape,
        "size": None if prior.size is None else prior.size.value,
        "stands_on": prior.stands_on,
        "is_doubtful": thing.is_doubtful,
    }


def reading_of(grounding: Grounding, motion: Motion) -> Reading:
    """What stages 1 and 2 came to, as fields of a request: sent back, they give the same trajectory."""
    changes = [
        {**dict(each), "object": each.object.object, "targets": [thing.object for thing in each.targets]}
        for each in grounding.interventions
    ]
    changed = (thing for each in grounding.interventions for thing in (each.object, *each.targets))
    things = {each.bbox: each for each in (*changed, *grounding.others) if each.bbox != grounding.bbox}
    (x0, y0, x1, y1), (x, y) = grounding.bbox, grounding.point
    is_inside = x0 <= x <= x1 and y0 <= y <= y1  # else another outline was found than that at the point
    own = _place_of(grounding) | {"source": grounding.source, "point": grounding.point if is_inside else None}
    return Reading(
        grounding=GroundingRequest.model_validate(own),
        motion=_motion_of(motion),
        objects=tuple(map(as_said, things.values()))[:MAX_OBJECTS],
        objects_complete=grounding.objects_complete,
        interventions=tuple(map(InterventionRequest.model_validate, changes)),
        asked=grounding.asked,
        question_is_doubtful=grounding.question_is_doubtful,
        language=grounding.language,
    )


def _way_of(way: Motion | AlsoMoving, form: type[WayRequest]) -> dict[str, Any]:
    """The fields that a request has under the same names. It takes one way: towards a thing, else a direction."""
    left_out = {"along_arrow", "towards"}
    if way.kind not in DIRECTED_KINDS:
        left_out |= {*WayRequest.model_fields, "depth_deviation"}
    elif way.towards is not None:
        left_out |= {"direction", "direction_deviation"}
    said = way.model_dump(include=form.model_fields.keys() - left_out)
    return said if way.towards is None else said | {"towards": way.towards.object}


def _motion_of(motion: Motion) -> MotionRequest:
    said, scale = _way_of(motion, MotionRequest), motion.metres_per_pixel
    if motion.trail:  # by which direction and depth are measured again
        del said["direction"], said["direction_deviation"]
    others = tuple(_way_of(each, OtherMotionRequest) | {"object": each.object.object} for each in motion.others)
    is_said = scale.source in ("request", "reference") and not scale.note.startswith("by the sizes")
    said |= {"others": others, "metres_per_pixel": scale.value if is_said else None}
    return MotionRequest.model_validate(said)


def kept_mask(mask: MaskRef) -> ImageArtifact:
    """A mask that the server keeps."""
    assert not isinstance(mask, str), "the masks of a request are kept before its stages run"
    return mask
