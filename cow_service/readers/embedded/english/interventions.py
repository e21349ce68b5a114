"""Finds what a question takes away or puts somewhere before anything moves, and the question without those words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from lark import Token, Tree

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import read_from
from cow_service.readers.embedded.english.lexicon import Item, ObjectPhrase, key_at, words_of
from cow_service.records import InterventionKind, PlaceRelation, Vector

MAX_TRIES = 6  # of one question: each takes some ms; what comes after them is not looked for
_FITS = frozenset({"fit", "go", "get"})
_WINDOW = 16  # words that one may have
_BEFORE = lex.CONDITIONALS | lex.words(". ! ? ; : , and but then also that with")
_ANYWHERE = lex.words("without with remove taking in")
_TELLING = lex.SETS["telling"]
_VERBS = lex.VERBS.keys() | lex.BE
THINGS = frozenset({"NP", "PRONOUN"})  # terminals of what is named
_RELATIONS: dict[str, PlaceRelation] = {
    "into": "into", "onto": "onto", "between": "between", "in_front_of": "in-front-of", "behind": "behind",
    "next_to": "next-to", "left_of": "left-of", "right_of": "right-of",
}  # fmt: skip


@dataclass(frozen=True)
class InterventionWords:
    """A change of the scene in the words of the question. `relation` and `targets` are those of `place`.

    `then_moves`: what is taken away is said to move then, which is a contradiction.
    """

    kind: InterventionKind
    object: ObjectPhrase
    relation: PlaceRelation | None = None
    targets: tuple[ObjectPhrase, ...] = ()
    then_moves: bool = False


def split_interventions(found: Sequence[Item]) -> tuple[tuple[InterventionWords, ...], list[Item]]:
    """The interventions of a question, and its items without them and without the conditions they leave empty."""
    changes: list[InterventionWords] = []
    gone: set[int] = set()
    tries = 0
    for at in _starts(found):
        ahead = words_of(found[at : at + 8])
        if at in gone or tries >= MAX_TRIES or _TELLING.isdisjoint(word.text for word in ahead[:8]):
            continue
        tries += 1
        read = _read(found, at)
        if read is not None:
            said, end = read
            if said[0].kind == "remove" and ahead[0].kind and _goes_on(found, at, end):
                said = [replace(change, then_moves=True) for change in said]
            changes += [change for change in said if change not in changes]
            gone |= _emptied(found, at, end, gone)
    return tuple(changes), [item for at, item in enumerate(found) if at not in gone]


def _goes_on(found: Sequence[Item], start: int, end: int) -> bool:
    """Whether the subject of an intervention moves behind it: "if the ball is removed and then (it) rolls left"."""
    rest = [item for item in found[end : end + 5] if item.key != ","]
    joined = bool(rest) and rest[0].key in {"and", "then"}
    while rest and rest[0].key in {"and", "then", "afterwards"}:
        rest = rest[1:]
    named = any(item.phrase is not None and item.phrase.is_thing for item in found[:start])
    if rest and rest[0].key == "it" and not named:
        rest = rest[1:]
    verb = lex.VERBS.get(rest[0].key) if rest else None
    return joined and verb is not None and verb.kind not in {None, "static"} and verb.form != "ing"


def implied_placing(found: Sequence[Item]) -> tuple[tuple[InterventionWords, ...], frozenset[int]]:
    """ "Will the apple fit into the bowl?": where nothing moves, the apple is put there; and which places say so."""
    fits = (at for at, item in enumerate(found) if lex.lemma(item.key) in _FITS)
    for start in (start for at in fits for start in range(max(at - 4, 0), at)):
        parsed = read_from("fitting", found, start, _WINDOW)
        if parsed is not None:
            tree, end = parsed
            named = [phrase for token in named_in(tree) if (phrase := _phrase(found, token.line or 0))]
            return (_placing(tree, named),), frozenset(item.start for item in found[start:end])
    return (), frozenset()


def _placing(tree: Tree[Token], named: Sequence[ObjectPhrase]) -> InterventionWords:
    relation: PlaceRelation = next(_RELATIONS[str(n.data)] for n in tree.iter_subtrees() if n.data in _RELATIONS)
    return InterventionWords("place", named[0], relation, tuple(named[1:]))


def _starts(found: Sequence[Item]) -> Iterator[int]:
    """Where a clause may begin that takes something away or puts it somewhere."""
    for at, item in enumerate(found):
        if item.key in _ANYWHERE or (key_at(found, at - 1) in _BEFORE and item.key not in _BEFORE):
            yield at


def _read(found: Sequence[Item], at: int) -> tuple[list[InterventionWords], int] | None:
    """The interventions from a place on, and the place of the first item behind them."""
    parsed = read_from("intervention", found, at, _WINDOW)
    while parsed is not None and found[parsed[1] - 1].phrase and key_at(found, parsed[1]) in _VERBS:
        parsed = read_from("intervention", found[: parsed[1] - 1], at, _WINDOW)  # "without the vase, the ball rolls"
    if parsed is None:
        return None
    tree, end = parsed
    named = [phrase for token in named_in(tree) if (phrase := _phrase(found, token.line or 0))]
    if not named:
        return None
    if next(tree.find_data("removal"), None) is not None:
        return [InterventionWords("remove", phrase) for phrase in dict.fromkeys(named)], end
    alone = len(named) == 2 and named[1].text.endswith(named[1].head or "")  # "between the cube": and what else?
    return ([_placing(tree, named)], end) if not alone or not list(tree.find_data("between")) else None


def named_in(tree: Tree[Token]) -> Iterator[Token]:
    """The noun phrases of a tree, in order."""
    return (token for token in tree.scan_values(lambda value: isinstance(value, Token) and value.type in THINGS))


def _phrase(found: Sequence[Item], at: int) -> ObjectPhrase | None:
    """The noun phrase at a place; for a pronoun, the thing that was named before it."""
    before = [item.phrase for item in found[: at + 1] if item.phrase is not None and item.phrase.is_thing]
    return found[at].phrase or (before[-1] if before else None)


def _emptied(found: Sequence[Item], start: int, end: int, gone: set[int]) -> set[int]:
    """The places of an intervention, with the "and" or the condition that it leaves without a clause."""
    places = set(range(start, end))
    before, after = start - 1, end
    while before >= 0 and (before in gone or found[before].key in {"then", "also"}):
        before -= 1
    opened = before >= 0 and found[before].key in lex.CONDITIONALS
    if key_at(found, after) == "," and key_at(found, after + 1) in {"and", "then"}:
        after += 1
    if key_at(found, after) in {"and", "then"} and (opened or before < 0 or key_at(found, before) in ".,;"):
        return places | {after} | ({after - 1} if found[after - 1].key == "," else set())
    if before >= 0 and found[before].key in {"and", "but"}:
        return places | {before}
    if opened:
        return places | {before} | ({after} if key_at(found, after) == "," else set())
    return places


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
