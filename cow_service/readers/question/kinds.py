"""Several things that are named together by their kind: "both mugs", "any of the other two balls"."""

from __future__ import annotations

from dataclasses import dataclass

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import ObjectPhrase
from cow_service.readers.question.sentences import parse_noun_phrase

_SAID = lex.words("any every each all no none some many a an both either neither other the")


@dataclass(frozen=True)
class Kind:
    """What one of the things is called, and how many there are, where that is said."""

    phrase: ObjectPhrase
    count: int | None


def kind_of(name: str) -> Kind | None:
    """The kind that a name such as "both mugs" or "mugs" is of; None for the name of one thing."""
    said = name.lower().split()
    numbers = dict.fromkeys(("both", "either", "neither"), 2) | lex.NUMBER_WORDS
    counts = [int(word) if word.isdecimal() else numbers[word] for word in said if word.isdecimal() or word in numbers]
    rest = [word for word in said if word not in _SAID | numbers.keys() and not word.isdecimal()]
    head = lex.singular(rest[-1]) if rest else ""
    if not rest or (said[0] not in _SAID - {"the", "other"} and head == rest[-1]):
        return None
    phrase = parse_noun_phrase(" ".join([*rest[:-1], head]))
    return None if phrase is None else Kind(phrase, counts[0] if counts else None)
