"""Second prompt: the object's place and surroundings, its direction and the cue for it; third prompt: the scale."""

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, ClassVar, cast

from pydantic import BeforeValidator, Field, ValidationInfo, WithJsonSchema, field_validator

from cow_service import records
from cow_service.narration.words import same_name
from cow_service.readers.base import ReaderInput
from cow_service.readers.mllm import coordinates, estimates, replies
from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.coordinates import NUMBER, CoordinateFrame, EncodedImage
from cow_service.readers.mllm.estimates import PlacesContext
from cow_service.readers.mllm.identify import MAX_NAMED
from cow_service.readers.mllm.replies import Reply, ReplyError
from cow_service.records import BBox, LocatedObject, ObjectPrior, Point, Vector
from cow_service.vision.masks import is_among, is_same_object

CUES = ("arrow", "trail", "text", "orientation", "none")
BOX_KEYS = ("bbox_2d", "box_2d", "bbox", "box", "bounding_box", "boundingbox", "bbox2d")
POINT_KEYS = ("point_2d", "point", "center", "centre", "point2d")
MAX_OBSTACLES = 12
MIN_COMPLETE_LIST = 2  # things in a list that is taken for complete, as it was asked for, where the reply does not say
MAX_LABEL = 80  # characters
STRAIGHT = 60.0  # degrees from the image's vertical, within which a line can also lead towards or away
STEEP = 60.0  # degrees out of the image plane, from which a motion leads straight towards or away
LEAST_SPAN = 4.0  # px: measuring less is guessing
DOWN: dict[str, Vector] = {"bottom": (0.0, 1.0), "top": (0.0, -1.0), "left": (-1.0, 0.0), "right": (1.0, 0.0)}
_SIDES = {side: side for side in DOWN} | {"down": "bottom", "below": "bottom", "up": "top", "above": "top"}
_LABEL_KEYS = ("label", "object", "name", "class")
_DIRECTION_KEYS = ("direction", "motion_direction", "line", "vector")
# An object under one of these headings has no name yet.
_HEADINGS = frozenset({
    "objects", "object", "result", "results", "answer", "data", "detections", "detection", "location", "locations",
    "output", "response", "places", "items", "boxes", "bboxes", "final_result", "grounding",
})  # fmt: skip
_CUE_WORDS: dict[str, records.Cue] = {
    "arrow": "arrow", "trail": "trail", "ghost": "trail", "orient": "orientation", "front": "orientation",
    "facing": "orientation", "text": "text", "question": "text", "word": "text", "gravity": "gravity",
}  # fmt: skip
_PAIR = rf"\(\s*({NUMBER})\s*,\s*({NUMBER})\s*\)"
_LABEL_TAG = r"(?:<(?:\|object_ref_start\||ref)>(?P<label>[^<]*)<(?:\|object_ref_end\||/ref)>\s*)?"
_BOX_TAG = re.compile(
    rf"{_LABEL_TAG}<(?:\|box_start\||b?box)>\s*(?P<box>[^<]*?)\s*<(?:\|box_end\||/b?box)>", re.IGNORECASE
)
_POINT_TAG = re.compile(
    rf"{_LABEL_TAG}<(?:\|point_start\||point)>\s*(?P<point>[^<]*?)\s*<(?:\|point_end\||/point)>", re.IGNORECASE
)
# Two pairs are corners where nothing but these stands between; in a sentence they may be two objects.
_CORNER_PAIRS = re.compile(rf"{_PAIR}\s*(?:,|-|–|→|to|and|through)?\s*{_PAIR}")
_FOUR = re.compile(r"[(\[]?\s*" + r"\s*,\s*".join([f"({NUMBER})"] * 4) + r"\s*[)\]]?")
_CAMERA = BeforeValidator(lambda said: estimates.CAMERA.get(replies.text_of(said).lower().strip(" .")))
_COORDINATES = WithJsonSchema({replies.COORDINATES: 4})  # nullable
_WITH, _AGAINST = "with", "against"  # the arrow
_SENSES = {
    **dict.fromkeys((_WITH, "along", "same", "forward", "true", "yes"), True),
    **dict.fromkeys((_AGAINST, "opposite", "reverse", "reversed", "backward", "false", "no"), False),
}
Ends = tuple[Point, Point]  # of a line, px of the upright image


