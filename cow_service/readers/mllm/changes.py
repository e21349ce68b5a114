"""What a reply says of changes before the motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast, get_args

from cow_service.errors import ObjectNotFound
from cow_service.readers.mllm.replies import fields_of, first_of, name_words, text_of
from cow_service.readers.mllm.schemas import Schema, object_of, one_of, words
from cow_service.readers.question.place_relations import RELATION_WORDS
from cow_service.records import Intervention, InterventionKind, LocatedObject, PlaceRelation

MAX_CHANGES = 4
MAX_NAME = 120  # characters
KINDS: tuple[InterventionKind, ...] = get_args(InterventionKind)
RELATIONS: tuple[PlaceRelation, ...] = get_args(PlaceRelation)
_KIND_WORDS: dict[str, InterventionKind] = {
    "remove": "remove", "place": "place",
    "removed": "remove", "removal": "remove", "take away": "remove", "put": "place", "placed": "place", "add": "place",
}  # fmt: skip
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
}  # optional


@dataclass(frozen=True)
class Change:
    """A change of the scene, in words."""

    kind: InterventionKind
    object: str
    relation: PlaceRelation | None = None
    targets: tuple[str, ...] = ()


def read_changes(fields: Mapping[str, Any]) -> tuple[Change, ...]:
    """The changes that a reply names; what is none, or says not where to, is left out."""
    held = fields.get("changes")
    parts = cast("list[object]", held) if isinstance(held, list) else [held]
    return tuple(change for change in map(_change, parts[:MAX_CHANGES]) if change is not None)


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
