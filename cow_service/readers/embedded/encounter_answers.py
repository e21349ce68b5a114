"""Answers yes/no questions about hitting, landing on and occluding from what the mover encounters; else nothing.

The question is taken at its word: an auxiliary, a subject, a verb, an object. Anything beside that (a negation, an
order of events, an object that was not found) leaves it undecided: a wrong yes is worse than "not sure".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from cow_service.readers.base import AnswerReading
from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.choices import not_sure_option, plain, says_not_sure
from cow_service.readers.question.chunks import items
from cow_service.readers.question.clauses import SENTENCE_END, is_vague
from cow_service.readers.question.listed_options import split_options
from cow_service.readers.question.phrases import Item, ObjectPhrase, flatten
from cow_service.readers.question.sentences import Question
from cow_service.records import AnswerOption, EncounterKind, LocatedObject, Simulation

Relation = Literal["touches", "covers", "covered"]  # the mover does it to the other thing, or has it done to it

_KINDS: dict[Relation, frozenset[EncounterKind]] = {
    "touches": frozenset(("touches",)),
    "covers": frozenset(("occludes", "touches")),  # what touches it in the picture stands before a part of it
    "covered": frozenset(("occluded-by",)),
}
_AUXILIARIES = lex.words("will would does do did is are could can shall might may")
_OPENERS = frozenset({",", ".", "?", ";", ":", "then", "and", ")", "(", "—", "–"})
_BE = lex.words("be been being get gets getting become becomes is are")
# Nothing but these may stand beside subject, verb and object: any other word may turn the question round.
_HARMLESS = lex.words(
    "into onto on upon in with against to at of by behind front it its they the a an any some ever eventually then",
    "actually directly and or , while moving during along its",
) - {"and", "or"}
_TIMES = lex.words("moment point time times way path motion movement course trajectory future end clip video")
_COUNTING = lex.words(
    "two three four five both all every each another other several many twice once exactly least most",
)
# Toppling, stopping and wrapping are more than touching or hiding.
_MORE = lex.words("knock block cover crash smash overlap meet reach")
_MAKING = lex.words("make makes come comes be get gets")  # contact; it can also be lost
_VANISH = lex.words("disappear vanish")
_ANYTHING = lex.words("anything something object objects thing things obstacle obstacles")
_COMES_DOWN = lex.words("fall drop tumble come end stop rest")
_MARKS = lex.words("by with against into onto on upon behind")


@dataclass(frozen=True)
class Asked:
    """The relation of the mover to another thing that a question asks about."""

    relation: Relation
    target: ObjectPhrase | None  # None: any thing at all

    @property
    def kinds(self) -> frozenset[EncounterKind]:
        """Encounters that make the answer yes."""
        return _KINDS[self.relation]


def decided_by(simulation: Simulation, asked: Asked) -> bool | None:
    """Whether what is asked happens, by the encounters of a simulation; None where they cannot tell."""
    if not simulation.encounters_known:
        return None
    encounters = simulation.trajectory.encounters
    if asked.target is None:
        return True if any(encounter.kind in asked.kinds for encounter in encounters) else None
    target = located(asked, simulation.grounding.others)
    if target is None:
        return None
    return any(e.object == target.object and e.kind in asked.kinds for e in encounters)


def located(asked: Asked, others: Sequence[LocatedObject]) -> LocatedObject | None:
    """The thing that is asked about, where it was found by that name."""
    if asked.target is None:
        return None
    name = plain(asked.target.text)
    return next((other for other in others if plain(other.object) == name), None)


def choose_option(options: Sequence[AnswerOption], happens: bool | None) -> AnswerReading:
    """Yes or no as the options word it; not sure where nothing was decided, or the options are not yes and no."""
    unsure = not_sure_option(options)
    if happens is not None:
        if not options:
            return AnswerReading("Yes" if happens else "No", False)
        said = {word: [o for o in options if not says_not_sure(o.text) and _begins(o, word)] for word in ("yes", "no")}
        chosen = said["yes" if happens else "no"]
        if all(len(found) == 1 for found in said.values()):
            return AnswerReading(chosen[0].letter, False)
        told = (f"What is asked {'happens' if happens else 'does not happen'}, but the options are not yes and no.",)
        return AnswerReading(None if unsure is None else unsure.letter, True, notes=told)
    return AnswerReading(None if unsure is None else unsure.letter, True)


def _begins(option: AnswerOption, word: str) -> bool:
    return plain(option.text).split()[:1] == [word]


def read_asked(question: Question) -> Asked | None:
    """The relation that the question asks for; None where it is not one of ours, or not put plainly."""
    found = items(split_options(question.text)[1])
    starts = [at for at in range(len(found) - 1) if found[at].key in _AUXILIARIES and _is_subject(found[at + 1])]
    if len(starts) != 1:
        return None
    clause = _to_its_end(found[starts[0] :])
    before = found[starts[0] - 1].key if starts[0] else ","
    subject, rest = clause[1], clause[2:]
    if before not in _OPENERS or not _is_plain(rest):
        return None
    is_mover = subject.key in lex.MOVER_PRONOUNS or _means(subject.phrase, question.mover)
    if not is_mover and not _done_by_mover(rest, question):
        return None
    rest = [item for item in rest if not _is_time(item)]
    if any(_is_contact(item) or item.key == "contact" for item in rest):
        return _contact(rest) if is_mover else None
    return _relation(rest, subject.phrase, is_mover)


def _is_plain(rest: Sequence[Item]) -> bool:
    """Whether a clause holds one verb, one thing at the most, and beside them only words that change nothing."""
    nouns = _TIMES | {"contact", "collision"}
    verbs = [item for item in rest if item.key in lex.VERBS and item.key not in _BE | nouns]
    things = [item for item in rest if item.phrase is not None and not _is_time(item) and not _is_contact(item)]
    known = lex.VERBS.keys() | _BE | _HARMLESS | _ANYTHING | nouns | {"make", "makes"}
    words = [item.key for item in rest if item.phrase is None]
    counted = not _COUNTING.isdisjoint(flatten(rest)) or any(i.phrase and _counts(i.phrase) for i in things)
    return len(verbs) <= 1 and len(things) <= 1 and not counted and all(word in known for word in words)


def _counts(phrase: ObjectPhrase) -> bool:
    """Whether a phrase is about how many: "2 cubes", but not "cube 2"."""
    return phrase.text.split()[0].isdecimal()


def _is_time(item: Item) -> bool:
    """ "at some moment", "on its way"."""
    return item.phrase is not None and item.phrase.head in _TIMES


def _is_contact(item: Item) -> bool:
    return item.phrase is not None and item.phrase.head in {"contact", "collision"}


def _done_by_mover(rest: Sequence[Item], question: Question) -> bool:
    """Whether something else is said to be hit or hidden by nobody in particular, or by the mover."""
    agents = [item for at, item in enumerate(rest) if item.phrase is not None and at and rest[at - 1].key == "by"]
    return all(_means(agent.phrase, question.mover) for agent in agents)


def _to_its_end(found: Sequence[Item]) -> Sequence[Item]:
    end = next((at for at, item in enumerate(found) if item.key in SENTENCE_END), len(found))
    return found[:end]


def _is_subject(item: Item) -> bool:
    return item.phrase is not None or item.key in lex.MOVER_PRONOUNS


def _means(phrase: ObjectPhrase | None, mover: ObjectPhrase | None) -> bool:
    """Whether a phrase speaks of the mover again: no word in it that the mover's own lacks."""
    if phrase is None or mover is None:
        return False
    return set(plain(phrase.text).split()) <= set(plain(mover.text).split())