class SeenObject(Reply):
    """An object at its place, and what may be estimated of it. Places are in px of the upright image."""

    label: Annotated[str, BeforeValidator(lambda said: replies.text_of(said)[:MAX_LABEL]), Field(max_length=MAX_LABEL)]
    bbox: Annotated[BBox | None, _COORDINATES]
    size: estimates.Size = None  # m
    stands_on: estimates.Support = None
    height_above: estimates.Height = None  # m
    shape: estimates.KnownShape = None

    @field_validator("bbox", mode="before")
    @classmethod
    def _read_bbox(cls, written: object, info: ValidationInfo) -> BBox | None:
        return None if replies.is_none(written) else estimates.frame_of(info).bbox(written)

    @property
    def prior(self) -> ObjectPrior | None:
        """The estimates with widths; null if there are none."""
        size, height = self.size, self.height_above
        width = 0.0 if height is None else max(estimates.HEIGHT_DEVIATION * height, estimates.MIN_HEIGHT_DEVIATION)
        prior = ObjectPrior(
            shape=self.shape,
            size=None if size is None else records.Estimate(value=size, deviation=estimates.SIZE_DEVIATION * size),
            stands_on=self.stands_on,
            height=None if height is None else records.Estimate(value=height, deviation=width),
        )
        return None if prior == ObjectPrior() else prior


class Surroundings(Reply):
    """What is around the object."""

    others: Annotated[tuple[SeenObject, ...], Field(max_length=MAX_NAMED + MAX_OBSTACLES)]
    complete: bool | None = None


class Line(Reply):
    """The direction of motion in the reply: `direction`, asked for as two points, in px of the upright image."""

    other_names: ClassVar = {"direction": _DIRECTION_KEYS[1:], "sense": ("along_arrow",)}
    cue: Annotated[records.Cue | None, WithJsonSchema(replies.one_of(*CUES))]
    sense: Annotated[bool | None, WithJsonSchema(replies.nullable(replies.one_of(_WITH, _AGAINST)))]
    camera: Annotated[estimates.CameraSense | None, _CAMERA]
    direction: Annotated[Ends | None, WithJsonSchema({replies.POINTS: ["start", "end"]})]
    depth_degrees: estimates.DepthDegrees = None  # out of the image plane, positive away from the camera
    speed: estimates.KnownSpeed = None

    @field_validator("cue", mode="before")
    @classmethod
    def _read_cue(cls, written: object) -> records.Cue | None:
        said = replies.text_of(written).lower()
        return next((cue for word, cue in _CUE_WORDS.items() if word in said), None)

    @field_validator("sense", mode="before")
    @classmethod
    def _read_sense(cls, written: object, info: ValidationInfo) -> bool | None:
        """Whether the motion follows the arrow; null where the reply says nothing of it."""
        if isinstance(written, bool):
            return written
        said = {_SENSES[word] for word in replies.text_of(written).lower().split() if word in _SENSES}
        if len(said) != 1 and not replies.is_none(written):
            estimates.context_of(info).faults.append(f"`sense` is {replies.shown(written)}, not 'with' or 'against'")
        return said.pop() if len(said) == 1 else None

    @field_validator("direction", mode="before")
    @classmethod
    def _read_direction(cls, written: object, info: ValidationInfo) -> Ends | None:
        if replies.is_none(written) or replies.text_of(written).lower() == "unknown":
            return None
        if info.data.get("cue", "") is None and not any(replies.listed(written)):
            return None  # zeros: how some models that see no direction fill the field
        if isinstance(written, str) and not re.search(r"\d", written):
            raise ReplyError(f"the direction is given in words ('{written[:40]}'); give the points `start` and `end`")
        return estimates.frame_of(info).ends(written)


@dataclass(frozen=True)
class Located:
    """Where the object is (px of the upright image) and which way it moves; parts that were not asked for are None.

    A reply may give a point instead of a box. `label` is what the reply calls it.
    """

    bbox: BBox | None = None
    point: Point | None = None
    label: str = ""
    others: tuple[LocatedObject, ...] = ()
    objects_complete: bool = False  # the others are all that could be hit or hide something
    prior: ObjectPrior | None = None
    line: Line | None = None
    warnings: tuple[str, ...] = ()  # of what was left out

    @property
    def line_hints(self) -> dict[str, Any]:
        """Fields of `MotionHints` that the line says; none without one."""
        line = self.line
        if line is None:
            return {}
        fields = ("cue", "camera", "depth_degrees", "speed")
        return {"ends": line.direction, "along_arrow": line.sense} | {name: getattr(line, name) for name in fields}


