"""What a reply says of changes before the motion, and of how far and how long it goes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast, get_args

from cow_service.errors import ObjectNotFound
from cow_service.readers.base import Quantity, Unit
from cow_service.readers.mllm.coordinates import NUMBER
from cow_service.readers.mllm.replies import fields_of, first_of, is_none, name_words, text_of
from cow_service.readers.mllm.schemas import Schema, nullable, object_of, one_of, words
from cow_service.readers.question.place_relations import RELATION_WORDS
from cow_service.records import Intervention, InterventionKind, LocatedObject, PlaceRelation, Until

MAX_CHANGES = 4
MAX_NAME, MAX_QUANTITY = 120, 40  # characters
KINDS: tuple[InterventionKind, ...] = get_args(InterventionKind)
RELATIONS: tuple[PlaceRelation, ...] = get_args(PlaceRelation)
_KIND_WORDS: dict[str, InterventionKind] = {
    "remove": "remove", "place": "place",
    "removed": "remove", "removal": "remove", "take away": "remove", "put": "place", "placed": "place", "add": "place",
}  # fmt: skip
_UNITS: dict[str, tuple[Unit, float]] = {
    "px": ("px", 1.0), "pixel": ("px", 1.0), "m": ("m", 1.0), "metre": ("m", 1.0), "meter": ("m", 1.0),
    "cm": ("m", 0.01), "centimetre": ("m", 0.01), "centimeter": ("m", 0.01), "mm": ("m", 0.001), "inch": ("m", 0.0254),
}  # fmt: skip
_SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "second": 1.0, "ms": 0.001, "minute": 60.0, "min": 60.0}
_PER_SECOND = re.compile(r"\s*(?:/|per)\s*(?:s|sec|second)$")
_QUANTITY = re.compile(rf"(?P<number>{NUMBER})\s*(?P<unit>[a-z]*)")
CHANGE_FIELDS: dict[str, Schema] = {
    "changes": {
        "type": "array",
        "items": object_of(
            ("relation", "targets"),
            kind=one_of(*KINDS),
            object=words(MAX_NAME),
            relation=one_of(*RELATIONS),
            targets={"type": "array", "items": words(MAX_NAME), "maxItems": 2},
        ),
        "maxItems": MAX_CHANGES,
    },
    "speed": words(MAX_QUANTITY),
    "distance": words(MAX_QUANTITY),
    "duration": words(MAX_QUANTITY),
    "until": nullable(one_of(*get_args(Until))),
}  # all of them optional


@dataclass(frozen=True)
class Change:
    """A change of the scene, in words."""

    kind: InterventionKind
    object: str
    relation: PlaceRelation | None = None
    targets: tuple[str, ...] = ()


@dataclass(frozen=True)
class Lengths:
    """How fast, how far and how long, as far as the question says it."""

    speed: Quantity | None = None
    distance: Quantity | None = None
    duration: float | None = None  # s
    until: Until | None = None


NOT_SAID = Lengths()


def read_changes(fields: Mapping[str, Any]) -> tuple[Change, ...]:
    """The changes that a reply names; what is none, or says not where to, is left out."""
    held = fields.get("changes")
    parts = cast("list[object]", held) if isinstance(held, list) else [held]
    return tuple(change for change in map(_change, parts[:MAX_CHANGES]) if change is not None)


def read_lengths(fields: Mapping[str, Any]) -> Lengths:
    """Numbers with units; what cannot be read is left out."""
    until = text_of(fields.get("until")).lower()
    return Lengths(
        speed=_quantity(fields.get("speed"), per_second=True),
        distance=_quantity(fields.get("distance"), per_second=False),
        duration=_seconds(fields.get("duration")),
        until=next((known for known in cast("tuple[Until, ...]", get_args(Until)) if known == until), None),
    )


def _change(value: object) -> Change | None:
    fields = fields_of(value)
    said = text_of(fields.get("kind")).lower()
    kind = _KIND_WORDS.get(said)
    name = text_of(first_of(fields, "object", "name", "label"))[:MAX_NAME]
    if kind is None or not name:
        return None
    if kind == "remove":
        return Change(kind, name)
    written = text_of(fields.get("relation")).lower().replace("_", "-")
    relation = RELATION_WORDS.get(written)
    held = first_of(fields, "targets", "target")
    named = [text_of(each)[:MAX_NAME] for each in (cast("list[object]", held) if isinstance(held, list) else [held])]
    targets = tuple(each for each in named if each)
    return Change(kind, name, relation, targets) if relation is not None and targets else None


def _quantity(written: object, per_second: bool) -> Quantity | None:
    text = text_of(written).lower().strip(" .")
    plain = _PER_SECOND.sub("", text)
    found = _QUANTITY.fullmatch(plain)
    if is_none(written) or found is None or (plain != text) != per_second:
        return None
    unit = _UNITS.get(found["unit"]) or _UNITS.get(found["unit"].removesuffix("s"))
    number = float(found["number"])
    if unit is None or not number > 0:
        return None
    name, factor = unit
    speeds: dict[Unit, Unit] = {"px": "px/s", "m": "m/s"}
    return Quantity(number * factor, speeds[name] if per_second else name)


def _seconds(written: object) -> float | None:
    found = _QUANTITY.fullmatch(text_of(written).lower().strip(" ."))
    factor = None if found is None else _SECONDS.get(found["unit"], _SECONDS.get(found["unit"].removesuffix("s")))
    seconds = 0.0 if found is None or factor is None else float(found["number"]) * factor
    return seconds if seconds > 0 else None


def names_of(changes: Sequence[Change], mover: str) -> tuple[str, ...]:
    """All things that changes are about, but the mover."""
    named = [name for change in changes for name in (change.object, *change.targets)]
    return tuple(dict.fromkeys(name for name in named if name_words(name) != name_words(mover)))


def located_changes(
    changes: Sequence[Change], mover: LocatedObject, others: Sequence[LocatedObject], missing: str
) -> tuple[Intervention, ...]:
    """The changes with the places of their objects. Raises `ObjectNotFound`, with `missing` and the name put in."""
    known = {tuple(name_words(each.object)): each for each in (mover, *others)}

    def place(name: str) -> LocatedObject:
        found = known.get(tuple(name_words(name)))
        if found is None:
            raise ObjectNotFound(missing.format(name=name))
        return found.model_copy(update={"role": "target"})

    return tuple(
        Intervention(
            kind=change.kind,
            object=place(change.object),
            relation=change.relation,
            targets=tuple(place(name) for name in change.targets),
        )
        for change in changes
    )