def _relation(rest: Sequence[Item], subject: ObjectPhrase | None, is_mover: bool) -> Asked | None:
    at = next((at for at, item in enumerate(rest) if item.key in lex.VERBS and item.key not in _BE), None)
    if at is None:
        return None
    verb = lex.VERBS[rest[at].key]
    passive = verb.form != "ing" and any(item.key in _BE for item in rest[:at])
    if passive and not is_mover:
        relation = _done(verb.lemma)
        return None if relation is None else Asked(relation, subject)
    if not is_mover:
        return None
    if passive:
        hidden = verb.lemma in lex.OCCLUDE - _MORE
        return _any_or_named("covered", rest[at:], optional=True) if hidden else None
    relation = _doing(verb.lemma, [item.key for item in rest[at:]])
    if relation is None:
        return None
    return _any_or_named(relation, rest[at:], optional=verb.lemma in _VANISH)


def _done(lemma: str) -> Relation | None:
    """What the mover does to something of which it is said that it is hit, or hidden."""
    if lemma in _MORE:
        return None
    if lemma in lex.OCCLUDE:
        return "covers"
    return "touches" if lemma in lex.TOUCH else None


def _doing(lemma: str, words: Sequence[str]) -> Relation | None:
    """What the mover does, by its verb and the words behind it."""
    if lemma in _MORE:
        return None
    if lemma in _VANISH or "behind" in words:
        return "covered"
    if lemma in lex.OCCLUDE or "front" in words:
        return "covers"
    comes_down = lemma in _COMES_DOWN and not _MARKS.isdisjoint(words)
    return "touches" if lemma in lex.TOUCH | lex.LAND or comes_down else None


def _any_or_named(relation: Relation, rest: Sequence[Item], *, optional: bool) -> Asked | None:
    """The relation to the first thing that is named, or to any; `optional` where none need be named."""
    target = next((item for item in rest if item.phrase is not None), None)
    if target is None:
        return Asked(relation, None) if optional or any(item.key in _ANYTHING for item in rest) else None
    return _named(relation, target)


def _contact(rest: Sequence[Item]) -> Asked | None:
    """ "make contact with the vase", "be in collision with it"."""
    if _MAKING.isdisjoint(item.key for item in rest):
        return None
    objects = [item for item in rest if item.phrase is not None and not _is_contact(item)]
    return _named("touches", objects[-1] if objects else None)


def _named(relation: Relation, target: Item | None) -> Asked | None:
    """The relation to one named thing, or to any; None where what is named is no thing, such as the floor."""
    if target is None or target.phrase is None:
        return None
    if set(target.words) & _ANYTHING and target.phrase.colour is None and target.phrase.number is None:
        return Asked(relation, None)
    if is_vague(target) or target.phrase.head in lex.ABSTRACT | lex.SCENERY:
        return None
    return Asked(relation, target.phrase)