@dataclass(frozen=True)
class WrittenPlace:
    """Box and point as they were written, what the reply calls them, and the object in which they stand."""

    label: str
    box: Any
    point: Any = None
    fields: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def is_unseen(self) -> bool:
        """Whether the reply says that it does not see the object."""
        return replies.is_none(self.box) and replies.is_none(self.point)


def locate_call(
    given: ReaderInput,
    image: EncodedImage,
    name: str,
    bbox: BBox | None,
    others: Sequence[str],
    wants_direction: bool,
    reasoning_length: int,
) -> PromptCall[Located | None]:
    """The call that asks where the object `name` is, unless its box is known, and which way it moves."""
    frame, wants_box = image.coordinate_frame, bbox is None
    inputs: dict[str, object] = {
        "question": given.question,
        "object": " ".join(name.split()),
        "others": tuple(others),
        "bbox": "" if bbox is None else str(frame.write((bbox[0], bbox[1]), (bbox[2], bbox[3]))),
        "units": frame.units,
        "box_key": frame.coordinates.box,
        "box_order": frame.box_order,
        "point_order": frame.point_order,
        "wants_box": wants_box,
        "wants_direction": wants_direction,
        "max_obstacles": MAX_OBSTACLES,
        "objections": tuple(" ".join(each.split()) for each in given.objections),
    }
    schema = locate_schema(frame, wants_box, wants_direction, reasoning_length)
    read = partial(
        read_located, frame=frame, wanted=name, others=others, wants_box=wants_box, wants_direction=wants_direction
    )
    return PromptCall("locate", inputs, (image.jpeg,), schema, read)


def locate_schema(
    frame: CoordinateFrame, wants_box: bool, wants_direction: bool, reasoning_length: int
) -> replies.Schema:
    """JSON schema of the reply."""
    kinds = (*((SeenObject, Surroundings) if wants_box else ()), *((Line,) if wants_direction else ()))
    box_key = frame.coordinates.box
    return replies.schema_of(*kinds, reasoning_length=reasoning_length, numbers=frame.numbers, box_key=box_key)


def read_located(
    reply: str, frame: CoordinateFrame, wanted: str, others: Sequence[str], wants_box: bool, wants_direction: bool
) -> Located | None:
    """What a reply says of the object `wanted`; None if it says that it does not see it. Raises `ReplyError`.

    `others` are the things that the question names besides.
    """
    said = replies.without_thinking(reply)
    values = replies.values_in(said)
    places = [place for value in values for place in _places(value, frame)] or list(_places_in_prose(said))
    place = _choose_place(places, values, frame, wanted, others) if wants_box else None
    if wants_box and place is None:
        return None
    context, line = PlacesContext(frame=frame), None
    if wants_direction:
        try:
            line = _read_line(values, said, context)
        except ReplyError as error:  # what is drawn or said may tell the direction as well
            context.faults.append(str(error))
    located = Located(line=line)
    if place is not None:
        located = replace(_read_objects(values, place, places, wanted, others, context), line=line)
    located = replace(located, warnings=context.left_out)
    if context.faults:
        raise ReplyError("; ".join(context.faults), located)
    return located


