"""The closed word lists of `lexicon.toml`: colours, verbs with their inflections, function words."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from importlib.resources import files
from typing import Literal

from cow_service.records import MotionKind, Vector

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
