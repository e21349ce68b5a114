"""Second prompt: where the object is, which way it moves, and what tells so."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

from cow_service.readers.coordinates import View
from cow_service.readers.mllm.identify import MAX_OTHERS
from cow_service.readers.mllm.schemas import Schema, nullable, numbers, object_of, one_of, words
from cow_service.readers.replies import ReplyError, fields_of, first_of, text_of, values_in, without_thinking
from cow_service.records import BBox, Cue, LocatedObject, Point

CameraSense = Literal["towards", "away"]
CUES = ("arrow", "trail", "text", "orientation", "none")
MAX_LABEL = 120  # characters

_BOX_KEYS = ("bbox_2d", "box_2d", "bbox", "box", "bounding_box", "boundingbox", "bbox2d")
_POINT_KEYS = ("point_2d", "point", "center", "centre", "point2d")
_DIRECTION_KEYS = ("direction", "motion_direction", "line", "vector")
_LABEL_KEYS = ("label", "object", "name", "class")
_ENDS = (("start", "end"), ("from", "to"), ("tail", "tip"), ("tail", "head"))
_CUE_WORDS: tuple[tuple[str, Cue], ...] = (
    ("arrow", "arrow"),
    ("trail", "trail"),
    ("ghost", "trail"),
    ("orient", "orientation"),
    ("front", "orientation"),
    ("facing", "orientation"),
    ("text", "text"),
    ("question", "text"),
    ("word", "text"),
    ("gravity", "gravity"),
)
_PAIR = r"\(\s*(-?[\d.]+)\s*,\s*(-?[\d.]+)\s*\)"
_BOX_TAG = re.compile(rf"<(?:\|box_start\||box)>\s*{_PAIR}\s*,?\s*{_PAIR}\s*<(?:\|box_end\||/box)>")
_POINT_TAG = re.compile(rf"<(?:\|point_start\||point)>\s*{_PAIR}\s*<(?:\|point_end\||/point)>")
_DETERMINERS = frozenset({"the", "a", "an", "this", "that"})


@dataclass(frozen=True)
class Line:
    """Which way the object moves, as far as the reply tells: `ends` in px of the upright image, or null."""

    ends: tuple[Point, Point] | None
    cue: Cue | None
    along_arrow: bool | None
    camera: CameraSense | None


@dataclass(frozen=True)
class Located:
    """Where the object is (px of the upright image) and which way it moves; parts that were not asked for are None.

    A reply may give a point instead of a box. `label` is what the reply calls it.
    """

    bbox: BBox | None = None
    point: Point | None = None
    label: str = ""
    cut_off: bool = False  # the box reached over the image's edge
    others: tuple[LocatedObject, ...] = ()
    line: Line | None = None


@dataclass(frozen=True)
class _Place:
    label: str
    box: Any
    point: Any


def schema(view: View, others: bool, wants_box: bool, wants_direction: bool, reasoning_length: int) -> Schema:
    """JSON schema of the reply."""
    box_key, box = view.coordinates.box, numbers(view, 4)
    fields: dict[str, Schema] = {"reasoning": words(reasoning_length)}
    if wants_box:
        fields |= {"label": words(MAX_LABEL), box_key: nullable(box)}
        if others:
            item = object_of(**{"label": words(MAX_LABEL), box_key: box})
            fields["others"] = {"type": "array", "items": item, "maxItems": MAX_OTHERS}
    if wants_direction:
        fields |= {
            "cue": one_of(*CUES),
            "along_arrow": nullable({"type": "boolean"}),
            "camera": nullable(one_of("towards", "away")),
            "direction": nullable(numbers(view, 4)),
        }
    return object_of(**fields)


def read_located(
    reply: str, view: View, wanted: str, others: Sequence[str], wants_box: bool, wants_direction: bool
) -> Located | None:
    """What a reply says of the object `wanted`; None where it says that it does not see it. Raises `ReplyError`."""
    said = without_thinking(reply)
    values = values_in(said)
    line = _line(values, view) if wants_direction else None
    if not wants_box:
        return Located(line=line)
    places = [place for value in values for place in _places(value, view)] or list(_tagged(said))
    if not places:
        if any(value in (None, []) for value in values):
            return None
        raise ReplyError(f"`{view.coordinates.box}` is missing; give the box of '{wanted}', or null if it is not there")
    place = _chosen(places, wanted)
    if place.box in (None, []) and place.point in (None, []):
        return None
    if place.box not in (None, []):
        bbox, cut_off = view.bbox(place.box), view.overshoots(place.box)
        return Located(bbox, None, place.label, cut_off, _others(values, view, others), line)
    return Located(None, view.point(place.point), place.label, False, _others(values, view, others), line)


def same_words(one: str, other: str) -> bool:
    """Whether two names are the same but for articles, case and punctuation."""
    return _words(one) == _words(other)


def shares_words(one: str, other: str) -> bool:
    """Whether two names have a word in common."""
    return bool(set(_words(one)) & set(_words(other)))


def _places(value: object, view: View) -> Iterator[_Place]:
    if isinstance(value, list):
        held = cast("list[object]", value)
        if held and all(_is_number(part) for part in held):
            yield _Place("", held, None) if len(held) == 4 else _Place("", None, held)
        for part in held:
            if isinstance(part, dict | list):
                yield from _places(part, view)
    fields = fields_of(value)
    boxes, points = (view.coordinates.box, *_BOX_KEYS), (view.coordinates.point, *_POINT_KEYS)
    if any(key in fields for key in (*boxes, *points)):
        label = next((told for key in _LABEL_KEYS if (told := text_of(fields.get(key)))), "")
        yield _Place(label, first_of(fields, *boxes), first_of(fields, *points))
        return
    for name, held in fields.items():
        if isinstance(held, dict | list) and name not in {"others", *_DIRECTION_KEYS}:
            yield from _places(held, view)


def _tagged(said: str) -> Iterator[_Place]:
    """Places between tags, as some families write them in prose; else bare pairs of numbers in brackets."""
    for found in _BOX_TAG.finditer(said):
        yield _Place("", [float(number) for number in found.groups()], None)
    for found in _POINT_TAG.finditer(said):
        yield _Place("", None, [float(number) for number in found.groups()])
    if "<" not in said:
        pairs = [[float(x), float(y)] for x, y in re.findall(_PAIR, said)]
        if len(pairs) == 2:
            yield _Place("", pairs, None)
        elif len(pairs) == 1:
            yield _Place("", None, pairs[0])


def _chosen(places: Sequence[_Place], wanted: str) -> _Place:
    """The place that is meant: the only one, or the one whose label says so."""
    distinct = list({repr((place.box, place.point)): place for place in places}.values())
    if len(distinct) == 1:
        return distinct[0]
    named = [place for place in distinct if same_words(place.label, wanted)]
    if not named:
        shared = [len(set(_words(place.label)) & set(_words(wanted))) for place in distinct]
        named = [place for place, count in zip(distinct, shared, strict=True) if count == max(shared) > 0]
    if len(named) != 1:
        labels = ", ".join(f"'{place.label}'" for place in distinct)
        raise ReplyError(f"{len(distinct)} places are given ({labels}); give one box, that of '{wanted}'")
    return named[0]


def _others(values: Sequence[object], view: View, wanted: Sequence[str]) -> tuple[LocatedObject, ...]:
    """Boxes of the other objects that were asked for; one that cannot be read is left out."""
    found: dict[str, LocatedObject] = {}
    for value in values:
        for place in _places(fields_of(value).get("others"), view):
            name = next((name for name in wanted if same_words(name, place.label)), None)
            if name is not None and place.box is not None:
                try:
                    found.setdefault(name, LocatedObject(object=name, bbox=view.bbox(place.box)))
                except ReplyError:
                    continue  # the mover matters more than asking for this again
    return tuple(found.values())


def _line(values: Sequence[object], view: View) -> Line:
    lines = [line for value in values for line in _lines(value, view)]
    if not lines:
        raise ReplyError("`direction` is missing; give two points on the line of the motion, or null")
    if any(line != lines[0] for line in lines):
        raise ReplyError("several directions are given; give one")
    return lines[0]


def _lines(value: object, view: View) -> Iterator[Line]:
    if isinstance(value, list):
        held = cast("list[object]", value)
        if len(held) == 4 and all(_is_number(part) for part in held):
            yield Line(view.ends(held), None, None, None)
        elif held and all(isinstance(part, dict) for part in held):
            for part in held:
                yield from _lines(part, view)
    fields = fields_of(value)
    key = next((key for key in _DIRECTION_KEYS if key in fields), None)
    if key is not None:
        told = text_of(fields.get("cue")).lower()
        cue: Cue | None = next((cue for word, cue in _CUE_WORDS if word in told), None)
        along, camera = fields.get("along_arrow"), text_of(fields.get("camera")).lower()
        yield Line(
            ends=None if told == "none" and not fields[key] else _ends(fields[key], view),
            cue=cue,
            along_arrow=along if isinstance(along, bool) else None,
            camera="towards" if "toward" in camera else "away" if "away" in camera else None,
        )


def _ends(written: object, view: View) -> tuple[Point, Point] | None:
    if written is None or written == []:
        return None
    fields = fields_of(written)
    for first, second in _ENDS:
        if first in fields and second in fields:
            return view.ends([fields[first], fields[second]])
    if isinstance(written, str) and not re.search(r"\d", written):
        if written.strip().lower() in {"", "none", "null", "unknown", "n/a"}:
            return None
        raise ReplyError(f"`direction` is given in words ('{written[:40]}'); give two points as four numbers")
    return view.ends(written)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _words(name: str) -> list[str]:
    return [word for word in re.findall(r"\w+", name.lower()) if word not in _DETERMINERS]
