"""Parses a what-if question in English with plain rules: what moves, how, what else is named, and the question itself.

No model and no list of nouns: verbs and function words are closed lists, the noun phrases are what lies between.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from cow_service.readers.base import Quantity
from cow_service.readers.embedded.english import interventions, motion, noun_phrases
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.readers.embedded.english.grammar import read_from
from cow_service.readers.embedded.english.interventions import InterventionWords, TrailWords
from cow_service.readers.embedded.english.lexicon import Item, ObjectPhrase, key_at
from cow_service.readers.embedded.english.motion import MotionCandidate, MotionWords, OtherWords
from cow_service.readers.options import plain, split_options

MAX_WORDS = 240  # of a question that are read
_HOW_MANY = lex.words("the all both either none two three")
_SAME_TIME = re.compile(
    r"\b(?:at the (?:very )?same (?:time|moment|instant)|simultaneously)\b(?P<joins> as\b)?", re.IGNORECASE
)
# Words that say which way, wherever they stand.
_DIRECTION_WORDS = re.compile(
    r"\b(left|right|up|down|upwards?|downwards?|leftwards?|rightwards?|north|south|east|west|(north|south)-?(east|west)"
    r"|clockwise|counterclockwise|opposite|reversed?|towards?|away|diagonal(ly)?|degrees?|sideways|back|backwards?"
    r"|forwards?|other way)\b",
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

    text: str
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

    def has_read(self, at: int) -> bool:
        """Whether the item at a place expresses the motion and was understood."""
        return self.items[at].start in self.read

    def means_mover(self, phrase: ObjectPhrase) -> bool:
        """Whether a phrase speaks of the mover again: no word in it that the mover's own lacks."""
        words = set(plain(phrase.text).split())
        return self.mover is not None and bool(words) and words <= set(plain(self.mover.text).split())


@lru_cache(maxsize=64)  # every stage of a request asks for it
def parse(question: str) -> Question:
    """Takes a question apart. Never raises: what the question does not say is None or empty."""
    text = without_reply_form(split_options(question).rest)
    found = lex.tokens(text)
    beyond = ""
    if len(found) > MAX_WORDS:
        text, beyond = text[: found[MAX_WORDS].start], " ".join(text[found[MAX_WORDS].start :].split()[:7])
    text = without_openings(_SAME_TIME.sub(lambda same: "and" if same["joins"] else "", text))
    arrow = any(token.key.startswith("arrow") for token in lex.tokens(text))
    found = noun_phrases.with_nouns(noun_phrases.with_tables(noun_phrases.items(text)))
    changes, found = interventions.split_interventions(noun_phrases.with_places(found))
    trail, found = interventions.split_trail(found)
    candidates, subjects = motion.read_clauses(found)
    best = _best(found, candidates)
    mover = _mover(found, subjects, best, changes)
    clause, told = _motion(found, candidates, best, mover, changes)
    if trail is not None and trail.near is None and trail.side is None:
        trail = replace(trail, side=told.direction)  # "on along its trail to the right": its last end is there
    told, fitted = replace(told, trail=trail), frozenset[int]()
    if not changes and (best is None or (best.asked and not told.says_way)):
        changes, fitted = interventions.implied_placing(found)
    read = told.read.union(fitted, *(other.motion.read for other in told.others))
    put = next((change for change in changes if change.kind == "place"), None)
    # "If you lift the ball and put it into the mug": the lifting is a part of it.
    lifted = best.subject if best is not None and best.verb in {"lift", "raise", "carry"} else None
    carried = put is not None and lifted == put.object
    if carried:
        read = read.union(item.start for item in found[clause.start : clause.stop])
    way = best is None and told.arrow is not None and bool(subjects)  # "on its way along the arrow"
    if put is not None and not way and (best is None or best.asked or best.kind == "static" or carried):
        mover, told = put.object, replace(told, kind="place", verb="put")
    return Question(
        text=text,
        mover=mover,
        motion=told,
        others=_others(found, mover, clause, changes, trail),
        items=tuple(found),
        interventions=changes,
        clause=tuple(found[clause.start : clause.stop]),
        mentions_arrow=arrow,
        names_direction=_DIRECTION_WORDS.search(text) is not None,
        beyond=beyond,
        pronoun=_open_pronoun(found, best, mover),
        read=read,
    )


def _best(found: Sequence[Item], candidates: Sequence[MotionCandidate]) -> MotionCandidate | None:
    """The verb of the motion: the first of the highest rank."""
    best = max(candidates, key=lambda candidate: candidate.rank, default=None)
    if best is None or best.asked or not best.moves or found[best.start].key != "while":
        return best
    # In front of "while", where both motions are given: "the mug slides left by 20 px while the ball drops".
    told = [
        each
        for each in candidates
        if each.at < best.start and not each.asked and each.moves and motion.clause_end(found, each.at) == best.start
        and each.subject is not None and each.subject.is_thing and each.subject.head not in lex.AGENTS
    ]  # fmt: skip
    return told[-1] if told else best


