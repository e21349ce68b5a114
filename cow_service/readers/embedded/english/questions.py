"""Parses a what-if question in English with plain rules: what moves, how, what else is named, what is asked.

No model and no list of nouns: verbs and function words are closed lists, the noun phrases are what lies between.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from cow_service.readers.base import Quantity
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import read_from
from cow_service.readers.embedded.english.interventions import (
    InterventionWords,
    TrailWords,
    implied_placing,
    split_interventions,
    split_trail,
)
from cow_service.readers.embedded.english.lexicon import (
    SETS,
    Item,
    ObjectPhrase,
    key_at,
    phrase_at,
    tokens,
    words,
)
from cow_service.readers.embedded.english.motion import (
    Clauses,
    MotionCandidate,
    MotionWords,
    OtherWords,
    arrow_statement,
    clause_end,
    is_passive,
    is_vague,
    read_clauses,
    read_motion,
    with_front,
)
from cow_service.readers.embedded.english.noun_phrases import items, with_nouns, with_places, with_tables
from cow_service.readers.embedded.english.spelling import without_typing_errors
from cow_service.readers.options import split_options
from cow_service.records import MotionKind

_ENDS = frozenset(".?!;")
_WINDOW = 24  # words of the openings of one sentence
_MAX_TRIES = 12  # of one question
_LONGEST_FIRST = sorted(map(re.escape, lex.TABLES["said_as"]), key=len, reverse=True)
_SAID_AS = re.compile(rf"\b(?:{'|'.join(_LONGEST_FIRST)})\b", re.I)
_TAG = re.compile(rf",\s*(?:{'|'.join(lex.SETS['tags'])})\s*\?(?=\s+\S)", re.I)  # and something else is asked


def without_openings(text: str) -> str:
    """The text without openings; what asks by a statement ("I wonder whether it ...") begins with "tell me" then.

    Words of informal English are put as the grammar has them ("gonna" as "going to").
    """
    text = _TAG.sub(".", text)
    text = _SAID_AS.sub(lambda found: lex.TABLES["said_as"][found[0].lower()], text.replace("’", "'"))
    found, kept, end, tries = tokens(text), list[str](), 0, 0
    for at in range(len(found)):
        if not (at == 0 or key_at(found, at - 1) in _ENDS) or tries >= _MAX_TRIES:
            continue
        tries += 1
        parsed = read_from("opening", found, at, _WINDOW)
        if parsed is None:
            continue
        tree, behind = parsed
        asks = next(tree.find_data("asks_if"), None)
        kept += [text[end : found[at].start], "" if asks is None else f"tell me {found[behind - 1].key} "]
        end = found[behind].start if behind < len(found) else len(text)
    return "".join([*kept, text[end:]])


# Sentences of the text, and what those are about that say how to reply.
_BETWEEN_SENTENCES = re.compile(r"((?<=[.?!])\s+|\n+)")
_BETWEEN_PARTS = re.compile(r"((?<=[.?!;:])\s+)")
_PICTURES = words("image images frame frames picture pictures photo photos")
_ABOUT_REPLY = re.compile(
    r"\byour (?:\w+ ){0,2}(?:response|answer|reply|output)s?\b|\bjson\b|answer\s*:\s*\$|\$\s?letter\b", re.IGNORECASE
)
_CONDITION = re.compile(r"\b(?:if|when|once|suppose|assum\w+|imagine)\b", re.IGNORECASE)
_YES_NO = re.compile(r"[\s,]*[(\[]\s*yes\s*(?:/|\bor\b|,)\s*no\s*[)\]]?\.?\s*$", re.IGNORECASE)  # what may be replied
_HEADING = re.compile(r"^[ \t]*question[ \t]*(?:\d+[ \t]*)?:[ \t]*", re.IGNORECASE | re.MULTILINE)


def without_reply_form(prompt: str) -> str:
    """The prompt without the heading of its question, and without sentences that say how to reply and nothing else."""
    sentences = _BETWEEN_SENTENCES.split(_YES_NO.sub("", _HEADING.sub("", prompt)))
    kept = "".join(each for each in sentences if not _ABOUT_REPLY.search(each) or _CONDITION.search(each))
    parts: list[str] = []
    for part in _BETWEEN_PARTS.split(kept):
        said = re.findall(r"\w+", part.lower())
        first = next((word for word in said[:2] if word != "please"), "")
        if not (first in SETS["instructions"] or (first == "note" and not _PICTURES.isdisjoint(said))):
            parts.append(part)  # the others say what to do, or what the images are
    return "".join(parts)


MAX_WORDS = 240  # of a question that are read
_EACH_OF_TWO = lex.words("both each together")
_HOW_MANY = lex.words("the all both either none two three")
_SAME_TIME = re.compile(
    r"\b(?:at the (?:very )?same (?:time|moment|instant)|simultaneously)\b(?P<joins> as\b)?", re.IGNORECASE
)
# Words that say which way, wherever they stand.
_DIRECTION_WORDS = re.compile(
    r"\b(left|right|up|down|upwards?|downwards?|leftwards?|rightwards?|north|south|east|west|(north|south)-?(east|west)"
    r"|clockwise|counterclockwise|towards?|away|diagonal(ly)?|degrees?|sideways|back|backwards?|forwards?|other way)\b",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Question:
    """A what-if question taken apart.

    `others` are the further objects it names, in order, without the mover and without what is taken away; `items`, all
    its words and noun phrases, but for the options that it lists, its `interventions` and its trail.
    `clause` are the items that tell the motion. `names_direction`: some word says which way, whether or not it was
    understood. `read` are the places in the text of the items that tell the motion and were understood.
    """

    mover: ObjectPhrase | None
    motion: MotionWords
    others: tuple[ObjectPhrase, ...]
    items: tuple[Item, ...]
    interventions: tuple[InterventionWords, ...]
    clause: tuple[Item, ...]
    mentions_arrow: bool
    names_direction: bool
    beyond: str = ""  # how what is not read any more begins
    pronoun: str = ""  # that stands for the mover where it may stand for two things
    read: frozenset[int] = frozenset()
    errors: tuple[tuple[str, str], ...] = ()  # typing errors, each with the word that it was read as

    def has_read(self, at: int) -> bool:
        """Whether the item at a place tells the motion and was understood."""
        return self.items[at].start in self.read


@lru_cache(maxsize=64)  # every stage of a request asks for it
def parse(question: str) -> Question:
    """Takes a question apart. Never raises: what the question does not say is None or empty."""
    text = without_reply_form(split_options(question).rest)
    found = tokens(text)
    beyond = ""
    if len(found) > MAX_WORDS:
        text, rest = text[: found[MAX_WORDS].start], found[MAX_WORDS : MAX_WORDS + 7]
        beyond = " ".join(each.key for each in rest)
    text, errors = without_typing_errors(_SAME_TIME.sub(lambda same: "and" if same["joins"] else "", text))
    text = without_openings(text)
    changes, found = split_interventions(with_places(with_nouns(with_tables(items(text)))))
    trail, found = split_trail(found)
    clauses = read_clauses(found)
    best = max(clauses.candidates, key=lambda candidate: candidate.rank, default=None)  # the first of the highest
    best = _before_while(found, clauses, best)
    at = best.at if best else len(found)
    mover = (best.subject if best else None) or _antecedent(found, clauses, at)
    mover = _in_full(mover, found[:at], changes) if mover else None
    arrow = any(token.key.startswith("arrow") for token in tokens(text))
    clause, motion = _motion(found, clauses, best, mover, arrow, changes)
    if trail is not None and trail.near is None and trail.side is None:
        trail = replace(trail, side=motion.direction)  # "on along its trail to the right": its last end is there
    motion, fitted = replace(motion, trail=trail), frozenset[int]()
    if not changes and (best is None or (best.asked and not _says_way(motion))):
        changes, fitted = implied_placing(found)
    read = motion.read.union(fitted, *(other.motion.read for other in motion.others))
    put = next((change for change in changes if change.kind == "place"), None)
    # "If you lift the ball and put it into the mug": the lifting is a part of it.
    lifted = best.subject if best is not None and best.verb in {"lift", "raise", "carry", "bring"} else None
    carried = put is not None and lifted == put.object
    way = best is None and motion.arrow is not None and bool(clauses.question_subjects)  # "on its way along the arrow"
    if put is not None and not way and (best is None or best.asked or best.kind == "static" or carried):
        mover, motion = put.object, replace(motion, kind="place", verb="put")
    return Question(
        mover=mover,
        motion=motion,
        others=_others(found, mover, clause, changes, trail),
        items=tuple(found),
        interventions=changes,
        clause=tuple(found[clause.start : clause.stop]),
        mentions_arrow=arrow,
        names_direction=_DIRECTION_WORDS.search(text) is not None,
        beyond=beyond,
        pronoun=_open_pronoun(found, best, mover),
        read=read.union(item.start for item in found[clause.start : clause.stop]) if carried else read,
        errors=errors,
    )


def _motion(
    found: Sequence[Item],
    clauses: Clauses,
    best: MotionCandidate | None,
    mover: ObjectPhrase | None,
    arrow: bool,
    changes: Sequence[InterventionWords],
) -> tuple[range, MotionWords]:
    """The places of the clause that tells the motion, and what it tells."""
    at = best.at if best else len(found)
    beside = _movers_beside(found, clauses, best)
    end = min([clause_end(found, at) if best else at, *(other.start for other in beside)])
    shared = _sharing(found, at, end)
    verb, kind = (best.verb, best.kind) if best else _falling(found, changes, mover)
    motion = read_motion(
        found[at : shared or end], verb, kind, mover, asked=best is not None and best.asked, arrow=arrow
    )
    start = best.start if best else 0
    motion = with_front(motion, found[start:at] if best else found, arrow_statement(found))
    speeds = [(item.start, item.quantity) for item in [*found[:start], *found[end:]] if item.quantity]
    speeds = [(place, said) for place, said in speeds if isinstance(said.speed, Quantity)]
    motion = replace(
        motion,
        quantities=(*motion.quantities, *(said for _, said in speeds)),
        read=motion.read.union(place for place, _ in speeds),
        others=_other_motions(found, clauses, best, shared, end),
    )
    return range(start if best else at, end), motion


def parse_noun_phrase(text: str) -> ObjectPhrase | None:
    """The first noun phrase of a text such as "the red toy car"; None where there is none."""
    found = items("the " + text.removeprefix("the "))
    phrase = next((item.phrase for item in found if item.phrase is not None), None)
    if phrase is not None and phrase.colour is None and phrase.noun in lex.COLOURS:
        return replace(phrase, colour=lex.COLOURS[phrase.noun])  # "the dark blue"
    return phrase


def _falling(
    found: Sequence[Item], changes: Sequence[InterventionWords], mover: ObjectPhrase | None
) -> tuple[str, MotionKind | None]:
    """ "What does it touch on its way down?", "the falling ball", and "where would it land?" without its support."""
    removed = any(change.kind == "remove" for change in changes)
    falls = any(removed and lex.lemma(item.key) in {"land", "happen"} for item in found) or any(
        item.words[-1:] == ("way",) and key_at(found, at - 1) == "on" and key_at(found, at + 1) == "down"
        for at, item in enumerate(found)
    )
    falls = falls or (mover is not None and "falling" in mover.text.lower().split()[:-1])
    return ("fall", "fall") if falls else ("", None)


def _says_way(motion: MotionWords) -> bool:
    """Whether a motion has a direction of any sort."""
    said = (motion.direction, motion.arrow, motion.forward, motion.trail)
    return bool(motion.depth) or motion.kind in {"fall", "projectile"} or any(each is not None for each in said)


def _antecedent(found: Sequence[Item], clauses: Clauses, at: int) -> ObjectPhrase | None:
    """What a pronoun, or a clause without a subject, stands for: who acts in a passive question, else its subject."""
    for place, item in enumerate(found):
        acting = key_at(found, place - 1) == "by" and is_passive(found, place - 2) if place > 1 else False
        if acting and item.phrase and item.phrase.head not in lex.ABSTRACT | lex.AGENTS and not is_vague(item):
            return item.phrase
    things = [(place, item.phrase) for place, item in enumerate(found) if item.phrase and not is_vague(item)]
    named = [(place, phrase) for place, phrase in things if phrase.is_thing]
    asked = [(place, phrase) for place, phrase in clauses.question_subjects if phrase.head not in lex.ABSTRACT]
    before = [phrase for place, phrase in asked if place < at] + [phrase for place, phrase in named if place < at]
    return next(iter(before + [phrase for _, phrase in asked + named]), None)


def _open_pronoun(found: Sequence[Item], best: MotionCandidate | None, mover: ObjectPhrase | None) -> str:
    """The pronoun that moves where two things were named alike before it: "the ball and the mug ... if it rolls"."""
    if best is None or best.subject is not None:
        return ""
    for at in range(best.at - 2):
        two = found[at].phrase, found[at + 2].phrase
        if found[at + 1].key == "and" and mover in two and all(each is not None and each.is_thing for each in two):
            return next((item.key for item in found[at + 3 : best.at] if item.key in lex.MOVER_PRONOUNS), "")
    return ""


def _movers_beside(found: Sequence[Item], clauses: Clauses, best: MotionCandidate | None) -> list[MotionCandidate]:
    """Motions of other things than the mover's, said in the same way: "the ball moves left and the car goes right"."""
    if best is None or best.asked or best.subject is None or best.subject.head in lex.AGENTS:
        return []
    while_it = found[best.start].key == "while"  # "while the ball rolls right, the mug slides left"
    return [
        each
        for each in clauses.candidates
        if (each.rank == best.rank or (not each.asked and (while_it or found[each.start].key == "while")))
        and each.at > best.at and each.kind not in {None, "static"}
        and each.start > best.at and each.subject is not None and (each.subject.noun or each.subject.colour)
        and all(item.key != "whether" for item in found[best.at : each.at])  # it is asked, not told
        and not _repeats(each.subject, best.subject)
    ]  # fmt: skip


