"""Finds how fast, how far and how long something moves among the words of a question."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lark import Token, Tree

from cow_service.readers.base import Quantity, SpeedWord, Unit
from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.parsing import may_begin, parse_from, terminals
from cow_service.readers.question.phrases import QUANTITY, Item, QuantityWords, key_at
from cow_service.readers.question.words import Word, plain_words

_WINDOW = 12  # words
_MAX_TRIES = 6  # of one question: each takes some ms
_MEASURES = frozenset({"_SLOWLY", "_QUICKLY", "_SECOND", "_TEMPO", "LENGTH", "WIDTH"})  # terminals
_BARE = lex.words("width diameter height halfway midway way until till push shove")  # measures, too
_ADJECTIVE_BEHIND = lex.DETERMINERS | lex.COLOURS.keys() | lex.ADJECTIVES | lex.words("how as so is are be")
_NUMERALS = lex.NUMBER_WORDS | {"twenty": 20, "thirty": 30, "forty": 40, "fifty": 50, "sixty": 60, "hundred": 100}
_PARTS = {"half": 0.5, "halfway": 0.5, "quarter": 0.25, "third": 1 / 3, "two_thirds": 2 / 3, "twice": 2.0}
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
    if (key in {"slow", "fast", "hard", "halfway"} and before in _ADJECTIVE_BEHIND) or before == "number":
        return False
    if key in _PARTS and key_at(found, at + 1) == "between":
        return False
    measured = any(
        each.key in _BARE or _WITH_UNIT.fullmatch(each.key) or not _MEASURES.isdisjoint(terminals(each.key))
        for each in found[at : at + 8]
    )
    return measured and may_begin("quantity", _words(key, at)[0])


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
    return plain_words([key], at)


def _quantity(tree: Tree[Token]) -> QuantityWords:
    kind = tree.children[0]
    assert isinstance(kind, Tree)
    number, length = _number(kind), _length(kind)
    own = next(kind.find_pred(lambda node: node.data in {"own_width", "own_height"}), None)
    until = "contact" if list(kind.find_data("contact")) else "out-of-view"
    match kind.data:
        case "speed":
            return QuantityWords(speed=_speed(kind, number, length))
        case "limit":
            return QuantityWords(within=number)
        case "duration":
            return QuantityWords(duration=number)
        case "distance" if own is not None:
            wide = own.data == "own_width"
            return QuantityWords(own_widths=number) if wide else QuantityWords(own_heights=number)
        case "distance":
            value, unit = length or (1.0, "widths")
            return QuantityWords(distance=Quantity(number * value, unit))
        case _:
            return QuantityWords(share=number) if kind.data == "share" else QuantityWords(until=until)


def _speed(kind: Tree[Token], number: float, length: tuple[float, Unit] | None) -> SpeedWord | Quantity:
    if length is None:
        return "slow" if any(node.data in {"slow", "slowly"} for node in kind.iter_subtrees()) else "fast"
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
    return (1.0, "px") if unit.startswith("p") else (lex.METRES[unit], "m")
