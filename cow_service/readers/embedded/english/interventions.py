"""Finds what a question takes away or puts somewhere before anything moves, and the question without those words."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import Node, read_from
from cow_service.readers.embedded.english.lexicon import Item, ObjectPhrase, key_at
from cow_service.records import InterventionKind, PlaceRelation, Vector

MAX_TRIES = 6  # of one question: each takes some ms; what comes after them is not looked for
_WINDOW = 16  # words that one may have
_BEFORE = lex.CONDITIONALS | lex.words(". ! ? ; : , and but then also that with")
_ANYWHERE = lex.words("without with remove taking in")
_VERBS = lex.VERBS.keys() | lex.BE
_RELATIONS: dict[str, PlaceRelation] = {
    "into": "into", "onto": "onto", "between": "between", "front_of_it": "in-front-of", "behind_it": "behind",
    "next_to": "next-to", "left_of_it": "left-of", "right_of_it": "right-of",
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
    changes, gone, tries = list[InterventionWords](), set[int](), 0
    for at, item in enumerate(found):
        begins = item.key in _ANYWHERE or (key_at(found, at - 1) in _BEFORE and item.key not in _BEFORE)
        if not begins or at in gone or tries == MAX_TRIES:
            continue
        ahead = list(lex.words_of(found[at : at + 8]))
        if lex.SETS["telling"].isdisjoint(word.text for word in ahead[:8]):
            continue
        tries += 1
        said, end = _read_changes(found, at)
        if said and said[0].kind == "remove" and ahead[0].kind and _goes_on(found, at, end):
            said = [replace(change, then_moves=True) for change in said]
        changes += [change for change in said if change not in changes]
        gone |= _emptied(found, at, end) if said else set()
    return tuple(changes), [item for at, item in enumerate(found) if at not in gone]


def _read_changes(found: Sequence[Item], at: int) -> tuple[list[InterventionWords], int]:
    """The interventions from a place on, and the place of the first item behind them."""
    parsed = read_from("intervention", found, at, _WINDOW)
    while parsed is not None and found[parsed[1] - 1].phrase and key_at(found, parsed[1]) in _VERBS:
        parsed = read_from("intervention", found[: parsed[1] - 1], at, _WINDOW)  # "without the vase, the ball rolls"
    if parsed is None:
        return [], at
    tree, end = parsed
    named = _named_in(found, tree)
    if "removal" in tree:
        return [InterventionWords("remove", phrase) for phrase in dict.fromkeys(named)], end
    alone = len(named) == 2 and named[1].text.endswith(named[1].head or "")  # "between the cube": and what else?
    return [_placing(tree, named)] if named and not (alone and "between" in tree) else [], end


def _placing(tree: Node, named: Sequence[ObjectPhrase]) -> InterventionWords:
    relation: PlaceRelation = next(_RELATIONS[name] for name in tree.names if name in _RELATIONS)
    return InterventionWords("place", named[0], relation, tuple(named[1:]))


def _named_in(found: Sequence[Item], tree: Node) -> list[ObjectPhrase]:
    """The noun phrases of a tree in order; for a pronoun, the thing that was named before it."""
    named: list[ObjectPhrase] = []
    for word in tree.words:
        if word.kind in {"NP", "PRONOUN"}:
            things = (item.thing for item in reversed(found[: word.at + 1]))
            phrase = word.phrase or next(filter(None, things), None)
            named += [] if phrase is None else [phrase]
    return named


def _goes_on(found: Sequence[Item], start: int, end: int) -> bool:
    """Whether the subject of an intervention moves behind it: "if the ball is removed and then (it) rolls left"."""
    rest = [item.key for item in found[end : end + 5] if item.key != ","]
    joined = rest[:1] in (["and"], ["then"])
    while rest and rest[0] in {"and", "then", "afterwards"}:
        del rest[0]
    if rest[:1] == ["it"] and not any(item.thing for item in found[:start]):
        del rest[0]
    verb = lex.VERBS.get(rest[0]) if rest else None
    return joined and verb is not None and lex.moves(verb) and verb.form != "ing"


def _emptied(found: Sequence[Item], start: int, end: int) -> set[int]:
    """The places of an intervention, with the "and" behind it or the condition that it leaves without a clause."""
    places = set(range(start, end))
    before, after = start - 1, end
    opened = before >= 0 and found[before].key in lex.CONDITIONALS
    if key_at(found, after) == "," and key_at(found, after + 1) in {"and", "then"}:
        after += 1
    if key_at(found, after) in {"and", "then"} and (opened or before < 0 or key_at(found, before) in ".,;"):
        return places | {after} | ({after - 1} if found[after - 1].key == "," else set())
    if opened:
        return places | {before} | ({after} if key_at(found, after) == "," else set())
    return places


def implied_placing(found: Sequence[Item]) -> tuple[tuple[InterventionWords, ...], frozenset[int]]:
    """ "Will the apple fit into the bowl?": where nothing moves, the apple is put there; and which places say so."""
    fits = (at for at, item in enumerate(found) if lex.lemma(item.key) in {"fit", "go", "get"})
    for start in (start for at in fits for start in range(max(at - 4, 0), at)):
        parsed = read_from("fitting", found, start, _WINDOW)
        if parsed is not None:
            tree, end = parsed
            return (_placing(tree, _named_in(found, tree)),), frozenset(item.start for item in found[start:end])
    return (), frozenset()


_SIDES = {"leftmost": "left", "rightmost": "right", "lowest": "down", "highest": "up"}


@dataclass(frozen=True)
class TrailWords:
    """Which end of a trail is the present position; where neither field says so, the image must."""

    near: ObjectPhrase | None = None
    side: Vector | None = None  # unit vector in the image


def split_trail(found: Sequence[Item]) -> tuple[TrailWords | None, list[Item]]:
    """What is said of a trail, and the items without that."""
    for at in range(len(found)):
        parsed = read_from("trail", found, at, len(found))
        if parsed is not None and parsed[1] > at + 1:
            tree, end = parsed
            near = next((word.phrase for word in tree.words if word.kind in {"NP", "PRONOUN"}), None)
            side = next((node.words[0].text for node in tree.find("side")), None)
            way = None if side is None else lex.DIRECTIONS[_SIDES.get(side, side)]
            return TrailWords(near, way), [*found[:at], *found[end:]]
    return None, list(found)
