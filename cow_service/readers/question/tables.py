"""Tells a table that something happens to, or that hides something, from one that is only the place of it all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import Item, key_at

TABLES = lex.words("table desk tabletop")
_PLACE = lex.words(
    "on onto upon off across over along around above atop at from to in through within under beneath below underneath"
    " inside of leave leaves leaving"
)


def with_tables(found: Sequence[Item]) -> list[Item]:
    """The items; "the table" is a thing where it is not behind a preposition that makes it a place."""
    return [_as_thing(found, at) for at in range(len(found))]


def _as_thing(found: Sequence[Item], at: int) -> Item:
    item, before = found[at], key_at(found, at - 1) if at else ""
    if item.phrase is None or item.phrase.head not in TABLES:
        return item
    in_front = before == "of" and key_at(found, at - 2) == "front"
    if before in _PLACE and not in_front:
        return item
    return replace(item, phrase=replace(item.phrase, as_thing=True))