def _before_while(found: Sequence[Item], clauses: Clauses, best: MotionCandidate | None) -> MotionCandidate | None:
    """The motion in front of "while", where both are told: "the mug slides left by 20 px while the ball drops"."""
    if best is None or best.asked or found[best.start].key != "while":
        return best
    told = [
        each
        for each in clauses.candidates
        if each.at < best.start and not each.asked and each.kind not in {None, "static"}
        and each.subject is not None and each.subject.is_thing and each.subject.head not in lex.AGENTS
        and clause_end(found, each.at) == best.start
    ]  # fmt: skip
    return told[-1] if told and best.kind not in {None, "static"} else best


def _other_motions(
    found: Sequence[Item], clauses: Clauses, best: MotionCandidate | None, shared: int | None, end: int
) -> tuple[OtherWords, ...]:
    """What else moves at the same time, and how."""
    others: list[OtherWords] = []
    if best is not None and shared is not None and (thing := found[shared + 1].phrase) is not None:
        others.append(_other_motion(thing, best, found[shared + 1 : end]))
    others += _joint_motion(found, best, end)
    for each in _movers_beside(found, clauses, best):
        if each.subject is not None and all(each.subject != other.object for other in others):
            others.append(_other_motion(each.subject, each, found[each.at : clause_end(found, each.at)]))
    return tuple(others)


