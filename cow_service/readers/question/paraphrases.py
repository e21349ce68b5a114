"""Says a sentence as the grammar has it: what is read as motion left out, fillers dropped, paraphrases replaced.

`paraphrases.toml` lists the rules. They are tried where the sentence as it stands is not understood.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.asked_words import Sentence
from cow_service.readers.question.sentences import Question
from cow_service.readers.question.words import Word, plain_words

_MAX_CHANGES = 24  # of one sentence
_THING = r"(?:M|T\d+|it|they|he|she)"
_SLOTS = {"thing": _THING, "list": r"T\d+(?: , T\d+)*(?: ,)? or T\d+", "some": r"S\d+", "rest": ".+"}
_OBJECTS = frozenset({"OBJ", "OBJS"})  # an object or objects of no name
_SLOT = re.compile(r"<(\w+?)(\d?)>")


@dataclass(frozen=True)
class _Rule:
    pattern: re.Pattern[str]
    tokens: tuple[str, ...]  # what is said instead; "<thing>" is what stood there


@cache
def _rules() -> tuple[_Rule, ...]:
    text = files("cow_service.readers.question").joinpath("paraphrases.toml").read_text(encoding="utf-8")
    listed = tomllib.loads(text)
    said = [(filler, "") for filler in listed["fillers"]] + list(listed["said_as"].items())
    return tuple(_Rule(_pattern(pattern), tuple(instead.split())) for pattern, instead in said)


def _pattern(pattern: str) -> re.Pattern[str]:
    slotted = _SLOT.sub(lambda found: f"(?P<{found[1]}{found[2]}>{_SLOTS[found[1]]})", pattern)
    return re.compile(rf"(?<=\s)(?:{slotted})(?=\s)")


def rephrased(sentence: Sentence, question: Question) -> Sentence:
    """The sentence in other words, without what tells of the motion; its words keep their places."""
    items = question.items
    words = [w for w in sentence.words if items[w.at].start not in question.read or w.text in lex.SETS["how_much"]]
    places = {word.at for word in words}
    for rule in _rules():
        for _ in range(_MAX_CHANGES):
            changed = _applied(rule, words)
            if changed is None:
                break
            words = changed
    return replace(sentence, words=words, dropped=frozenset(places - {word.at for word in words}))


def _applied(rule: _Rule, words: Sequence[Word]) -> list[Word] | None:
    text = " " + "".join(f"{word.text} " for word in words)
    found = rule.pattern.search(text)
    if found is None:
        return None
    first, end = (text[:place].count(" ") - 1 for place in (found.start(), found.end() + 1))
    said: list[Word] = []
    for token in rule.tokens:
        slot = _SLOT.fullmatch(token)
        if slot is None:
            at = words[first].at
            said += [Word(token, token, at)] if token in _OBJECTS else plain_words([token], at)
        else:
            start, stop = found.span(slot[1] + slot[2])
            if start >= 0:  # of two ways to say it, the one that was said
                said += words[text[:start].count(" ") - 1 : text[: stop + 1].count(" ") - 1]
    return [*words[:first], *said, *words[end:]]
