"""Reads what a question says of a trail of positions: that the motion follows it, and which end is the present one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lark import Token, Tree

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.interventions import named_in
from cow_service.readers.question.parsing import read_from
from cow_service.readers.question.phrases import Item, ObjectPhrase
from cow_service.records import Vector

_SIDES = {"leftmost": "left", "rightmost": "right", "topmost": "up", "lowest": "down", "highest": "up",
          "uppermost": "up"}  # fmt: skip


@dataclass(frozen=True)
class TrailWords:
    """Which end of a trail is the present position; where neither field says so, the image must.

    `last`: the end described by `near` or `side` is the present one; else it is the oldest.
    """

    last: bool = True
    near: ObjectPhrase | None = None
    side: Vector | None = None  # unit vector in the image


def split_trail(found: Sequence[Item]) -> tuple[TrailWords | None, list[Item]]:
    """What is said of a trail, and the items without that."""
    for at in range(len(found)):
        parsed = read_from("trail", found, at, len(found))
        if parsed is not None and parsed[1] > at + 1:
            tree, end = parsed
            return _trail(found, tree), [*found[:at], *found[end:]]
    return None, list(found)


def _trail(found: Sequence[Item], tree: Tree[Token]) -> TrailWords:
    last = next(tree.find_data("first_end"), None) is None
    near = next((found[token.line or 0].phrase for token in named_in(tree)), None)
    side = next((str(node.children[0]) for node in tree.find_data("side")), None)
    return TrailWords(last, near, None if side is None else lex.DIRECTIONS[_SIDES.get(side, side)])
