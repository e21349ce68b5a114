"""What a noun phrase says of an object: its colour, its noun, its number, the mark that singles it out."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from cow_service.readers.base import Quantity, SpeedWord
from cow_service.readers.embedded.english import lexicon as lex
from cow_service.records import Until

QUANTITY = "~"
PUNCTUATION = frozenset(".,;:?!()—–")
_TOKEN = re.compile(r"\d+\.\d+|no\.(?=\s{0,3}\d)|n't\b|'s\b|#\d+|\w+?(?=n't\b)|\w+|[.,;:?!()—–]", re.IGNORECASE)


@dataclass(frozen=True)
class PlaceWords:
    """Where a thing is in the image: behind, in front of or nearest to another one, or to the camera (`of` is None)."""

    relation: str
    of: ObjectPhrase | None


@dataclass(frozen=True)
class ObjectPhrase:
    """An object as the question words it: `text` has no determiner, `noun` is the head noun, or a compound, singular.

    `place` is where the image shows it, as far as the question says so by another thing.
    """

    text: str
    colour: str | None
    noun: str | None
    inside_box: bool = False
    number: int | None = None
    place: PlaceWords | None = None
    as_thing: bool = False  # a table, where it is more than the place of what happens

    @property
    def head(self) -> str | None:
        """The last word of the noun: "car" of "toy car"."""
        return self.noun.rsplit(" ", 1)[-1] if self.noun else None

    @property
    def is_thing(self) -> bool:
        """Whether it names a thing: not a place, the arrow or the image, and not the floor."""
        return self.head is not None and (self.as_thing or self.head not in lex.NO_THINGS)


@dataclass(frozen=True)
class QuantityWords:
    """How fast, how far or how long something moves, as some words say it; one field is set."""

    speed: SpeedWord | Quantity | None = None
    distance: Quantity | None = None
    share: float | None = None  # of the way to what it moves towards
    own_widths: float | None = None  # a distance, in widths of what moves
    own_heights: float | None = None
    duration: float | None = None  # s
    until: Until | None = None
    within: float | None = None  # s: a limit of what is asked about, not of the motion


@dataclass(frozen=True)
class Item:
    """A word (`key`, lower case), a noun phrase (`phrase`; then `words` are its words, determiner first) or a quantity.

    The key of a quantity is `QUANTITY`, and `words` are its words.
    """

    key: str
    start: int
    end: int
    phrase: ObjectPhrase | None = None
    words: tuple[str, ...] = ()
    quantity: QuantityWords | None = None


def tokens(text: str) -> list[Item]:
    """The words and punctuation marks of a text; a typographic apostrophe counts as a plain one."""
    # One character for one, so that positions stay those of the text.
    plain = text.replace("’", "'").replace(" - ", " – ")
    return [Item(found.group().lower(), found.start(), found.end()) for found in _TOKEN.finditer(plain)]


def key_at(found: Sequence[Item], at: int) -> str:
    """The word at a place; a full stop outside the text, nothing for a noun phrase."""
    return found[at].key if 0 <= at < len(found) else "."


def phrase_at(found: Sequence[Item], at: int) -> ObjectPhrase | None:
    """The noun phrase at a place, if there is one."""
    return found[at].phrase if 0 <= at < len(found) else None


def flatten(found: Iterable[Item]) -> list[str]:
    """The words of some items, those of their noun phrases too."""
    return [word for item in found for word in (item.words or (item.key,))]


def _number(keys: Sequence[str], head: str) -> int | None:
    plural = head.endswith("s") and not head.endswith("ss") and head not in lex.UNCHANGED_PLURALS
    for at, key in enumerate(keys):
        digits = key.lstrip("#")
        named = at > 0 and keys[at - 1] in {"number", "no", "no."}
        counts = plural and at < len(keys) - 1 and not named and key == digits
        if digits.isdecimal() and len(digits) <= 6 and not counts:
            return int(digits)
        if key in lex.NUMBER_WORDS and not counts and (named or key != "one"):
            return lex.NUMBER_WORDS[key]
    return None


def is_count(key: str) -> bool:
    """Whether a word numbers an object, or says that a number follows."""
    numeral = key.lstrip("#").isdecimal() or (key in lex.NUMBER_WORDS and key != "one")
    return numeral or key in {"number", "no", "no.", "numbered"}


def object_phrase(text: str, keys: tuple[str, ...]) -> ObjectPhrase:
    """The phrase with these lower case words, behind its determiners."""
    content = [key for key in keys if not is_count(key) and key != "and"]
    content = [key for key in content if len(key) > 1] or content  # "ball A" is a ball
    nouns = [key for key in content[:-1] if not lex.is_modifier(key)]
    head = content[-1] if content else ""
    modifiers = content[:-1] or content
    colour = next((lex.COLOURS[key] for key in modifiers if key in lex.COLOURS), None)
    noun = " ".join([*nouns, lex.singular(head)]) if content and head not in {"one", "ones"} else None
    return ObjectPhrase(
        text=" ".join(text.split()),
        colour=colour,
        noun=noun,
        inside_box=any(key in lex.MARKED for key in content[:-1]),
        number=_number(keys, nouns[-1] if head.isdecimal() and nouns else head),
    )


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
