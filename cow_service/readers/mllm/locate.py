"""Second prompt: where the object and others are, and which way it moves; third prompt: the scale."""

import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from cow_service import records
from cow_service.media.masks import is_among, is_same_object
from cow_service.narration.words import same_name
from cow_service.physics.camera import depth_motion
from cow_service.readers.base import ReaderInput, ReadResult
from cow_service.readers.mllm import coordinates, replies
from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.coordinates import NUMBER, CoordinateFrame, EncodedImage
from cow_service.readers.mllm.quantities import ReadingContext, positive
from cow_service.readers.mllm.replies import ReplyError

BOX_KEYS = ("bbox_2d", "box_2d", "bbox", "box", "bounding_box", "boundingbox", "bbox2d")
POINT_KEYS = ("point_2d", "point", "center", "centre", "point2d")
MAX_OBSTACLES = 12
MIN_COMPLETE_LIST = 2  # things in a list that is taken for complete, as it was asked for, where the reply does not say
MAX_LABEL = 80  # characters
STRAIGHT = 60.0  # degrees from the image's vertical, within which a line can also lead towards or away
LEAST_SIZE, LARGEST_SIZE = 0.001, 1000.0  # m: what is smaller or larger is not seen in a picture as one thing
DOWN: dict[str, records.Vector] = {"bottom": (0.0, 1.0), "top": (0.0, -1.0), "left": (-1.0, 0.0), "right": (1.0, 0.0)}
_SIDES = DOWN | {"down": DOWN["bottom"], "below": DOWN["bottom"], "up": DOWN["top"], "above": DOWN["top"]}
_LISTS = ("objects", "others")  # `others`: without what moves
_LABEL_KEYS = ("label", "object", "name", "class")
_DIRECTION_KEYS = ("direction", "motion_direction", "line", "vector")
# An object under one of these headings has no name yet.
_HEADINGS = frozenset({
    *_LISTS, "object", "result", "results", "answer", "data", "detections", "detection", "location", "locations",
    "output", "response", "places", "items", "boxes", "bboxes", "final_result", "grounding",
})  # fmt: skip
# The plane on which the things of a picture stand, be it that of a room, a street or a table.
_FLOOR = frozenset({
    "floor", "ground", "surface", "table top", "tabletop", "table surface", "desk top", "countertop",
    "counter top", "worktop", "ground plane", "ground surface", "floor surface", "flat surface", "road", "street",
    "pavement", "grass", "lawn", "carpet",
    "boden", "fußboden", "fussboden", "erde", "tischplatte", "sol", "plancher", "suelo", "piso", "pavimento", "chão",
    "пол", "земля", "地面", "地板", "桌面", "床面",
})  # fmt: skip
_ARTICLES = frozenset({"der", "die", "das", "le", "la", "l", "el", "il", "lo", "o"})
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
SENSES = {  # what `sense` may be, and words for it
    "with": {"with", "along", "same", "forward"},
    "against": {"against", "opposite", "reverse", "reversed", "backward"},
    "trail": {"trail"},
    "towards": {"towards", "toward"},
    "away": {"away"},
}
CameraSense = Literal["towards", "away"]
CAMERA_SENSE: dict[CameraSense, float] = {"towards": -1.0, "away": 1.0}
Ends = tuple[records.Point, records.Point]  # of a line, px of the upright image


@dataclass(frozen=True)
class Line:
    """The direction of motion in a reply; null is what it does not say."""

    ends: Ends | None = None
    along_arrow: bool | None = None
    camera: CameraSense | None = None
    cue: records.Cue | None = None

    @property
    def motion(self) -> records.MotionRequest:
        """As a request says it."""
        direction, depth = None, 0.0
        if self.camera is not None:
            direction, depth = depth_motion(CAMERA_SENSE[self.camera])
        elif self.ends is not None:
            (x0, y0), (x1, y1) = self.ends
            direction = x1 - x0, y1 - y0
        return records.MotionRequest(direction=direction, depth=depth, cue=self.cue, along_arrow=self.along_arrow)


