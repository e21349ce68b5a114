"""The tokens that the grammar is written in: words in their base form, and noun phrases as one token each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cow_service.readers.question import lexicon as lex
from cow_service.readers.question.phrases import Item, ObjectPhrase

_SAME: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(["be", "is", "are", "was", "were", "been", "am", "'s"], ("be",)),
    **dict.fromkeys(["get", "gets", "got", "gotten"], ("get",)),
    **dict.fromkeys(["has", "had"], ("have",)),
    "being": ("be", "-ing"), "getting": ("get", "-ing"), "having": ("have", "-ing"), "making": ("make", "-ing"),
    "makes": ("make",), "made": ("make",), "elapses": ("elapse",), "longer": ("long", "-er"),
    "n't": ("not",), "cannot": ("can", "not"), "wo": ("will",), "ca": ("can",),
}  # fmt: skip
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
    return [word for at in range(len(found)) for word in words_at(found, at)]


def words_at(found: Sequence[Item], at: int) -> list[Word]:
    """The tokens of one item."""
    item = found[at]
    if item.phrase is None:
        return plain_words([item.key], at)
    if _is_words(item, item.phrase):
        return plain_words(item.words, at)
    return [Word("AGENT" if item.phrase.head in lex.AGENTS else "NP", item.phrase.text, at)]


def plain_words(keys: Sequence[str], at: int) -> list[Word]:
    """Lower case words at a place as tokens: the base form of a verb, its ending "-ing" apart."""
    return [Word("PRONOUN" if key in PRONOUNS else "", text, at) for key in keys for text in _base_forms(key)]


def _is_words(item: Item, phrase: ObjectPhrase) -> bool:
    """Whether a noun phrase names no object: a place, the trail, or an adjective alone as in "the last of which"."""
    if phrase.head in ARROWS:
        return True
    if phrase.as_thing or phrase.colour is not None or phrase.number is not None or phrase.inside_box:
        return False
    content = [word for word in item.words if word not in lex.DETERMINERS]
    return phrase.head in lex.NO_THINGS or all(word == "one" or lex.is_modifier(word) for word in content)


def _base_forms(word: str) -> tuple[str, ...]:
    verb = lex.VERBS.get(word)
    if verb is None or word in _SAME:
        return _SAME.get(word, (word,))
    return (verb.lemma, "-ing") if verb.form == "ing" else (verb.lemma,)