def _read_objects(
    values: Sequence[object],
    place: WrittenPlace,
    places: Sequence[WrittenPlace],
    wanted: str,
    others: Sequence[str],
    context: PlacesContext,
) -> Located:
    """The object at its `place` and the others: those of the reply's list, else the rest of its `places`.

    What cannot be read of the others is a fault, and the list is not complete then.
    """
    frame = context.frame
    reply = list(replies.objects_in(list(values), "others"))
    lists = [fields["others"] for fields in reply if "others" in fields]
    rest = [each for each in places if each != place and not replies.is_none(each.box)]
    around, is_whole = _read_others(lists[-1], context) if lists else (rest, True)
    if others and not lists and not around:
        context.faults.append(f"`others` is missing, with the boxes of {', '.join(others)}")
    named = list(_named(around, others, context))
    names = [wanted, *(name for name, _, _ in named)]

    def seen(name: str, found: WrittenPlace) -> SeenObject:
        own = replace(context, owner=name, others=names)  # with the same lists of warnings and faults
        return SeenObject.model_validate({**found.fields, "label": found.label, "bbox": found.box}, context=own)

    mover = seen(wanted, place)
    if mover.bbox is not None and coordinates.covers_image(frame.width, frame.height, mover.bbox):
        raise ReplyError(f"the box of '{wanted}' covers nearly the whole image; give that of the object alone")
    objects: list[LocatedObject] = []
    for name, role, other in named:
        try:
            bbox = (found := seen(name, other)).bbox
        except ReplyError as error:
            context.faults.append(f"the box of '{name}': {error}")
            continue
        if bbox is None:  # words such as "none" in a list
            continue
        if role == "obstacle" and coordinates.covers_image(frame.width, frame.height, bbox):
            context.faults.append(f"the box of '{name}' covers nearly the whole image")
        elif role == "target" and mover.bbox is not None and is_same_object(bbox, mover.bbox):
            context.faults.append(f"'{wanted}' and '{name}' have the same box")
        else:
            objects.append(LocatedObject(object=name, bbox=bbox, role=role, prior=found.prior, source="mllm"))
    told = [replies.truth_of(fields["complete"]) for fields in reply if "complete" in fields]
    is_complete = told[-1] is True if told else len(objects) >= MIN_COMPLETE_LIST
    return Located(
        bbox=mover.bbox,
        point=frame.point(place.point) if mover.bbox is None else None,
        label=place.label,
        others=tuple(objects),
        objects_complete=is_complete and is_whole and len(objects) == len(named),
        prior=mover.prior,
    )


def _read_others(written: object, context: PlacesContext) -> tuple[list[WrittenPlace], bool]:
    """The places of a list, or of an object with boxes by name; and whether every entry has one."""
    fields, is_whole = replies.fields_of(written), True
    entries = [("", each) for each in replies.listed(written)]
    if fields and fields.keys().isdisjoint((context.frame.coordinates.box, *BOX_KEYS, *_LABEL_KEYS)):
        entries = [(str(name), box) for name, box in cast("dict[object, object]", written).items()]
    found: list[WrittenPlace] = []
    for name, entry in entries:
        places = list(_places(entry, context.frame, name))
        usable = [place for place in places if place.label and not replies.is_none(place.box)]
        found += usable
        is_whole = is_whole and bool(usable)
        if not usable and not replies.is_none(entry) and not any(place.is_unseen for place in places):
            context.faults.append(f"`others` has {replies.shown(entry)}, without a label and a box")
    return found, is_whole


def separate_objects(
    mover: LocatedObject, others: Sequence[LocatedObject]
) -> tuple[tuple[LocatedObject, ...], tuple[str, ...]]:
    """The others without those that have the box of the mover or of one before them, and with few obstacles.

    A warning reports each that is dropped, unless it is the mover under its own name.
    """
    kept: list[LocatedObject] = []
    warnings: list[str] = []
    for other in others:
        if is_same_object(other.bbox, mover.bbox) and same_name(other.object, mover.object):
            continue
        if is_among(other.bbox, [mover.bbox, *(each.bbox for each in kept)]):
            warnings.append(f"The reader's box of '{other.object}' was left out: it is that of another object.")
        elif other.role == "obstacle" and sum(each.role == "obstacle" for each in kept) >= MAX_OBSTACLES:
            warnings.append(f"The reader's box of '{other.object}' was left out: at most {MAX_OBSTACLES} are taken.")
        else:
            kept.append(other)
    return tuple(kept), tuple(warnings)


def _choose_place(
    places: Sequence[WrittenPlace],
    values: Sequence[object],
    frame: CoordinateFrame,
    wanted: str,
    others: Sequence[str],
) -> WrittenPlace | None:
    """The place that the reply gives for the object; None if it says that it does not see it."""
    if not places:
        if any(map(replies.is_none, values)):
            return None
        raise ReplyError(
            f"`{frame.coordinates.box}` is missing; give the box of '{wanted}', or null if it is not there"
        )
    distinct = list({repr((place.box, place.point)): place for place in places}.values())
    if len(distinct) > 1:
        meant = replies.name_words(wanted)
        named = [place for place in distinct if replies.name_words(place.label) == meant]
        if not named:
            shared = [len(set(replies.name_words(place.label)) & set(meant)) for place in distinct]
            named = [place for place, count in zip(distinct, shared, strict=True) if count == max(shared) > 0]
        if len(named) != 1:
            labels = ", ".join(f"'{place.label}'" for place in distinct)
            raise ReplyError(f"{len(distinct)} places are given ({labels}); give one box, that of '{wanted}'")
        distinct = named
    (place,) = distinct
    if place.is_unseen:
        return None
    if replies.name_words(place.label) in map(replies.name_words, others):
        raise ReplyError(f"the box is that of '{place.label}'; give that of '{wanted}'")
    return place


