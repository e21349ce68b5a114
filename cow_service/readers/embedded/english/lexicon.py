"""The closed word lists of `lexicon.toml`: colours, verbs with their inflections, function words."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Literal

from cow_service.readers.base import Quantity, SpeedWord
from cow_service.records import MotionKind, Until, Vector

Form = Literal["base", "s", "past", "ing"]


def words(*lists: str) -> frozenset[str]:
    """The words of some space-separated lists."""
    return frozenset(word for text in lists for word in text.split())


@dataclass(frozen=True)
class Verb:
    """One inflected form of a verb. `kind` is None for a verb that is not a way to move."""

    lemma: str
    form: Form
    kind: MotionKind | None


TABLES: dict[str, dict[str, str]] = tomllib.loads(
    files("cow_service.readers.embedded.english").joinpath("lexicon.toml").read_text(encoding="utf-8")
)
SETS = {name: words(text) for table in ("sets", "verbs", "of_verbs") for name, text in TABLES[table].items()}

COLOURS: dict[str, str] = {word: name for name, text in TABLES["colours"].items() for word in text.split()}
_VECTORS: dict[str, Vector] = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "up": (0.0, -1.0), "down": (0.0, 1.0)}
DIRECTIONS = {word: _VECTORS[way] for way, text in TABLES["directions"].items() for word in text.split()}
NUMBER_WORDS = {word: value for value, word in enumerate(TABLES["sets"]["numerals"].split(), 1)}
ADJECTIVES, NOUN_MODIFIERS, MARKED = SETS["adjectives"], SETS["noun_modifiers"], SETS["marked"]
UNCHANGED_PLURALS = SETS["unchanged_plurals"]
_UNITS = [[unit, *text.split()] for unit, text in TABLES["metres"].items()]
METRES = {word: float(size) for unit, size, *others in _UNITS for word in (unit, *others)}  # of a unit of length
PLACES = DIRECTIONS.keys() | SETS["places"]
DETERMINERS, VAGUE_DETERMINERS = SETS["determiners"], SETS["vague_determiners"]
CONDITIONALS, AUXILIARIES, BE, NEGATIONS = (SETS[n] for n in ("conditionals", "auxiliaries", "be", "negations"))
CAUSATIVES, MOVER_PRONOUNS = SETS["causatives"], SETS["mover_pronouns"]
FUNCTION_WORDS = AUXILIARIES | BE | NEGATIONS | CONDITIONALS | CAUSATIVES | MOVER_PRONOUNS | SETS["function_words"]
AGENTS, GENERIC, SCENERY = SETS["agents"], SETS["generic"], SETS["scenery"]
ABSTRACT = PLACES | SETS["viewers"] | SETS["abstract"]
NO_THINGS = ABSTRACT | SCENERY
MEASURES, MARK_NOUNS = SETS["measures"], SETS["mark_nouns"]
TOUCH, OCCLUDE, LAND = SETS["touch"], SETS["occlude"], SETS["land"]
TRANSITIVE, WEAK = SETS["transitive"], SETS["weak"]
_KINDS: tuple[MotionKind, ...] = ("linear", "projectile", "fall", "static")


def _third_person(lemma: str) -> str:
    if lemma.endswith(("s", "x", "ch", "sh", "o")):
        return lemma + "es"
    return lemma[:-1] + "ies" if lemma.endswith("y") and lemma[-2] not in "aeo" else lemma + "s"


def _forms(lemma: str) -> dict[str, Form]:
    stem = lemma + lemma[-1] if lemma in SETS["doubled"] else lemma.removesuffix("e")
    past = lemma[:-1] + "ied" if lemma.endswith("y") and lemma[-2] not in "aeo" else stem + "ed"
    forms: dict[str, Form] = {_third_person(lemma): "s", stem + "ing": "ing"}
    forms |= dict.fromkeys(TABLES["irregular_verbs"].get(lemma, past).split(), "past")
    forms[lemma] = "base"
    return forms


def _verbs() -> dict[str, Verb]:
    kinds: dict[str, MotionKind | None] = dict.fromkeys(TOUCH | OCCLUDE | LAND | SETS["other"])
    for kind in _KINDS:
        kinds |= dict.fromkeys(SETS[kind], kind)
    table = {word: Verb(word, "past", None) for word in SETS["participles"]}
    for lemma, kind in kinds.items():
        table |= {word: Verb(lemma, form, kind) for word, form in _forms(lemma).items()}
    return table


VERBS: dict[str, Verb] = _verbs()


def lemma(word: str) -> str:
    """The base form of a lower case verb; empty for a word that is none."""
    return VERBS[word].lemma if word in VERBS else ""


def is_modifier(word: str) -> bool:
    """Whether a lower case word describes a noun and is none: a colour, an adjective, a participle, a place."""
    if word in SETS["not_adjectives"]:
        return False
    participle = word in VERBS and VERBS[word].form in {"past", "ing"}
    known = any(word in listed for listed in (COLOURS, ADJECTIVES, PLACES, NUMBER_WORDS, MARKED))
    ending = len(word) > 4 and word.endswith(("ed", "ing", "ish", "ful", "less", "ous"))
    return participle or known or word.isdecimal() or ending


def is_adverb(word: str) -> bool:
    """Whether a lower case word is an adverb by its ending, such as "freely"."""
    return len(word) > 4 and word.endswith("ly") and word not in SETS["not_adverbs"]


def singular(noun: str) -> str:
    """A plural noun made singular, by its ending."""
    if noun in TABLES["irregular_plurals"]:
        return TABLES["irregular_plurals"][noun]
    if noun in UNCHANGED_PLURALS or len(noun) < 4 or not noun.endswith("s") or noun.endswith(("ss", "us", "is")):
        return noun
    if noun.endswith(("sses", "xes", "ches", "shes", "toes")):
        return noun[:-2]
    return noun[:-3] + "y" if noun.endswith("ies") else noun[:-1]


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
        return self.head is not None and (self.as_thing or self.head not in NO_THINGS)


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
    plural = head.endswith("s") and not head.endswith("ss") and head not in UNCHANGED_PLURALS
    for at, key in enumerate(keys):
        digits = key.lstrip("#")
        named = at > 0 and keys[at - 1] in {"number", "no", "no."}
        counts = plural and at < len(keys) - 1 and not named and key == digits
        if digits.isdecimal() and len(digits) <= 6 and not counts:
            return int(digits)
        if key in NUMBER_WORDS and not counts and (named or key != "one"):
            return NUMBER_WORDS[key]
    return None


def is_count(key: str) -> bool:
    """Whether a word numbers an object, or says that a number follows."""
    numeral = key.lstrip("#").isdecimal() or (key in NUMBER_WORDS and key != "one")
    return numeral or key in {"number", "no", "no.", "numbered"}


def object_phrase(text: str, keys: tuple[str, ...]) -> ObjectPhrase:
    """The phrase with these lower case words, behind its determiners."""
    content = [key for key in keys if not is_count(key) and key != "and"]
    content = [key for key in content if len(key) > 1] or content  # "ball A" is a ball
    nouns = [key for key in content[:-1] if not is_modifier(key)]
    head = content[-1] if content else ""
    modifiers = content[:-1] or content
    colour = next((COLOURS[key] for key in modifiers if key in COLOURS), None)
    noun = " ".join([*nouns, singular(head)]) if content and head not in {"one", "ones"} else None
    return ObjectPhrase(
        text=" ".join(text.split()),
        colour=colour,
        noun=noun,
        inside_box=any(key in MARKED for key in content[:-1]),
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
    return [Word("AGENT" if item.phrase.head in AGENTS else "NP", item.phrase.text, at)]


def plain_words(keys: Sequence[str], at: int) -> list[Word]:
    """Lower case words at a place as tokens: the base form of a verb, its ending "-ing" apart."""
    return [Word("PRONOUN" if key in PRONOUNS else "", text, at) for key in keys for text in _base_forms(key)]


def _is_words(item: Item, phrase: ObjectPhrase) -> bool:
    """Whether a noun phrase names no object: a place, the trail, or an adjective alone as in "the last of which"."""
    if phrase.head in ARROWS:
        return True
    if phrase.as_thing or phrase.colour is not None or phrase.number is not None or phrase.inside_box:
        return False
    content = [word for word in item.words if word not in DETERMINERS]
    return phrase.head in NO_THINGS or all(word == "one" or is_modifier(word) for word in content)


def _base_forms(word: str) -> tuple[str, ...]:
    verb = VERBS.get(word)
    if verb is None or word in _SAME:
        return _SAME.get(word, (word,))
    return (verb.lemma, "-ing") if verb.form == "ing" else (verb.lemma,)
