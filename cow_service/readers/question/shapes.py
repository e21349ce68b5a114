"""What a noun says of a body's shape."""

from __future__ import annotations

from cow_service.readers.question.lexicon import words
from cow_service.readers.question.sentences import parse_noun_phrase
from cow_service.records import Shape

_SPHERES = words("ball sphere orb marble basketball football baseball balloon globe orange apple pea bead pearl bubble")
_BOXES = words(
    "cube box block brick cuboid die dice book chair table desk carton parcel package crate drawer shelf cabinet"
)
_CUBES = words("cube die dice")
_CONES = words("cone pyramid")
_CYLINDERS = words(
    "cylinder bottle vase mug cup glass jar can candle tin tube pencil pen lamp pot bowl bucket barrel pawn person man",
    "woman tree plant post pole",
)
_VEHICLES = words("car truck bus train van lorry jeep taxi tram tractor wagon locomotive boat")
_SHAPES: tuple[tuple[frozenset[str], Shape], ...] = (
    (_SPHERES, "sphere"), (_BOXES | _VEHICLES, "box"), (_CONES, "cone"), (_CYLINDERS, "cylinder"),
)  # fmt: skip


def shape_of(name: str) -> Shape | None:
    """The shape of what is called so; None where the noun does not say."""
    head = _head(name)
    return next((shape for nouns, shape in _SHAPES if head in nouns), None)


def is_vehicle(name: str) -> bool:
    """Whether it is longer along its heading than across."""
    return _head(name) in _VEHICLES


def is_cube(name: str) -> bool:
    """Whether it is a box as wide as high."""
    return _head(name) in _CUBES


def _head(name: str) -> str | None:
    phrase = parse_noun_phrase(name)
    return None if phrase is None else phrase.head