@dataclass(frozen=True)
class WrittenPlace:
    """Box and point as they were written, and what the reply calls them."""

    label: str
    box: Any
    point: Any = None

    @property
    def is_unseen(self) -> bool:
        """Whether the reply says that it does not see the object."""
        return replies.is_none(self.box) and replies.is_none(self.point)


def locate_call(
    given: ReaderInput,
    image: EncodedImage,
    name: str,
    bbox: records.BBox | None,
    others: Sequence[str],
    wants_direction: bool,
    reasoning_length: int,
) -> PromptCall[ReadResult | None]:
    """The call that asks where the object `name` is, unless its box is known, and which way it moves."""
    frame, wants_box = image.coordinate_frame, bbox is None
    inputs: dict[str, object] = {
        "question": given.question,
        "object": " ".join(name.split()),
        "others": tuple(others),
        "bbox": "" if bbox is None else str(frame.write_box(bbox)),
        "units": frame.units,
        "box_key": frame.coordinates.box,
        "box_order": frame.box_order,
        "point_order": frame.point_order,
        "wants_box": wants_box,
        "wants_direction": wants_direction,
        "max_obstacles": MAX_OBSTACLES,
        "objections": tuple(" ".join(each.split()) for each in given.objections),
        "example": json.dumps(_example(frame, wants_box, wants_direction)),
    }
    schema = locate_schema(frame, wants_box, wants_direction, reasoning_length)
    read = partial(
        read_located, frame=frame, wanted=name, others=others, wants_box=wants_box, wants_direction=wants_direction
    )
    return PromptCall("locate", inputs, (image.jpeg,), schema, read)


def _example(frame: CoordinateFrame, wants_box: bool, wants_direction: bool) -> dict[str, Any]:
    """A reply as it is wanted, in the form on which models that find things are trained: a list of labelled boxes."""

    wide, high = frame.width, frame.height
    boxes = {
        "red ball": (0.2 * wide, 0.5 * high, 0.3 * wide, 0.6 * high),
        "vase": (0.7 * wide, 0.3 * high, 0.8 * wide, 0.6 * high),
    }
    reply: dict[str, Any] = {"reasoning": "..."}
    if wants_box:
        reply["objects"] = [
            {frame.coordinates.box: frame.write_box(box), "label": label} for label, box in boxes.items()
        ]
    if wants_direction:
        start, end = (0.25 * wide, 0.55 * high), (0.9 * wide, 0.55 * high)
        reply |= {"start": frame.write(start), "end": frame.write(end), "sense": "with"}
    return reply


def locate_schema(
    frame: CoordinateFrame, wants_box: bool, wants_direction: bool, reasoning_length: int
) -> replies.Schema:
    """JSON schema of the reply."""
    fields: dict[str, replies.Schema] = {}
    if wants_box:
        place = replies.closed({frame.coordinates.box: frame.schema(4), "label": {"type": "string"}})
        fields["objects"] = {"type": "array", "items": place}
    if wants_direction:
        point = replies.nullable(frame.schema(2))
        fields |= {"start": point, "end": point, "sense": replies.nullable(replies.one_of(*SENSES))}
    return replies.schema_of(fields, reasoning_length=reasoning_length)


def read_located(
    reply: str, frame: CoordinateFrame, wanted: str, others: Sequence[str], wants_box: bool, wants_direction: bool
) -> ReadResult | None:
    """What a reply says of the object `wanted`; None if it says that it does not see it. Raises `ReplyError`.

    `others` are the things that the question names besides.
    """
    said = replies.without_thinking(reply)
    values = replies.values_in(said)
    places = [place for value in values for place in _places(value, frame)] or list(_places_in_prose(said))
    place = _choose_place(places, values, frame, wanted, others) if wants_box else None
    if wants_box and place is None:
        return None
    context, motion, reading = ReadingContext(), None, records.Reading()
    if wants_direction:
        try:
            motion = _read_line(values, said, frame, context).motion
        except ReplyError as error:  # what is drawn or said may tell the direction as well
            context.faults.append(str(error))
    if place is not None:
        reading = _read_objects(values, place, places, frame, wanted, others, context)
    reading = reading.model_copy(update={"motion": motion})
    read = ReadResult(reading, context.left_out, "" if place is None else place.label)
    if context.faults:
        raise ReplyError("; ".join(context.faults), read)
    return read


