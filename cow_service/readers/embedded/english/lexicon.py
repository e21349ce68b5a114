"""The closed word lists of `lexicon.toml`, and what a text is made of: items, noun phrases and words."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib.resources import files
from typing import Literal, NamedTuple

from cow_service.readers.base import Quantity, SpeedWord
from cow_service.records import MotionKind, Until, Vector


def words(*lists: str) -> frozenset[str]:
    """The words of some space-separated lists."""
    return frozenset(word for text in lists for word in text.split())


TABLES: dict[str, dict[str, str]] = tomllib.loads(
    files("cow_service.readers.embedded.english").joinpath("lexicon.toml").read_text(encoding="utf-8")
)
SETS = {name: words(text) for table in ("sets", "verbs", "of_verbs") for name, text in TABLES[table].items()}

COLOURS: dict[str, str] = {word: name for name, text in TABLES["colours"].items() for word in text.split()}
_VECTORS: dict[str, Vector] = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "up": (0.0, -1.0), "down": (0.0, 1.0)}
DIRECTIONS = {word: _VECTORS[way] for way, text in TABLES["directions"].items() for word in text.split()}
NUMBER_WORDS = {word: value for value, word in enumerate(TABLES["sets"]["numerals"].split(), 1)}
NUMERALS = NUMBER_WORDS | {"twenty": 20, "thirty": 30, "forty": 40, "fifty": 50, "sixty": 60, "hundred": 100}
NOUNS = words(*TABLES["shapes"].values())
METRES = {  # of a unit of length
    word: float(text.split()[0])
    for unit, text in TABLES["metres"].items()
    for word in (unit, *text.split()[1:])
}  # fmt: skip
NEARLY = 0.8  # difflib's ratio from which a word is nearly a colour's name
PLACES = DIRECTIONS.keys() | SETS["places"]
DETERMINERS, VAGUE_DETERMINERS = SETS["determiners"], SETS["vague_determiners"]
CONDITIONALS, AUXILIARIES, BE, NEGATIONS = (SETS[n] for n in ("conditionals", "auxiliaries", "be", "negations"))
CAUSATIVES, MOVER_PRONOUNS = SETS["causatives"], SETS["mover_pronouns"]
FUNCTION_WORDS = AUXILIARIES | BE | NEGATIONS | CONDITIONALS | CAUSATIVES | MOVER_PRONOUNS | SETS["function_words"]
CLOSED = FUNCTION_WORDS | DETERMINERS
AGENTS, GENERIC, SCENERY = SETS["agents"], SETS["generic"], SETS["scenery"]
ABSTRACT = PLACES | SETS["viewers"] | SETS["abstract"]
NO_THINGS = ABSTRACT | SCENERY
TOUCH, OCCLUDE, LAND = SETS["touch"], SETS["occlude"], SETS["land"]
ARROWS = frozenset(["arrow", "arrowhead"])
PUNCTUATION = frozenset(".,;:?!()—–")
ENDS = frozenset(".?!;")  # of a sentence


@dataclass(frozen=True)
class Verb:
    """One inflected form of a verb. `kind` is None for a verb that is not a way to move."""

    lemma: str
    form: Literal["base", "s", "past", "ing"]
    kind: MotionKind | None


def _inflect(lemma: str, kind: MotionKind | None) -> dict[str, Verb]:
    """The forms of a verb."""
    stem = lemma + lemma[-1] if lemma in SETS["doubled"] else lemma.removesuffix("e")
    third, past = f"{lemma}s", f"{stem}ed"
    if lemma.endswith("y") and lemma[-2] not in "aeo":
        third, past = f"{lemma[:-1]}ies", f"{lemma[:-1]}ied"
    elif lemma.endswith(("s", "x", "ch", "sh", "o")):
        third = f"{lemma}es"
    forms = {third: Verb(lemma, "s", kind), f"{stem}ing": Verb(lemma, "ing", kind)}
    forms |= dict.fromkeys(TABLES["irregular_verbs"].get(lemma, past).split(), Verb(lemma, "past", kind))
    return forms | {lemma: Verb(lemma, "base", kind)}


_KINDS: dict[str, MotionKind | None] = dict.fromkeys(TOUCH | OCCLUDE | LAND | SETS["other"])
_MOTIONS: tuple[MotionKind, ...] = ("linear", "projectile", "fall", "static")
_KINDS.update((lemma, kind) for kind in _MOTIONS for lemma in SETS[kind])
VERBS = {word: Verb(word, "past", None) for word in SETS["participles"]}
VERBS.update(form for lemma, kind in _KINDS.items() for form in _inflect(lemma, kind).items())


def lemma(word: str) -> str:
    """The base form of a lower case verb; empty for a word that is none."""
    return VERBS[word].lemma if word in VERBS else ""


def is_form(word: str, *forms: str) -> bool:
    """Whether a lower case word is one of some forms of a verb."""
    return word in VERBS and VERBS[word].form in forms


def moves(verb: Verb | None) -> bool:
    """Whether what does so changes its place."""
    return verb is not None and verb.kind not in {None, "static"}


def is_modifier(word: str) -> bool:
    """Whether a lower case word describes a noun and is none: a colour, an adjective, a participle, a place."""
    if word in SETS["not_adjectives"]:
        return False
    known = any(word in listed for listed in (COLOURS, SETS["adjectives"], PLACES, NUMBER_WORDS, SETS["marked"]))
    ending = len(word) > 4 and word.endswith(("ed", "ing", "ish", "ful", "less", "ous"))
    return is_form(word, "past", "ing") or known or word.isdecimal() or ending


def singular(noun: str) -> str:
    """A plural noun made singular, by its ending."""
    if noun in TABLES["irregular_plurals"]:
        return TABLES["irregular_plurals"][noun]
    unchanged = noun in SETS["unchanged_plurals"] or noun.endswith(("ss", "us", "is"))
    if unchanged or len(noun) < 4 or not noun.endswith("s"):
        return noun
    if noun.endswith(("sses", "xes", "ches", "shes", "toes")):
        return noun[:-2]
    return noun[:-3] + "y" if noun.endswith("ies") else noun[:-1]


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

    @property
    def words(self) -> set[str]:
        """The lower case words of the text."""
        return set(self.text.lower().split())


def like_a_colour(text: str) -> str | None:
    """A word of a noun phrase that is nearly a colour's name, and no other word that is known: "grean"; or None."""
    unknown = (word for word in text.lower().split()[:-1] if word not in SETS["adjectives"] and word not in PLACES)
    return next((word for word in unknown if get_close_matches(word, COLOURS, 1, NEARLY)), None)