def _mover(
    found: Sequence[Item],
    subjects: Sequence[tuple[int, ObjectPhrase]],
    best: MotionCandidate | None,
    changes: Sequence[InterventionWords],
) -> ObjectPhrase | None:
    """The moving object, in its fullest wording."""
    at = best.at if best else len(found)
    mover = best.subject if best else None
    certain = [(place, item.phrase) for place, item in enumerate(found) if item.phrase and not motion.is_vague(item)]
    if mover is None:
        # A pronoun, or a clause without a subject, means the agent of a passive question, else its subject.
        acting = [
            phrase
            for place, phrase in certain
            if place > 1 and found[place - 1].key == "by" and motion.is_passive(found, place - 2)
            and phrase.head not in lex.ABSTRACT | lex.AGENTS
        ]  # fmt: skip
        asked = [each for each in subjects if each[1].head not in lex.ABSTRACT]
        named = [(place, phrase) for place, phrase in certain if phrase.is_thing]
        before = [phrase for each in (asked, named) for place, phrase in each if place < at]
        mover = next(iter([*acting, *before, *(phrase for _, phrase in asked + named)]), None)
    if mover is None:
        return None
    # "The white pawn ... if the pawn moves".
    told = [item.phrase for item in found[:at] if item.phrase]
    told += [phrase for change in changes for phrase in (change.object, *change.targets) if change.kind == "place"]
    fuller = {phrase for phrase in told if phrase != mover and _repeats(mover, phrase)}
    return fuller.pop() if len(fuller) == 1 else mover


def _motion(
    found: Sequence[Item],
    candidates: Sequence[MotionCandidate],
    best: MotionCandidate | None,
    mover: ObjectPhrase | None,
    changes: Sequence[InterventionWords],
) -> tuple[range, MotionWords]:
    """The places of the clause with the motion, and its content."""
    at, start = (best.at, best.start) if best else (len(found), 0)
    verb, kind = (best.verb, best.kind) if best else ("", None)
    if best is None:
        # "What does it touch on its way down?", "the falling ball", and "where would it land?" without its support.
        ways = (place for place, item in enumerate(found) if item.words[-1:] == ("way",))
        down = any(key_at(found, way - 1) == "on" and key_at(found, way + 1) == "down" for way in ways)
        removed = any(change.kind == "remove" for change in changes)
        lands = removed and any(lex.lemma(item.key) in {"land", "happen"} for item in found)
        if down or lands or (mover is not None and "falling" in mover.text.lower().split()[:-1]):
            verb, kind = "fall", "fall"
    beside = _movers_beside(found, candidates, best)
    end = min([motion.clause_end(found, at) if best else at, *(other.start for other in beside)])
    asked = best is not None and best.asked
    told = motion.read_motion(found[at:end], verb, kind, mover, asked=asked)
    told = motion.with_front(told, found[start:at] if best else found)
    elsewhere = [(item.start, item.quantity) for item in [*found[:start], *found[end:]] if item.quantity]
    speeds = {place: said for place, said in elsewhere if isinstance(said.speed, Quantity)}
    others = dict[ObjectPhrase, OtherWords]()
    for each in beside:
        if each.subject is not None:
            others.setdefault(each.subject, _other_motion(found, each, each.subject))
    told = replace(
        told,
        quantities=(*told.quantities, *speeds.values()),
        read=told.read.union(speeds),
        others=tuple(others.values()),
    )
    return range(start if best else at, end), told


def _movers_beside(
    found: Sequence[Item], candidates: Sequence[MotionCandidate], best: MotionCandidate | None
) -> list[MotionCandidate]:
    """Motions of other things than the mover's, said in the same way: "the ball moves left and the car goes right"."""
    if best is None or best.asked or best.subject is None or best.subject.head in lex.AGENTS:
        return []
    while_it = found[best.start].key == "while"  # "while the ball rolls right, the mug slides left"
    return [
        each
        for each in candidates
        if (each.rank == best.rank or (not each.asked and (while_it or found[each.start].key == "while")))
        and each.at > best.at and each.start > best.at and each.moves
        and each.subject is not None and (each.subject.noun or each.subject.colour)
        and all(item.key != "whether" for item in found[best.at : each.at])  # it is a question, not a statement
        and not _repeats(each.subject, best.subject)
    ]  # fmt: skip