def _read_objects(
    values: Sequence[object],
    place: WrittenPlace,
    places: Sequence[WrittenPlace],
    frame: CoordinateFrame,
    wanted: str,
    others: Sequence[str],
    context: ReadingContext,
) -> records.Reading:
    """The object at its `place`, and the rest of the `places`.

    What cannot be read of the rest is a fault, and the list is not complete then.
    """
    fields = list(replies.objects_in(list(values), *_LISTS))
    rest = [each for each in places if each != place and not replies.is_none(each.box)]
    is_whole = _check_entries(fields, place, frame, context)
    if others and not rest and not any("others" in held for held in fields):
        context.faults.append(f"`objects` lacks the boxes of {', '.join(others)}")
    bbox = None if replies.is_none(place.box) else frame.bbox(place.box)
    if bbox is not None and coordinates.covers_image(frame.width, frame.height, bbox):
        raise ReplyError(f"the box of '{wanted}' covers nearly the whole image; give that of the object alone")
    point = frame.point(place.point) if bbox is None else None
    mover = records.GroundingRequest(object=wanted, bbox=bbox, point=point)
    named = list(_named(rest, others, context))
    objects = tuple(_boxed(named, mover, frame, context))
    told = [replies.truth_of(held["complete"]) for held in fields if "complete" in held]
    is_complete = told[-1] is True if told else len(objects) >= MIN_COMPLETE_LIST
    is_complete = is_complete and is_whole and len(objects) == len(named)
    return records.Reading(grounding=mover, objects=objects, objects_complete=is_complete)


def _check_entries(
    fields: Sequence[Mapping[str, Any]], place: WrittenPlace, frame: CoordinateFrame, context: ReadingContext
) -> bool:
    """Whether each entry of the lists has a label and a box; a fault for each that has none of them."""
    is_whole = True
    for entry in (each for held in fields for key in _LISTS for each in replies.listed(held.get(key))):
        found = list(_places(entry, frame))
        if any(each == place or (each.label and not replies.is_none(each.box)) for each in found):
            continue
        is_whole = False
        if not replies.is_none(entry) and not any(each.is_unseen for each in found):
            context.faults.append(f"`objects` has {replies.shown(entry)}, without a label and a box")
    return is_whole


def _boxed(
    named: Sequence[tuple[str, records.ObjectRole, WrittenPlace]],
    mover: records.GroundingRequest,
    frame: CoordinateFrame,
    context: ReadingContext,
) -> Iterator[records.ObjectRequest]:
    """The other things whose boxes can be used; a fault for each of the rest."""
    for name, role, place in named:
        try:
            box = frame.bbox(place.box)
        except ReplyError as error:
            context.faults.append(f"the box of '{name}': {error}")
            continue
        if role == "obstacle" and coordinates.covers_image(frame.width, frame.height, box):
            context.faults.append(f"the box of '{name}' covers nearly the whole image")
        elif role == "target" and mover.bbox is not None and is_same_object(box, mover.bbox):
            context.faults.append(f"'{mover.object}' and '{name}' have the same box")
        else:
            yield records.ObjectRequest(object=name, bbox=box, role=role)