def _places(value: object, frame: CoordinateFrame, name: str = "") -> Iterator[WrittenPlace]:
    """Places in a value with their names, from a separate field or from the field that holds them."""
    if isinstance(value, list):
        parts = replies.listed(value)
        if parts and all(map(replies.is_number, parts)):
            yield WrittenPlace(name, parts) if len(parts) == 4 else WrittenPlace(name, None, parts)
        for part in parts:
            if isinstance(part, dict | list):
                yield from _places(part, frame, name)
    fields = replies.fields_of(value)
    boxes, points = (frame.coordinates.box, *BOX_KEYS), (frame.coordinates.point, *POINT_KEYS)
    has_place = not fields.keys().isdisjoint((*boxes, *points))
    if has_place or coordinates.names_corners(fields):
        label = next((label for key in _LABEL_KEYS if (label := replies.text_of(fields.get(key)))), name)
        box = replies.first_of(fields, *boxes) if has_place else value
        yield WrittenPlace(label, box, replies.first_of(fields, *points), fields)
        return
    for key, held in fields.items():
        if isinstance(held, dict | list) and key not in ("others", *_DIRECTION_KEYS):
            yield from _places(held, frame, name if key in _HEADINGS else key.replace("_", " "))


def _places_in_prose(said: str) -> Iterator[WrittenPlace]:
    """Places between tags, as some families write them in prose; else numbers in brackets, where they are alone."""
    for found in _BOX_TAG.finditer(said):
        yield WrittenPlace((found["label"] or "").strip(), found["box"])
    for found in _POINT_TAG.finditer(said):
        yield WrittenPlace((found["label"] or "").strip(), None, found["point"])
    if "<" in said:
        return
    pairs, four = re.findall(_PAIR, said), _FOUR.fullmatch(said.strip(" ."))
    if four is not None:
        yield WrittenPlace("", list(four.groups()))
    elif len(pairs) == 2 and (corners := _CORNER_PAIRS.search(said)):
        yield WrittenPlace("", list(corners.groups()))
    elif len(pairs) == 1:
        yield WrittenPlace("", None, list(pairs[0]))


def _named(
    places: Sequence[WrittenPlace], targets: Sequence[str], context: PlacesContext
) -> Iterator[tuple[str, records.ObjectRole, WrittenPlace]]:
    """Each place with its name and role: the targets, each once, then all the rest but the floor."""
    left = list(places)
    for target in targets:
        label = replies.named_among(target, [place.label for place in left])
        meant = [place for place in left if label and replies.name_words(place.label) == replies.name_words(label)]
        if len({repr(place.box) for place in meant}) > 1:
            context.faults.append(f"{len(meant)} things are labelled '{target}'; label only the one that is meant so")
            continue
        for place in meant[:1]:
            left = [other for other in left if other is not place]
            yield target, "target", place
    for place in left:
        label = replies.text_of(place.label)[:MAX_LABEL]
        if label and estimates.support_named(label, "", ()) != estimates.FLOOR:
            yield label, "obstacle", place


def _read_line(values: Sequence[object], said: str, context: PlacesContext) -> Line:
    """The one line that a reply gives. Raises `ReplyError` if it gives none, several, or one that cannot be."""
    written = [fields for value in values for fields in _line_fields(value)]
    if not written and not values and "<" not in said and (corners := _CORNER_PAIRS.search(said)):
        written = [{"direction": list(corners.groups())}]
    lines = [Line.model_validate(fields, context=context) for fields in written]
    if not lines:
        raise ReplyError("the direction is missing; give `start` and `end`, or null for both")
    for one, other in itertools.pairwise(lines):
        if one.direction is None or other.direction is None:
            same = one.direction == other.direction and one.camera == other.camera
        else:
            gaps = map(math.dist, one.direction, other.direction)
            same = all(gap <= coordinates.LEAST_LENGTH for gap in gaps)
        if not same:
            raise ReplyError("several directions are given; give one")
    line = max(lines, key=lambda line: (line.cue is not None, line.camera is not None))

    # The line is either straight towards or away (`camera`), or at an angle (`direction` and `depth_degrees`).
    if line.depth_degrees is not None:
        sense: estimates.CameraSense = "away" if line.depth_degrees > 0 else "towards"
        steep = abs(line.depth_degrees) >= STEEP
        if line.camera is not None:
            oblique = line.direction is not None and not steep
            line = line.model_copy(update={"camera": None} if oblique else {"depth_degrees": None})
        elif steep and (line.direction is None or _leads(line.direction, sense)):
            line = line.model_copy(update={"camera": sense, "depth_degrees": None})
    if line.direction is not None and line.camera is not None and not _leads(line.direction, line.camera):
        raise ReplyError(
            "the points and `camera` disagree; `camera` is for what moves straight towards or away from it, else null"
        )
    return line


