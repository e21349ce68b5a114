"""What a noun says of a body's shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.lexicon import SETS, ObjectPhrase, words
from cow_service.readers.embedded.english.questions import parse_noun_phrase
from cow_service.readers.options import plain
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


_SAID = lex.words("any every each all no none some many a an both either neither other the")


@dataclass(frozen=True)
class Kind:
    """What one of the things is called, and how many there are, where that is said."""

    phrase: ObjectPhrase
    count: int | None


def kind_of(name: str) -> Kind | None:
    """The kind that a name such as "both mugs" or "mugs" is of; None for the name of one thing."""
    said = name.lower().split()
    numbers = dict.fromkeys(("both", "either", "neither"), 2) | lex.NUMBER_WORDS
    counts = [int(word) if word.isdecimal() else numbers[word] for word in said if word.isdecimal() or word in numbers]
    rest = [word for word in said if word not in _SAID | numbers.keys() and not word.isdecimal()]
    head = lex.singular(rest[-1]) if rest else ""
    if not rest or (said[0] not in _SAID - {"the", "other"} and head == rest[-1]):
        return None
    phrase = parse_noun_phrase(" ".join([*rest[:-1], head]))
    return None if phrase is None else Kind(phrase, counts[0] if counts else None)


ContainerForm = Literal["round", "square", "none", "unknown"]

_ROUND = SETS["round"]
_SQUARE = words("box crate drawer carton case chest tray suitcase bag cart sink crib bathtub package parcel")


def container_form(name: str) -> ContainerForm:
    """Round or square for what is called a container, `none` for a solid thing, `unknown` where the noun says nothing.

    A box is a container: whoever means a solid one does not ask what goes into it.
    """
    phrase = parse_noun_phrase(name)
    head = "" if phrase is None else phrase.head
    if head in _ROUND:
        return "round"
    if head in _SQUARE:
        return "square"
    return "unknown" if shape_of(name) is None else "none"


def may_name(phrase: ObjectPhrase, name: str) -> bool:
    """Whether a phrase may mean the object of that name: they share a colour, noun or number, and differ in none."""
    other = parse_noun_phrase(name)
    if other is None:
        return False
    if plain(phrase.text) == plain(name):
        return True
    nouns = [each.head if each.head not in lex.GENERIC else None for each in (phrase, other)]
    pairs = ((phrase.colour, other.colour), tuple(nouns), (phrase.number, other.number))
    said = [(one, two) for one, two in pairs if one is not None and two is not None]
    return bool(said) and all(one == two for one, two in said)
