"""Places in a reply: boxes and points with what they are called, from JSON, tags or bare numbers in brackets."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from cow_service.readers.mllm.coordinates import NUMBER, CoordinateFrame, names_corners
from cow_service.readers.mllm.replies import ReplyError, fields_of, first_of, is_number, name_words, text_of

BOX_KEYS = ("bbox_2d", "box_2d", "bbox", "box", "bounding_box", "boundingbox", "bbox2d")
POINT_KEYS = ("point_2d", "point", "center", "centre", "point2d")
NO_PLACES = ("others", "direction", "motion_direction", "line", "vector")  # lists of numbers that are none
_LABEL_KEYS = ("label", "object", "name", "class")
# An object under one of these headings has no name yet.
_HEADINGS = frozenset({
    "objects", "object", "result", "results", "answer", "data", "detections", "detection", "location", "locations",
    "output", "response", "places", "items", "boxes", "bboxes", "final_result", "grounding",
})  # fmt: skip
_PAIR = rf"\(\s*({NUMBER})\s*,\s*({NUMBER})\s*\)"
_LABEL_TAG = r"(?:<(?:\|object_ref_start\||ref)>(?P<label>[^<]*)<(?:\|object_ref_end\||/ref)>\s*)?"
_BOX_TAG = re.compile(
    rf"{_LABEL_TAG}<(?:\|box_start\||b?box)>\s*(?P<box>[^<]*?)\s*<(?:\|box_end\||/b?box)>", re.IGNORECASE
)
_POINT_TAG = re.compile(
    rf"{_LABEL_TAG}<(?:\|point_start\||point)>\s*(?P<point>[^<]*?)\s*<(?:\|point_end\||/point)>", re.IGNORECASE
)
# Two pairs are corners where nothing but these stands between; in a sentence they may be two objects.
CORNER_PAIRS = re.compile(rf"{_PAIR}\s*(?:,|-|–|→|to|and|through)?\s*{_PAIR}")
_FOUR = re.compile(rf"[(\[]?\s*({NUMBER})\s*,\s*({NUMBER})\s*,\s*({NUMBER})\s*,\s*({NUMBER})\s*[)\]]?")


@dataclass(frozen=True)
class Place:
    """Box and point as they were written, what the reply calls them, and the object in which they stand."""

    label: str
    box: Any
    point: Any
    fields: Mapping[str, Any] = field(default_factory=dict[str, Any])


def places_in(value: object, frame: CoordinateFrame, name: str = "") -> Iterator[Place]:
    """Places in a value, each with what it is called: by a field of its own, or by the field in which it stands."""
    if isinstance(value, list):
        held = cast("list[object]", value)
        if held and all(is_number(part) for part in held):
            yield Place(name, held, None) if len(held) == 4 else Place(name, None, held)
        for part in held:
            if isinstance(part, dict | list):
                yield from places_in(part, frame, name)
    fields = fields_of(value)
    boxes, points = (frame.coordinates.box, *BOX_KEYS), (frame.coordinates.point, *POINT_KEYS)
    named = any(key in fields for key in (*boxes, *points))
    if named or names_corners(fields):
        label = next((label for key in _LABEL_KEYS if (label := text_of(fields.get(key)))), name)
        yield Place(label, first_of(fields, *boxes) if named else value, first_of(fields, *points), fields)
        return
    for key, held in fields.items():
        if isinstance(held, dict | list) and key not in NO_PLACES:
            yield from places_in(held, frame, name if key in _HEADINGS else key.replace("_", " "))


def tagged_places(said: str) -> Iterator[Place]:
    """Places between tags, as some families write them in prose; else numbers in brackets, where they are alone."""
    for found in _BOX_TAG.finditer(said):
        yield Place((found["label"] or "").strip(), found["box"], None)
    for found in _POINT_TAG.finditer(said):
        yield Place((found["label"] or "").strip(), None, found["point"])
    if "<" in said:
        return
    pairs, four = re.findall(_PAIR, said), _FOUR.fullmatch(said.strip(" ."))
    if four is not None:
        yield Place("", list(four.groups()), None)
    elif len(pairs) == 2 and (corners := CORNER_PAIRS.search(said)):
        yield Place("", list(corners.groups()), None)
    elif len(pairs) == 1:
        yield Place("", None, list(pairs[0]))


def chosen(places: Sequence[Place], wanted: str) -> Place:
    """The place that is meant: the only one, or the one whose label says so."""
    distinct = list({repr((place.box, place.point)): place for place in places}.values())
    if len(distinct) == 1:
        return distinct[0]
    named = [place for place in distinct if name_words(place.label) == name_words(wanted)]
    if not named:
        shared = [len(set(name_words(place.label)) & set(name_words(wanted))) for place in distinct]
        named = [place for place, count in zip(distinct, shared, strict=True) if count == max(shared) > 0]
    if len(named) != 1:
        labels = ", ".join(f"'{place.label}'" for place in distinct)
        raise ReplyError(f"{len(distinct)} places are given ({labels}); give one box, that of '{wanted}'")
    return named[0]
