"""The tokens that the grammar is written in: words in their base form, and noun phrases as one token each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import Item, ObjectPhrase

_BE = frozenset(["be", "is", "are", "was", "were", "been", "am", "'s"])
_SAME: dict[str, tuple[str, ...]] = {
    "being": ("be", "-ing"),
    "n't": ("not",),
    "cannot": ("can", "not"),
    "gets": ("get",),
    "got": ("get",),
    "getting": ("get", "-ing"),
    "wo": ("will",),
    "ca": ("can",),
    "longer": ("long", "-er"),
    "leaves": ("leave",),
    "leaving": ("leave", "-ing"),
}
ARROWS = frozenset(["arrow", "arrowhead"])
PRONOUNS = frozenset(["it", "itself", "they", "them", "he", "she"])


@dataclass(frozen=True)
class Word:
    """A token: `kind` is the terminal of a noun phrase or a pronoun, empty for a word; `at`, its place in the items."""

    kind: str
    text: str
    at: int


def words_of(found: Sequence[Item]) -> list[Word]:
    """The tokens of some items."""
    return [word for at, item in enumerate(found) for word in _of_item(item, at)]


def _of_item(item: Item, at: int) -> list[Word]:
    if item.phrase is None:
        kind = "PRONOUN" if item.key in PRONOUNS else ""
        return [Word(kind, text, at) for text in base_forms(item.key)]
    if _is_words(item, item.phrase):
        return [Word("", text, at) for word in item.words for text in base_forms(word)]
    return [Word("AGENT" if item.phrase.head in lex.AGENTS else "NP", item.phrase.text, at)]


def _is_words(item: Item, phrase: ObjectPhrase) -> bool:
    """Whether a noun phrase names no object: a place, the trail, or an adjective alone as in "the last of which"."""
    if phrase.head in ARROWS:
        return True
    if phrase.colour is not None or phrase.number is not None or phrase.inside_box:
        return False
    content = [word for word in item.words if word not in lex.DETERMINERS]
    return phrase.head in lex.NO_THINGS or all(word == "one" or lex.is_modifier(word) for word in content)


def base_forms(word: str) -> tuple[str, ...]:
    """A lower case word as tokens: the base form of a verb, its ending "-ing" apart."""
    if word in _BE:
        return ("be",)
    verb = lex.VERBS.get(word)
    if verb is None or word in _SAME:
        return _SAME.get(word, (word,))
    return (verb.lemma, "-ing") if verb.form == "ing" else (verb.lemma,)