def _line_fields(value: object) -> Iterator[dict[str, Any]]:
    """The fields of each line in a value, without headings and lists around it."""
    if isinstance(value, list):
        parts = replies.listed(value)
        if len(parts) == 4 and all(map(replies.is_number, parts)):
            yield {"direction": parts}
        for part in parts:
            if isinstance(part, dict):
                yield from _line_fields(part)
    fields = replies.fields_of(value)
    if not fields.keys().isdisjoint(_DIRECTION_KEYS):
        yield fields
    elif {"start", "end"} <= fields.keys():
        points = fields["start"], fields["end"]
        yield fields | {"direction": None if all(map(replies.is_none, points)) else list(points)}
    else:
        for key, held in fields.items():
            if isinstance(held, dict) and key not in {"others", *BOX_KEYS, *POINT_KEYS}:
                yield from _line_fields(held)


def _leads(ends: Ends, camera: estimates.CameraSense) -> bool:
    """Whether a line in the image can be that of something that moves straight towards or away from the camera."""
    (x0, y0), (x1, y1) = ends
    down = 1 if camera == "towards" else -1
    return abs(math.degrees(math.atan2(x1 - x0, down * (y1 - y0)))) <= STRAIGHT


class Scale(Reply):
    """How large the scene is at an object that falls, and which way things fall."""

    other_names: ClassVar = {"metres": ("meters", "length")}
    reference: Annotated[str | None, BeforeValidator(replies.name_of)]
    metres: Annotated[estimates.Size, WithJsonSchema(replies.nullable(replies.number(*estimates.SIZES)))]
    ends: Annotated[Ends | None, _COORDINATES]
    down: Annotated[str | None, *estimates.word(_SIDES), WithJsonSchema(replies.nullable(replies.one_of(*DOWN)))]

    @field_validator("ends", mode="before")
    @classmethod
    def _read_ends(cls, written: object, info: ValidationInfo) -> Ends | None:
        if replies.is_none(written) or info.data.get("metres") is None:
            return None
        ends = estimates.frame_of(info).ends(written)
        if math.dist(*ends) < LEAST_SPAN:
            raise ReplyError("`ends` are too close to measure by; take a longer thing")
        return ends

    @property
    def metres_per_pixel(self) -> records.MetresPerPixel | None:
        """Null if nothing was known of any size."""
        if self.metres is None or self.ends is None:
            return None
        span = math.dist(*self.ends)
        note = f"{self.reference or 'an object of known size'}: {self.metres:g} m over {span:.0f} px"
        return records.MetresPerPixel(value=self.metres / span, source="reference", note=note)


def scale_call(image: EncodedImage, name: str, reasoning_length: int) -> PromptCall[Scale]:
    """The call that asks how large the scene is at the object `name`, and which way is down."""
    frame = image.coordinate_frame
    inputs: dict[str, object] = {"object": " ".join(name.split()), "units": frame.units, "line_order": frame.line_order}
    schema = replies.schema_of(Scale, reasoning_length=reasoning_length, numbers=frame.numbers)
    return PromptCall("scale", inputs, (image.jpeg,), schema, partial(read_scale, frame=frame))


def read_scale(reply: str, frame: CoordinateFrame) -> Scale:
    """What a reply says of the scale. Raises `ReplyError`."""
    values = replies.values_in(replies.without_thinking(reply))
    objects = [fields for fields in map(replies.fields_of, values) if "ends" in fields]
    if not objects:
        raise ReplyError("`ends` and `metres` are missing; give both, or null for both")
    if len(objects) > 1:
        raise ReplyError("several references are given; give one")
    context = PlacesContext(frame=frame)
    scale = Scale.model_validate(objects[0], context=context)
    if context.warnings:
        raise ReplyError(" ".join(context.warnings).rstrip("."))
    return scale