def _sharing(found: Sequence[Item], at: int, end: int) -> int | None:
    """Where a second mover shares the verb: "the ball moves left and the car to the right"."""
    for place in range(at + 1, end - 2):
        phrase = found[place + 1].phrase
        if found[place].key in {"and", "while"} and phrase is not None and phrase.is_thing:
            way = read_motion(found[place + 1 : end], "", None, None)
            if way.direction is not None or way.depth:
                return place
    return None


def _other_motion(thing: ObjectPhrase, verb: MotionCandidate, words: Sequence[Item]) -> OtherWords:
    motion = read_motion(words, verb.verb, verb.kind, thing)
    # How far and how long a second mover moves is beyond the reader, and so is a second leg: left unread.
    lengths = {item.start for item in words if item.quantity is not None and item.quantity.speed is None}
    return OtherWords(thing, replace(motion, read=frozenset[int]() if motion.steps else motion.read - lengths))


def _joint_motion(found: Sequence[Item], best: MotionCandidate | None, end: int) -> list[OtherWords]:
    """The second of two subjects of one verb: "the ball and the mug both move to the right"."""
    if best is None or best.asked or best.kind in {None, "static"} or best.subject is None:
        return []
    if found[best.at].key in lex.VERBS and lex.VERBS[found[best.at].key].form == "s":
        return []  # "the ball between the cube and the mug rolls": one thing moves
    at = best.at - (key_at(found, best.at - 1) in _EACH_OF_TWO)
    thing, joined = phrase_at(found, at - 1), key_at(found, at - 2) == "and"
    if thing is None or not thing.is_thing or not joined or phrase_at(found, at - 3) != best.subject:
        return []
    words = found[best.at : end]
    motion = read_motion(words, best.verb, best.kind, thing)
    if motion.steps or any(item.quantity is not None and item.quantity.speed is None for item in words):
        return []  # of the first mover alone the reader tells how far it goes
    both = {found[each].start for each in range(at, best.at)}
    return [OtherWords(thing, replace(motion, read=motion.read | both))]


