"""What a model says that a thing stands on: the floor, the air, or another object."""

from __future__ import annotations

import re
from collections.abc import Sequence

FLOOR, AIR = "floor", "air"  # what `ObjectPrior.stands_on` calls them

# The plane on which the things of a picture stand, be it that of a room, a street or a table.
_FLOOR = frozenset({
    "floor", "ground", "surface", "table top", "tabletop", "table surface", "desk top", "countertop",
    "counter top", "worktop", "ground plane", "ground surface", "floor surface", "flat surface", "road", "street",
    "pavement", "grass", "lawn", "carpet",
    "boden", "fußboden", "fussboden", "erde", "tischplatte", "sol", "plancher", "suelo", "piso", "pavimento", "chão",
    "пол", "земля", "地面", "地板", "桌面", "床面",
})  # fmt: skip
_AIR = frozenset({
    "air", "mid air", "midair", "sky", "space", "thin air", "floating", "flying", "hovering", "suspended", "airborne",
    "luft", "aire", "aria", "ar", "воздух", "воздухе", "空中", "空気", "空气",
})  # fmt: skip
_FUNCTION_WORDS = frozenset({
    "the", "a", "an", "in", "on", "at", "of", "upon",
    "der", "die", "das", "dem", "den", "auf", "le", "la", "les", "l", "sur", "dans", "el", "los", "en", "sobre",
    "il", "lo", "sul", "nell", "o", "no", "на", "в",
})  # fmt: skip
_PARTS = frozenset({"top", "surface", "upper", "edge"})  # of an object that others stand on


def support_named(said: str, own: str, others: Sequence[str]) -> str | None:
    """`floor`, `air`, the name of one of the other objects, or what was said; None where it names nothing but `own`.

    An object comes before the floor: where a table was located, a table top is that table.
    """
    named = _words(said)
    phrase, thing = " ".join(named), set(named) - _PARTS
    if not re.search(r"[^\W\d_]", phrase):
        return None
    candidates = {other: words for other in others if (words := set(_words(other))) and words != set(_words(own))}
    same = [other for other, words in candidates.items() if words == thing]
    alike = [other for other, words in candidates.items() if thing and (thing < words or words < thing)]
    if same or len(alike) == 1:
        return (same or alike)[0]
    if phrase in _FLOOR:
        return FLOOR
    if phrase in _AIR:
        return AIR
    return None if thing == set(_words(own)) else said


def is_floor(name: str) -> bool:
    """Whether a name is that of the plane on which things stand."""
    return support_named(name, "", ()) == FLOOR


def _words(text: str) -> list[str]:
    return [word for word in re.findall(r"[^\W_]+", text.lower()) if word not in _FUNCTION_WORDS]