def separate_objects(
    mover: records.GroundingRequest, others: Sequence[records.ObjectRequest]
) -> tuple[tuple[records.ObjectRequest, ...], tuple[str, ...]]:
    """The others without those that have the box of the mover or of one before them, and with few obstacles.

    A warning reports each that is dropped, unless it is the mover under its own name.
    """
    kept: list[records.ObjectRequest] = []
    warnings, boxes = list[str](), [] if mover.bbox is None else [mover.bbox]
    for other in others:
        if other.bbox is None or (is_among(other.bbox, boxes[:1]) and same_name(other.object, mover.object or "")):
            continue
        if is_among(other.bbox, boxes):
            warnings.append(f"The reader's box of '{other.object}' was left out: it is that of another object.")
        elif other.role == "obstacle" and sum(each.role == "obstacle" for each in kept) >= MAX_OBSTACLES:
            warnings.append(f"The reader's box of '{other.object}' was left out: at most {MAX_OBSTACLES} are taken.")
        else:
            kept.append(other)
            boxes.append(other.bbox)
    return tuple(kept), tuple(warnings)


def _choose_place(
    places: Sequence[WrittenPlace], values: Sequence[object], frame: CoordinateFrame, wanted: str, others: Sequence[str]
) -> WrittenPlace | None:
    """The place that the reply gives for the object; None if it says that it does not see it."""
    if not places:
        if any(replies.is_none(replies.fields_of(value).get("objects", value)) for value in values):
            return None
        raise ReplyError(
            f"`{frame.coordinates.box}` is missing; give the box of '{wanted}', or no objects if it is not there"
        )
    distinct = list({repr((place.box, place.point)): place for place in reversed(places)}.values())[::-1]
    if len(distinct) > 1:
        meant = replies.name_words(wanted)
        label = replies.named_among(wanted, [place.label for place in distinct])
        named = [place for place in distinct if replies.name_words(place.label) == replies.name_words(label or wanted)]
        if not named:
            shared = [len(set(replies.name_words(place.label)) & set(meant)) for place in distinct]
            named = [place for place, count in zip(distinct, shared, strict=True) if count == max(shared) > 0]
        lists = [key for fields in replies.objects_in(list(values)) for key in _LISTS if key in fields]
        if len(named) != 1 and len(lists) == 1:  # in which that one comes first
            named = [next(place for place in distinct if not named or place in named)]
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
        yield WrittenPlace(label, box, replies.first_of(fields, *points))
        fields = {key: held for key, held in fields.items() if key in _LISTS}
    for key, held in fields.items():
        if isinstance(held, dict | list) and key not in (*_DIRECTION_KEYS, "start", "end"):
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
    places: Sequence[WrittenPlace], targets: Sequence[str], context: ReadingContext
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
        if label and " ".join(word for word in replies.name_words(label) if word not in _ARTICLES) not in _FLOOR:
            yield label, "obstacle", place


def _read_line(values: Sequence[object], said: str, frame: CoordinateFrame, context: ReadingContext) -> Line:
    """The one line that a reply gives. Raises `ReplyError` if it gives none, several, or one that cannot be."""
    written = [fields for value in values for fields in _line_fields(value)]
    if not written and not values and "<" not in said and (corners := _CORNER_PAIRS.search(said)):
        written = [{"direction": list(corners.groups())}]
    lines = [_line(fields, frame, context) for fields in written]
    if not lines:
        raise ReplyError("the direction is missing; give `start` and `end`, or null for both")
    for one, other in itertools.pairwise(lines):
        if one.ends is None or other.ends is None:
            same = one.ends == other.ends and one.camera == other.camera
        else:
            same = all(gap <= coordinates.LEAST_LENGTH for gap in map(math.dist, one.ends, other.ends))
        if not same:
            raise ReplyError("several directions are given; give one")
    line = max(lines, key=lambda line: (line.cue is not None, line.camera is not None))
    if line.ends is not None and line.camera is not None and not _leads(line.ends, line.camera):
        raise ReplyError(
            "the points and `sense` disagree; `towards` and `away` are for what moves straight towards or away from "
            "the camera"
        )
    return line


