"""Reads which relation a yes/no question asks about: whether the mover hits, lands on, hides or is hidden by one thing.

The question is taken at its word: an auxiliary, a subject, a verb, an object. Anything beside that (a negation, an
order of events, a number) leaves it unread: a wrong yes is worse than "not sure".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, takewhile
from typing import Literal

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.choices import plain
from cow_service.readers.question.clauses import SENTENCE_END, is_vague
from cow_service.readers.question.phrases import Item, ObjectPhrase, flatten
from cow_service.readers.question.sentences import Question

Relation = Literal["touches", "covers", "covered"]  # the mover does it to the other thing, or has it done to it

_AUXILIARIES = lex.words("will would does do did is are could can shall might may")
_OPENERS = lex.words(", . ? ; : then and ) ( — –")
_BE = lex.words("be been being get gets getting become becomes is are")
_CONTACT = lex.words("contact collision")
# Nothing but these may stand beside subject, verb and object: any other word may turn the question round.
_HARMLESS = lex.words(
    "into onto on upon in with against to at of by behind front it its they the a an any some ever eventually then",
    "actually directly , while moving during along",
)
_TIMES = lex.words("moment point time times way path motion movement course trajectory future end clip video")
_COUNTING = lex.words(
    "two three four five both all every each another other several many twice once exactly least most"
)
# Toppling, stopping and wrapping are more than touching or hiding.
_MORE = lex.words("knock block cover crash smash overlap meet reach")
_MAKING = lex.words("make makes come comes be get gets")  # contact; it can also be lost
_VANISH = lex.words("disappear vanish")
_ANYTHING = lex.words("anything something object objects thing things obstacle obstacles")
_COMES_DOWN = lex.words("fall drop tumble come end stop rest")
_ONTO = lex.words("by with against into onto on upon behind")
_KNOWN = lex.VERBS.keys() | _BE | _HARMLESS | _ANYTHING | _TIMES | _CONTACT | {"make", "makes"}


@dataclass(frozen=True)
class AskedRelation:
    """The relation of the mover to another thing that a question asks about."""

    relation: Relation
    target: ObjectPhrase | None  # None: any thing at all


def read_relation(question: Question) -> AskedRelation | None:
    """The relation that the question asks for; None where it is not one of ours, or not put plainly."""
    found = question.items
    starts = [at for at in range(len(found) - 1) if found[at].key in _AUXILIARIES and _is_subject(found[at + 1])]
    if len(starts) != 1 or (starts[0] and found[starts[0] - 1].key not in _OPENERS):
        return None
    _, subject, *rest = takewhile(lambda item: item.key not in SENTENCE_END, found[starts[0] :])
    if not _is_plain(rest):
        return None
    is_mover = subject.key in lex.MOVER_PRONOUNS or _means(subject.phrase, question.mover)
    if not is_mover and not _done_by_mover(rest, question):
        return None
    rest = [item for item in rest if not _has_head(item, _TIMES)]
    if any(_has_head(item, _CONTACT) or item.key == "contact" for item in rest):
        return _contact(rest) if is_mover else None
    return _by_verb(rest, subject.phrase, is_mover)


def _is_subject(item: Item) -> bool:
    return item.phrase is not None or item.key in lex.MOVER_PRONOUNS


def _has_head(item: Item, heads: frozenset[str]) -> bool:
    return item.phrase is not None and item.phrase.head in heads


def _is_plain(rest: Sequence[Item]) -> bool:
    """Whether a clause holds one verb, one thing at the most, and beside them only words that change nothing."""
    verbs = [item for item in rest if item.key in lex.VERBS and item.key not in _BE | _TIMES | _CONTACT]
    things = [item.phrase for item in rest if item.phrase is not None and not _has_head(item, _TIMES | _CONTACT)]
    counted = not _COUNTING.isdisjoint(flatten(rest)) or any(thing.text.split()[0].isdecimal() for thing in things)
    known = all(item.key in _KNOWN for item in rest if item.phrase is None)
    return len(verbs) <= 1 and len(things) <= 1 and not counted and known


def _done_by_mover(rest: Sequence[Item], question: Question) -> bool:
    """Whether something else is said to be hit or hidden by nobody in particular, or by the mover."""
    agents = [item.phrase for before, item in pairwise(rest) if item.phrase and before.key == "by"]
    return all(_means(agent, question.mover) for agent in agents)


def _means(phrase: ObjectPhrase | None, mover: ObjectPhrase | None) -> bool:
    """Whether a phrase speaks of the mover again: no word in it that the mover's own lacks."""
    if phrase is None or mover is None:
        return False
    return set(plain(phrase.text).split()) <= set(plain(mover.text).split())


def _by_verb(rest: Sequence[Item], subject: ObjectPhrase | None, is_mover: bool) -> AskedRelation | None:
    at = next((at for at, item in enumerate(rest) if item.key in lex.VERBS and item.key not in _BE), None)
    if at is None:
        return None
    verb, behind = lex.VERBS[rest[at].key], rest[at:]
    passive = verb.form != "ing" and any(item.key in _BE for item in rest[:at])
    if verb.lemma in _MORE or (not passive and not is_mover):
        return None
    if passive and is_mover:
        return _any_or_named("covered", behind, optional=True) if verb.lemma in lex.OCCLUDE else None
    if passive:
        relation = "covers" if verb.lemma in lex.OCCLUDE else "touches" if verb.lemma in lex.TOUCH else None
        return None if relation is None else AskedRelation(relation, subject)
    relation = _active(verb.lemma, {item.key for item in behind})
    return None if relation is None else _any_or_named(relation, behind, optional=verb.lemma in _VANISH)


def _active(lemma: str, words: set[str]) -> Relation | None:
    """What the mover does, by its verb and the words behind it."""
    if lemma in _VANISH or "behind" in words:
        return "covered"
    if lemma in lex.OCCLUDE or "front" in words:
        return "covers"
    comes_down = lemma in _COMES_DOWN and not _ONTO.isdisjoint(words)
    return "touches" if lemma in lex.TOUCH | lex.LAND or comes_down else None


def _any_or_named(relation: Relation, rest: Sequence[Item], *, optional: bool) -> AskedRelation | None:
    """The relation to the first thing that is named, or to any; `optional` where none need be named."""
    target = next((item for item in rest if item.phrase is not None), None)
    if target is None:
        return AskedRelation(relation, None) if optional or any(item.key in _ANYTHING for item in rest) else None
    return _named(relation, target)


def _contact(rest: Sequence[Item]) -> AskedRelation | None:
    """ "make contact with the vase", "be in collision with it"."""
    if _MAKING.isdisjoint(item.key for item in rest):
        return None
    objects = [item for item in rest if item.phrase is not None and not _has_head(item, _CONTACT)]
    return _named("touches", objects[-1]) if objects else None


def _named(relation: Relation, target: Item) -> AskedRelation | None:
    """The relation to one named thing, or to any; None where what is named is no thing, such as the floor."""
    phrase = target.phrase
    if phrase is None:
        return None
    if set(target.words) & _ANYTHING and phrase.colour is None and phrase.number is None:
        return AskedRelation(relation, None)
    if is_vague(target) or phrase.head in lex.NO_THINGS:
        return None
    return AskedRelation(relation, phrase)
