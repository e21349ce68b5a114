"""What a reply says of further legs of the motion, and of other things that move at the same time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast, get_args

from cow_service.errors import CannotReadDirection
from cow_service.physics.camera import depth_motion
from cow_service.readers.base import OtherMotionHint, OtherMotionReading, StepReading
from cow_service.readers.mllm.lengths import MAX_QUANTITY, read_distance, read_seconds
from cow_service.readers.mllm.replies import fields_of, first_of, name_words, text_of
from cow_service.readers.mllm.schemas import Schema, object_of, one_of, words
from cow_service.readers.remedies import GIVE_DIRECTION
from cow_service.records import DIRECTED_KINDS, LocatedObject, MotionKind, Vector

MAX_LEGS, MAX_NAME = 4, 120
_DIAGONAL = 0.5**0.5
WAYS: dict[str, tuple[Vector, float]] = {  # direction in the image, and the depth's sense
    "left": ((-1, 0), 0), "right": ((1, 0), 0), "up": ((0, -1), 0), "down": ((0, 1), 0),
    "up-left": ((-_DIAGONAL, -_DIAGONAL), 0), "up-right": ((_DIAGONAL, -_DIAGONAL), 0),
    "down-left": ((-_DIAGONAL, _DIAGONAL), 0), "down-right": ((_DIAGONAL, _DIAGONAL), 0),
    "towards": ((0, 1), -1), "away": ((0, -1), 1),
}  # fmt: skip
_KINDS: tuple[MotionKind, ...] = get_args(MotionKind)
LEG_FIELDS: dict[str, Schema] = {
    "then": {
        "type": "array",
        "items": object_of(
            ("distance", "duration"),
            way=one_of(*WAYS),
            distance=words(MAX_QUANTITY),
            duration=words(MAX_QUANTITY),
        ),
        "maxItems": MAX_LEGS,
    },
    "also_moving": {
        "type": "array",
        "items": object_of(("way",), object=words(MAX_NAME), kind=one_of(*_KINDS), way=one_of(*WAYS)),
        "maxItems": MAX_LEGS,
    },
}  # both optional


@dataclass(frozen=True)
class Legs:
    """Further legs, and other movers."""

    then: tuple[StepReading, ...] = ()
    also: tuple[OtherMotionHint, ...] = ()


NO_LEGS = Legs()


def read_legs(fields: Mapping[str, Any]) -> Legs:
    """Further legs and other movers of a reply; what names no known way, or no object, is left out."""
    then = (_step(value) for value in _listed(fields.get("then")))
    also = (_other(value) for value in _listed(fields.get("also_moving")))
    return Legs(tuple(each for each in then if each), tuple(each for each in also if each))


def located_others(hints: Sequence[OtherMotionHint], others: Sequence[LocatedObject]) -> tuple[OtherMotionReading, ...]:
    """Other movers with their places. Raises `CannotReadDirection` for one that was not found."""
    known = {tuple(name_words(each.object)): each for each in others}
    found: list[OtherMotionReading] = []
    for hint in hints:
        place = known.get(tuple(name_words(hint.object)))
        if place is None:
            raise CannotReadDirection(f"'{hint.object}' moves, too, and was not found. {GIVE_DIRECTION}")
        found.append(OtherMotionReading(place, hint.kind, hint.direction, hint.depth))
    return tuple(found)


def _listed(held: object) -> list[object]:
    return cast("list[object]", held)[:MAX_LEGS] if isinstance(held, list) else [] if held is None else [held]


def _way(fields: dict[str, Any]) -> tuple[Vector, float] | None:
    said = "-".join(text_of(first_of(fields, "way", "direction")).lower().replace("the ", "").split())
    known = WAYS.get(said) or next((WAYS[key] for key in ("towards", "away") if said.startswith(key)), None)
    if known is None:
        return None
    direction, sense = known
    return depth_motion(sense) if sense else (direction, 0.0)


def _step(value: object) -> StepReading | None:
    fields = fields_of(value) if isinstance(value, dict) else {"way": value}
    way = _way(fields)
    if way is None:
        return None
    return StepReading(*way, read_distance(fields.get("distance")), read_seconds(fields.get("duration")))


def _other(value: object) -> OtherMotionHint | None:
    fields = fields_of(value)
    name, way = text_of(first_of(fields, "object", "name", "label"))[:MAX_NAME], _way(fields)
    said = text_of(fields.get("kind")).lower()
    kind: MotionKind = _KINDS[_KINDS.index(said)] if said in _KINDS else "linear"
    if not name or kind == "place" or (kind in DIRECTED_KINDS and way is None):
        return None
    direction, depth = way if way is not None and kind in DIRECTED_KINDS else (None, 0.0)
    return OtherMotionHint(object=name, kind=kind, direction=direction, depth=depth)