def _line(fields: Mapping[str, Any], frame: CoordinateFrame, context: ReadingContext) -> Line:
    """A direction as it was written. Raises `ReplyError` for one in words, or outside the image."""
    written = replies.first_of(dict(fields), *_DIRECTION_KEYS)
    ends = None
    if not (replies.is_none(written) or replies.text_of(written).lower() == "unknown"):
        if isinstance(written, str) and not re.search(r"\d", written):
            raise ReplyError(f"the direction is given in words ('{written[:40]}'); give the points `start` and `end`")
        # Some models that see no direction fill the field with zeros.
        ends = frame.ends(written) if any(replies.listed(written)) else None
    sense, along_arrow, camera, cue = (fields.get(name) for name in ("sense", "along_arrow", "camera", "cue"))
    words = set(re.findall(r"[a-z]+", " ".join(map(replies.text_of, (sense, along_arrow, camera))).lower()))
    is_along = replies.truth_of(sense if along_arrow is None else along_arrow)
    words |= set() if is_along is None else {"with" if is_along else "against"}
    senses = {each for each, synonyms in SENSES.items() if not words.isdisjoint(synonyms)}
    if not senses and not replies.is_none(sense):
        context.faults.append(f"`sense` is {replies.shown(sense)}, not one of {', '.join(SENSES)}")
    along, towards = senses & {"with", "against"}, senses & {"towards", "away"}
    told = f"{replies.text_of(cue).lower()} {'trail' if 'trail' in senses else 'arrow' if along else ''}"
    return Line(
        ends=ends,
        along_arrow="with" in along if len(along) == 1 else None,
        camera=("away" if "away" in towards else "towards") if len(towards) == 1 else None,
        cue="trail" if "trail" in told else "arrow" if "arrow" in told else None,
    )


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


def _leads(ends: Ends, camera: CameraSense) -> bool:
    """Whether a line in the image can be that of something that moves straight towards or away from the camera."""
    (x0, y0), (x1, y1) = ends
    down = 1 if camera == "towards" else -1
    return abs(math.degrees(math.atan2(x1 - x0, down * (y1 - y0)))) <= STRAIGHT


@dataclass(frozen=True)
class Scale:
    """How large an object that falls is, and which way things fall."""

    metres: float | None = None  # its longest side
    down: records.Vector | None = None

    def motion_at(self, bbox: records.BBox | None) -> dict[str, Any]:
        """Fields of a motion, for the object in a box."""
        said: dict[str, Any] = {} if self.down is None else {"down": self.down}
        if self.metres is not None and bbox is not None:
            said["metres_per_pixel"] = self.metres / max(bbox[2] - bbox[0], bbox[3] - bbox[1])
        return said


UNKNOWN_SCALE = Scale()


def scale_call(image: EncodedImage, name: str, reasoning_length: int) -> PromptCall[Scale]:
    """The call that asks how large the object `name` is, and which way is down."""
    fields = {"metres": replies.nullable({"type": "number"}), "down": replies.nullable(replies.one_of(*DOWN))}
    schema = replies.schema_of(fields, reasoning_length=reasoning_length)
    return PromptCall("scale", {"object": " ".join(name.split())}, (image.jpeg,), schema, read_scale)


def read_scale(reply: str) -> Scale:
    """What a reply says of the scale. Raises `ReplyError`."""
    values = replies.values_in(replies.without_thinking(reply))
    objects = [fields for fields in replies.objects_in(list(values)) if "metres" in fields]
    if len(objects) != 1:
        raise ReplyError("`metres` is missing, or given more than once; give one number, or null")
    written, down = objects[0]["metres"], replies.text_of(objects[0].get("down")).lower().strip(" .")
    metres = None if replies.is_none(written) else positive(written, "m")
    if (metres is None and not replies.is_none(written)) or not LEAST_SIZE <= (metres or 1) <= LARGEST_SIZE:
        raise ReplyError(
            f"`metres` is {replies.shown(written)}; give a length from {LEAST_SIZE:g} to {LARGEST_SIZE:g}, or null"
        )
    return Scale(metres, _SIDES.get(down, DOWN["bottom"]))
