"""Parses a what-if question in English with plain rules: what moves, how, what else is named, what is asked.

No model and no list of nouns: verbs and function words are closed lists, the noun phrases are what lies between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.arrow_words import read_arrow
from cow_service.readers.question.chunks import items
from cow_service.readers.question.clauses import SENTENCE_END, Reading, clause_end, is_passive, is_vague, read_clauses
from cow_service.readers.question.listed_options import Options, split_options
from cow_service.readers.question.motion_words import MotionWords, read_motion
from cow_service.readers.question.phrases import Item, ObjectPhrase, flatten, key_at, phrase_at

Asks = Literal["touches", "occludes", "lands", "other"]

_UNSEEN = lex.words("visible invisible unseen hidden seen sight occlusion")
_MEETING = lex.words("collision contact impact")
_COMES_DOWN = lex.words("fall drop tumble plunge come stop rest end")
_ONTO = lex.words("on onto upon in into inside")
_INSTRUCTIONS = lex.words(
    "answer choose select pick option options choices explain respond reply provide return output"
)


@dataclass(frozen=True)
class Question:
    """A what-if question taken apart. `others` are the further objects it names, in order, without the mover."""

    text: str
    mover: ObjectPhrase | None
    motion: MotionWords
    others: tuple[ObjectPhrase, ...]
    asks: Asks
    options: Options


def parse(question: str) -> Question:
    """Takes a question apart. Never raises: what the question does not say is None or empty."""
    options, body = split_options(question)
    found = _without_instructions(items(body))
    reading = read_clauses(found)
    event = max(reading.events, key=lambda event: event.rank, default=None)  # the first of the highest
    at = event.at if event else len(found)
    end = clause_end(found, at) if event else at
    mover = (event.subject if event else None) or _antecedent(found, reading, at)
    mover = _in_full(mover, found[:at]) if mover else None
    verb, kind = (event.verb, event.kind) if event else ("", None)
    motion = read_motion(found[at:end], verb, kind, read_arrow(found), mover, asked=event is not None and event.asked)
    clause = range(event.start if event else at, end)
    return Question(question, mover, motion, _others(found, mover, clause), _asks(found, clause, at), options)


def _antecedent(found: Sequence[Item], reading: Reading, at: int) -> ObjectPhrase | None:
    """What a pronoun, or a clause without a subject, stands for: who acts in a passive question, else its subject."""
    for place, item in enumerate(found):
        acting = key_at(found, place - 1) == "by" and is_passive(found, place - 2) if place > 1 else False
        if acting and item.phrase and item.phrase.head not in lex.ABSTRACT | lex.AGENTS and not is_vague(item):
            return item.phrase
    named = [(place, item.phrase) for place, item in enumerate(found) if item.phrase and _is_thing(item)]
    asked = [(place, phrase) for place, phrase in reading.asked if phrase.head not in lex.ABSTRACT]
    before = [phrase for place, phrase in asked if place < at] + [phrase for place, phrase in named if place < at]
    return next(iter(before + [phrase for _, phrase in asked + named]), None)


def _is_thing(item: Item) -> bool:
    head = item.phrase.head if item.phrase else None
    return head is not None and head not in lex.ABSTRACT and head not in lex.SCENERY and not is_vague(item)


def _in_full(mover: ObjectPhrase, before: Sequence[Item]) -> ObjectPhrase:
    """The first mention of the mover where it is worded more fully: "the white pawn ... if the pawn moves"."""
    fuller = {item.phrase for item in before if item.phrase and item.phrase != mover and _repeats(mover, item.phrase)}
    return fuller.pop() if len(fuller) == 1 else mover


def _without_instructions(found: list[Item]) -> list[Item]:
    kept: list[Item] = []
    sentence: list[Item] = []
    for item in [*found, Item(".", 0, 0)]:
        sentence.append(item)
        if item.key in SENTENCE_END:
            first = [word for told in sentence[:2] for word in (told.words or (told.key,)) if word != "please"]
            if first and first[0] not in _INSTRUCTIONS:
                kept += sentence
            sentence = []
    return kept


def _others(found: Sequence[Item], mover: ObjectPhrase | None, clause: range) -> tuple[ObjectPhrase, ...]:
    named: list[ObjectPhrase] = []
    for at, item in enumerate(found):
        phrase = item.phrase
        if phrase is None or is_vague(item) or not _is_object(phrase) or (at in clause and phrase.head in lex.AGENTS):
            continue
        if phrase.noun in lex.ADJECTIVES and item.words[0] not in lex.DETERMINERS:
            continue  # "which ball will it hit first?"
        again = item.words[0] != "another" and any(_repeats(phrase, known) for known in (mover, *named) if known)
        if not again:
            named.append(phrase)
    return tuple(named)


def _is_object(phrase: ObjectPhrase) -> bool:
    """Whether a phrase names an object of its own: not the floor or the arrow, not a bare "object"."""
    if phrase.head in lex.GENERIC or phrase.noun is None:
        return phrase.colour is not None or phrase.inside_box or phrase.number is not None
    return phrase.head not in lex.ABSTRACT and phrase.head not in lex.SCENERY


def _repeats(phrase: ObjectPhrase, known: ObjectPhrase) -> bool:
    """Whether a later phrase means an earlier object: no word in it that the earlier one lacks."""
    words, earlier = set(phrase.text.lower().split()), set(known.text.lower().split())
    return phrase.head in {known.head, None} and words - {"one"} <= earlier


def _asks(found: Sequence[Item], clause: range, verb: int) -> Asks:
    """What is asked, from the first word that tells outside the clause of the motion, else inside it."""
    outside = [at for at in range(len(found)) if at not in clause]
    for at in [*outside, *(at for at in clause if at != verb)]:
        asked = _asks_at(found, at)
        if asked:
            return asked
    return "other"


def _asks_at(found: Sequence[Item], at: int) -> Asks | None:
    key, verb = found[at].key, lex.VERBS.get(found[at].key)
    lemma = verb.lemma if verb else ""
    after = [key_at(found, at + 1), key_at(found, at + 2)]
    if lemma in lex.OCCLUDE or not _UNSEEN.isdisjoint(flatten(found[at : at + 1])) or _passes_before(found, at):
        return "occludes"
    if lemma in lex.LAND or (lemma in _COMES_DOWN and _ONTO.intersection(after)) or (key == "end" and "on" in after):
        return "lands"
    if lemma in lex.TOUCH or not _MEETING.isdisjoint(found[at].words):
        return "touches"
    return "touches" if verb and verb.kind == "linear" and after[0] == "into" and phrase_at(found, at + 2) else None


def _passes_before(found: Sequence[Item], at: int) -> bool:
    """ "pass in front of the vase", "go behind it"; but not "the vase behind the chair"."""
    key, before = found[at].key, found[at - 1] if at else None
    place = key == "behind" or (key == "in" and key_at(found, at + 1) == "front" and key_at(found, at + 2) == "of")
    return place and before is not None and (before.key in lex.VERBS or before.key in {"be", "get"})