def _other_motion(found: Sequence[Item], verb: MotionCandidate, thing: ObjectPhrase) -> OtherWords:
    """How another thing moves at the same time.

    How far and how long a second mover moves is beyond the reader, and so is a second leg: left unread.
    """
    words = found[verb.at : motion.clause_end(found, verb.at)]
    told = motion.read_motion(words, verb.verb, verb.kind, thing)
    lengths = {item.start for item in words if item.quantity is not None and item.quantity.speed is None}
    return OtherWords(thing, replace(told, read=frozenset() if told.steps else told.read - lengths))


def _open_pronoun(found: Sequence[Item], best: MotionCandidate | None, mover: ObjectPhrase | None) -> str:
    """The pronoun that moves where two things were named alike before it: "the ball and the mug ... if it rolls"."""
    if best is None or best.subject is not None:
        return ""
    for at in range(best.at - 2):
        two = found[at].thing, found[at + 2].thing
        if found[at + 1].key == "and" and mover in two and None not in two:
            return next((item.key for item in found[at + 3 : best.at] if item.key in lex.MOVER_PRONOUNS), "")
    return ""


def _others(
    found: Sequence[Item],
    mover: ObjectPhrase | None,
    clause: range,
    changes: Sequence[InterventionWords],
    trail: TrailWords | None,
) -> tuple[ObjectPhrase, ...]:
    """The further things that are named, each once."""
    known = [phrase for phrase in (mover, *(change.object for change in changes)) if phrase is not None]
    named = [phrase for change in changes for phrase in change.targets]
    named += [] if trail is None or trail.near is None else [trail.near]
    for at, item in enumerate(found):
        place = item.phrase.place if item.phrase is not None else None
        for phrase in (item.phrase, None if place is None else place.of):
            if phrase is None or motion.is_vague(item) or _HOW_MANY.issuperset(item.words):
                continue
            bare = phrase.head in lex.GENERIC or phrase.noun is None
            singled_out = phrase.colour is not None or phrase.inside_box or phrase.number is not None
            acts = at in clause and phrase.head in lex.AGENTS
            # "Which ball will it hit first?"
            adjective = phrase.noun in lex.SETS["adjectives"] and item.words[0] not in lex.DETERMINERS
            if not (singled_out if bare else phrase.is_thing) or acts or adjective:
                continue
            if item.words[0] == "another" or not any(_repeats(phrase, earlier) for earlier in (*known, *named)):
                named.append(phrase)
    return tuple(named)


def _repeats(phrase: ObjectPhrase, known: ObjectPhrase) -> bool:
    """Whether a later phrase means an earlier object: no word in it that the earlier one lacks."""
    return phrase.head in {known.head, None} and phrase.words - {"one"} <= known.words


# Sentences of the text, and what those are about that say how to reply.
_BETWEEN_SENTENCES = re.compile(r"((?<=[.?!])\s+|\n+)")
_BETWEEN_PARTS = re.compile(r"((?<=[.?!;:])\s+)")
_PICTURES = lex.words("image images frame frames picture pictures photo photos")
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
        if not (first in lex.SETS["instructions"] or (first == "note" and not _PICTURES.isdisjoint(said))):
            parts.append(part)  # the others say what to do, or what the images are
    return "".join(parts)


_OPENING = 24  # words of the openings of one sentence
_MAX_TRIES = 12  # of one question
_LONGEST_FIRST = sorted(map(re.escape, lex.TABLES["said_as"]), key=len, reverse=True)
_SAID_AS = re.compile(rf"\b(?:{'|'.join(_LONGEST_FIRST)})\b", re.IGNORECASE)
_TAG = re.compile(rf",\s*(?:{'|'.join(lex.SETS['tags'])})\s*\?(?=\s+\S)", re.IGNORECASE)  # and something else is asked
_CLAIM = re.compile(r"(^|[.!]\s)\s*true or false\s*[:?,]?\s+([^.?!]+)[.?]?\s*$", re.IGNORECASE)  # the last sentence


def without_openings(text: str) -> str:
    """The text without openings; what asks by a statement ("I wonder whether it ...") begins with "tell me" then.

    Words of informal English are put as the grammar has them ("gonna" as "going to").
    """
    text = _CLAIM.sub(r"\1\2?", _TAG.sub(".", text))
    text = _SAID_AS.sub(lambda found: lex.TABLES["said_as"][found[0].lower()], text.replace("’", "'"))
    found, kept, end = lex.tokens(text), list[str](), 0
    starts = [at for at in range(len(found)) if at == 0 or key_at(found, at - 1) in lex.ENDS]
    for at in starts[:_MAX_TRIES]:
        parsed = read_from("opening", found, at, _OPENING)
        if parsed is not None:
            tree, behind = parsed
            asks = f"tell me {found[behind - 1].key} " if "asks_if" in tree else ""
            kept += [text[end : found[at].start], asks]
            end = found[behind].start if behind < len(found) else len(text)
    return "".join([*kept, text[end:]])