@dataclass(frozen=True)
class QuantityWords:
    """How fast, how far or how long something moves, as some words say it; one field is set."""

    speed: SpeedWord | Quantity | None = None
    distance: Quantity | None = None
    share: float | None = None  # of the way to what it moves towards
    own_widths: float | None = None  # a distance, in widths of what moves
    duration: float | None = None  # s
    until: Until | None = None
    within: float | None = None  # s: a limit for the event, not for the motion


@dataclass(frozen=True)
class Item:
    """A word (`key`, lower case), a noun phrase (`phrase`) or a quantity, which has the key "~".

    `words` are those of a noun phrase, determiner first, or of a quantity.
    """

    key: str
    start: int
    end: int
    phrase: ObjectPhrase | None = None
    words: tuple[str, ...] = ()
    quantity: QuantityWords | None = None

    @property
    def thing(self) -> ObjectPhrase | None:
        """The noun phrase, where it names a thing."""
        return self.phrase if self.phrase is not None and self.phrase.is_thing else None


_TOKEN = re.compile(r"\d+\.\d+|no\.(?=\s{0,3}\d)|n't\b|'s\b|#\d+|\w+?(?=n't\b)|\w+|[.,;:?!()—–]", re.IGNORECASE)


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
    numbered = nouns[-1] if head.isdecimal() and nouns else head
    plural = numbered.endswith("s") and not numbered.endswith("ss") and numbered not in SETS["unchanged_plurals"]
    number = None
    for at, key in enumerate(keys):
        digits, named = key.lstrip("#"), at > 0 and keys[at - 1] in {"number", "no", "no."}
        if plural and at < len(keys) - 1 and not named and not key.startswith("#"):
            continue  # it counts them
        if digits.isdecimal() and len(digits) <= 6:
            number = int(digits)
        elif key in NUMBER_WORDS and (named or key != "one"):
            number = NUMBER_WORDS[key]
        if number is not None:
            break
    return ObjectPhrase(
        text=" ".join(text.split()),
        colour=next((COLOURS[key] for key in content[:-1] or content if key in COLOURS), None),
        noun=" ".join([*nouns, singular(head)]) if content and head not in {"one", "ones"} else None,
        inside_box=any(key in SETS["marked"] for key in content[:-1]),
        number=number,
    )


class Word(NamedTuple):
    """What rules are made of. `kind` is the terminal of a noun phrase or a pronoun; `at`, its place in the items."""

    kind: str
    text: str
    at: int
    phrase: ObjectPhrase | None = None


_SAME: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(["be", "is", "are", "was", "were", "been", "am", "'s"], ("be",)),
    **dict.fromkeys(["get", "gets", "got", "gotten"], ("get",)),
    **dict.fromkeys(["has", "had"], ("have",)),
    "being": ("be", "-ing"), "getting": ("get", "-ing"), "having": ("have", "-ing"), "making": ("make", "-ing"),
    "makes": ("make",), "made": ("make",), "elapses": ("elapse",), "longer": ("long", "-er"),
    "n't": ("not",), "cannot": ("can", "not"), "wo": ("will",), "ca": ("can",),
}  # fmt: skip
_BASE = {word: (verb.lemma, "-ing") if verb.form == "ing" else (verb.lemma,) for word, verb in VERBS.items()} | _SAME
_PRONOUNS = words("it itself they them he she")
_WITH_UNIT = re.compile(r"([0-9]+(?:\.[0-9]+)?)([a-z]+)")


def plain_words(keys: Sequence[str], at: int) -> Iterator[Word]:
    """Lower case words at a place for the rules: verbs in their base form, an ending "-ing" and a unit apart."""
    for key in keys:
        with_unit = _WITH_UNIT.fullmatch(key) if key[0].isdigit() else None
        for text in with_unit.groups() if with_unit else _BASE.get(key, (key,)):
            yield Word("PRONOUN" if key in _PRONOUNS else "", text, at)


def words_of(found: Sequence[Item], start: int = 0) -> Iterator[Word]:
    """The items from a place on as words: noun phrases that name no object, such as "the left", in their words."""
    for at in range(start, len(found)):
        item, phrase = found[at], found[at].phrase
        if phrase is None:
            yield from plain_words([item.key], at)
            continue
        singled_out = phrase.as_thing or phrase.colour or phrase.number is not None or phrase.inside_box
        content = (word for word in item.words if word not in DETERMINERS)
        nameless = phrase.head in NO_THINGS or all(word == "one" or is_modifier(word) for word in content)
        if phrase.head in ARROWS or (nameless and not singled_out):
            yield from plain_words(item.words, at)
        else:
            yield Word("AGENT" if phrase.head in AGENTS else "NP", phrase.text, at, phrase)