def _in_full(mover: ObjectPhrase, before: Sequence[Item], changes: Sequence[InterventionWords]) -> ObjectPhrase:
    """The first mention of the mover where it is worded more fully: "the white pawn ... if the pawn moves"."""
    named = [item.phrase for item in before if item.phrase]
    named += [phrase for change in changes for phrase in (change.object, *change.targets) if change.kind == "place"]
    fuller = {phrase for phrase in named if phrase != mover and _repeats(mover, phrase)}
    return fuller.pop() if len(fuller) == 1 else mover


def _others(
    found: Sequence[Item],
    mover: ObjectPhrase | None,
    clause: range,
    interventions: Sequence[InterventionWords],
    trail: TrailWords | None,
) -> tuple[ObjectPhrase, ...]:
    changed = [change.object for change in interventions]
    named = [phrase for change in interventions for phrase in change.targets]
    named += [] if trail is None or trail.near is None else [trail.near]
    things = [(at, item, item.phrase) for at, item in enumerate(found)]
    things += [(at, item, item.phrase.place.of) for at, item, _ in things if item.phrase and item.phrase.place]
    for at, item, phrase in sorted(things, key=lambda each: each[0]):
        if phrase is None or is_vague(item) or _HOW_MANY.issuperset(item.words):
            continue
        bare = phrase.head in lex.GENERIC or phrase.noun is None
        singled_out = phrase.colour is not None or phrase.inside_box or phrase.number is not None
        if not (singled_out if bare else phrase.is_thing) or (at in clause and phrase.head in lex.AGENTS):
            continue
        if phrase.noun in lex.ADJECTIVES and item.words[0] not in lex.DETERMINERS:
            continue  # "which ball will it hit first?"
        again = item.words[0] != "another" and any(
            _repeats(phrase, known) for known in (mover, *named, *changed) if known
        )
        if not again:
            named.append(phrase)
    return tuple(named)


def _repeats(phrase: ObjectPhrase, known: ObjectPhrase) -> bool:
    """Whether a later phrase means an earlier object: no word in it that the earlier one lacks."""
    words, earlier = set(phrase.text.lower().split()), set(known.text.lower().split())
    return phrase.head in {known.head, None} and words - {"one"} <= earlier
