"""Finds how fast, how far and how long something moves among the words of a question."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lark import Token, Tree

from cow_service.readers.base import Quantity, SpeedWord, Unit
from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.parsing import parse_from
from cow_service.readers.question.phrases import QUANTITY, Item, QuantityWords
from cow_service.readers.question.words import PRONOUNS, Word, base_forms

_WINDOW = 12  # words
_MAX_TRIES = 5  # of one question: each takes some ms
_STARTS = lex.words(
    "within in after at with by for during lasting over only exactly very really quite rather slowly slow gently",
    "softly lightly fast quickly rapidly swiftly hard forcefully halfway midway half but until till a an",
    "stops stopping",
)
_PACES = lex.words("slowly slow gently softly lightly fast quickly rapidly swiftly hard forcefully halfway midway")
_MEASURES = _PACES | lex.words(
    "px pixel pixels m meter meters metre metres cm centimeter centimeters centimetre centimetres mm inch inches foot",
    "feet ft s sec secs second seconds width widths speed velocity pace rate push shove force way until till",
)
_ADJECTIVE_BEHIND = lex.DETERMINERS | lex.COLOURS.keys() | lex.ADJECTIVES | lex.words("how as so is are be")
_NUMERALS = lex.NUMBER_WORDS | {"twenty": 20, "thirty": 30, "forty": 40, "fifty": 50, "sixty": 60, "hundred": 100}
_METRES = {
    "m": 1.0, "meter": 1.0, "meters": 1.0, "metre": 1.0, "metres": 1.0, "cm": 0.01, "centimeter": 0.01,
    "centimeters": 0.01, "centimetre": 0.01, "centimetres": 0.01,
    "mm": 0.001, "millimeters": 0.001, "millimetres": 0.001, "inch": 0.0254, "inches": 0.0254, "foot": 0.3048,
    "feet": 0.3048, "ft": 0.3048,
}  # fmt: skip
_PARTS = {"half": 0.5, "halfway": 0.5, "quarter": 0.25, "third": 1 / 3, "two_thirds": 2 / 3}
_WITH_UNIT = re.compile(r"(\d+(?:\.\d+)?)([a-z]+)")


def with_quantities(found: Sequence[Item]) -> list[Item]:
    """The words of a question, each quantity in them joined to one item."""
    joined: list[Item] = []
    at = tries = 0
    while at < len(found):
        read = None
        if tries < _MAX_TRIES and _may_start(found, at):
            tries += 1
            read = _read(found, at)
        if read is None:
            joined.append(found[at])
            at += 1
        else:
            quantity, end = read
            words = tuple(item.key for item in found[at:end])
            joined.append(Item(QUANTITY, found[at].start, found[end - 1].end, None, words, quantity))
            at = end
    return joined


def _may_start(found: Sequence[Item], at: int) -> bool:
    key, before = found[at].key, found[at - 1].key if at else ""
    if key in {"slow", "fast", "hard", "halfway"} and before in _ADJECTIVE_BEHIND:
        return False
    ahead = {item.key for item in found[at : at + 8]}
    if _MEASURES.isdisjoint(ahead) and not any(_WITH_UNIT.fullmatch(each) for each in ahead):
        return False
    return key in _STARTS or key[0].isdigit() or (key in _NUMERALS and before != "number")


def _read(found: Sequence[Item], at: int) -> tuple[QuantityWords, int] | None:
    """The quantity that begins at a place, and the place behind it."""
    words = [word for place in range(at, min(at + _WINDOW, len(found))) for word in _words(found[place].key, place)]
    parsed = parse_from("quantity", words)
    if parsed is None:
        return None
    tree, length = parsed
    end = words[length].at if length < len(words) else words[-1].at + 1
    return _quantity(tree), end


def _words(key: str, at: int) -> list[Word]:
    joined = _WITH_UNIT.fullmatch(key)
    if joined is not None:
        return [Word("NUMBER", joined[1], at), Word("", joined[2], at)]
    if key in _NUMERALS or re.fullmatch(r"[0-9]+(\.[0-9]+)?", key):
        return [Word("NUMBER", key, at)]
    return [Word("PRONOUN" if key in PRONOUNS else "", text, at) for text in base_forms(key)]


def _quantity(tree: Tree[Token]) -> QuantityWords:
    kind = tree.children[0]
    assert isinstance(kind, Tree)
    number, length = _number(kind), _length(kind)
    until = "contact" if list(kind.find_data("contact")) else "out-of-view"
    match kind.data:
        case "speed":
            return QuantityWords(speed=_speed(kind, number, length))
        case "limit":
            return QuantityWords(within=number)
        case "duration":
            return QuantityWords(duration=number)
        case "distance":
            value, unit = length or (1.0, "widths")
            return QuantityWords(distance=Quantity(number * value, unit))
        case _:
            return QuantityWords(share=number) if kind.data == "share" else QuantityWords(until=until)


def _speed(kind: Tree[Token], number: float, length: tuple[float, Unit] | None) -> SpeedWord | Quantity:
    if length is None:
        return "slow" if list(kind.find_data("slow")) else "fast"
    value, unit = length
    per_second: dict[str, Unit] = {"px": "px/s", "m": "m/s", "widths": "widths/s"}
    return Quantity(number * value, per_second[unit])


def _number(tree: Tree[Token]) -> float:
    """The number of a quantity; 1 for "a second"."""
    part = next((_PARTS[str(node.data)] for node in tree.iter_subtrees() if node.data in _PARTS), None)
    if part is not None:
        return part
    said = [str(token) for token in tree.scan_values(lambda value: isinstance(value, Token)) if token.type == "NUMBER"]
    value = float(_NUMERALS.get(said[0]) or said[0]) if said else 1.0
    return value + 0.5 if list(tree.find_data("plus_half")) else value


def _length(tree: Tree[Token]) -> tuple[float, Unit] | None:
    """The size of a unit of length in the unit of a `Quantity`; None where there is none."""
    node = next(tree.find_data("length"), None)
    if node is None:
        return None
    unit = str(node.children[0])
    if unit.startswith("width"):
        return 1.0, "widths"
    return (1.0, "px") if unit.startswith("p") else (_METRES[unit], "m")
