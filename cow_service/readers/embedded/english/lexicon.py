"""The word lists and the sentence forms of `forms.txt`, and the phrases that name things."""

import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from itertools import count
from typing import Literal, NamedTuple, cast

from cow_service.records import AskedForm, AskedRelation, MotionKind, SpeedWord, Vector


def words(*lists: str) -> frozenset[str]:
    """The words of some space-separated lists."""
    return frozenset(word for text in lists for word in text.split())


@cache
def sections() -> dict[str, list[tuple[str, str]]]:
    """The lines of `forms.txt` by their section, each as what stands in front of " = " and behind it."""
    text = files("cow_service.readers.embedded.english").joinpath("forms.txt").read_text(encoding="utf-8")
    found, lines = dict[str, list[tuple[str, str]]](), list[tuple[str, str]]()
    for line in text.splitlines():
        if line.startswith("["):
            found[line.strip("[]")] = lines = []
        elif line and not line.startswith("#"):
            says, _, rest = line.partition("= ")
            lines.append((says.strip(), rest))
    return found


LISTS: dict[str, list[str]] = {}
for _name, _text in sections()["words"]:
    LISTS[_name] = [*LISTS.get(_name, []), *_text.split()]
SETS = {name: frozenset(listed) for name, listed in LISTS.items()}
COLOURS = {word: group.split("/")[0] for group in LISTS["colours"] for word in group.split("/")}
NUMBER_WORDS = {word: value for value, word in enumerate(LISTS["numerals"], 1)}
_SIZES = zip((1.0, 0.01, 0.001, 0.0254, 0.3048), LISTS["metres"], strict=True)
METRES = {word: size for size, group in _SIZES for word in group.split("/")}
FUNCTION, DETERMINERS, PLACES, CAUSES = (SETS[name] for name in ("function", "determiners", "places", "causes"))
GENERIC, AGENTS, TOUCHING, FILLERS = (SETS[name] for name in ("generic", "agents", "touching", "fillers"))
TABLES = words("table desk tabletop")
CONTAINERS = SETS["hollow"] | (SETS["round"] | SETS["square"]) - {"vase", "can"}  # to fall into
_KINDS: tuple[MotionKind, ...] = ("linear", "projectile", "fall", "static")
KINDS: dict[str, MotionKind] = {"let go": "fall", **{lemma: kind for kind in _KINDS for lemma in LISTS[kind]}}


class Verb(NamedTuple):
    """An inflected form of a verb."""

    lemma: str
    form: Literal["base", "s", "past", "ing"]


_IRREGULAR = {group.split("/")[0]: group.split("/")[1:] for group in LISTS["irregular"]}


def _inflected(lemma: str) -> dict[str, Verb]:
    stem = lemma + lemma[-1] if lemma in SETS["doubled"] else lemma.removesuffix("e")
    third, past = f"{lemma}s", f"{stem}ed"
    if lemma.endswith("y") and lemma[-2] not in "aeo":
        third, past = f"{lemma[:-1]}ies", f"{lemma[:-1]}ied"
    elif lemma.endswith(("s", "x", "ch", "sh", "o")):
        third = f"{lemma}es"
    pasts = dict.fromkeys(_IRREGULAR.get(lemma, [past]), Verb(lemma, "past"))
    return {third: Verb(lemma, "s"), f"{stem}ing": Verb(lemma, "ing"), **pasts, lemma: Verb(lemma, "base")}


_LEMMAS = sorted({*LISTS["other"], *KINDS} - {"let go"})
VERBS = {
    **{word: verb for lemma in _LEMMAS for word, verb in _inflected(lemma).items()},
    **dict.fromkeys(words("be is are was were been being am"), Verb("be", "base")),
    **dict.fromkeys(words("have has had"), Verb("have", "base")),
    **dict.fromkeys(words("will would does do did can could may might shall should must"), Verb("will", "base")),
}


def lemma(word: str) -> str:
    """The base form of a lower case verb; any other word as it is."""
    return VERBS[word].lemma if word in VERBS else word


def is_modifier(word: str) -> bool:
    """Whether a lower case word describes a noun and is none: a colour, an adjective, a participle, a place."""
    participle = word in VERBS and VERBS[word].form in {"past", "ing"}
    return participle or word in COLOURS or word in SETS["adjectives"] or word in PLACES


def singular(noun: str) -> str:
    """A plural noun made singular, by its ending."""
    if noun in SETS["unchanged"] or len(noun) < 4 or not noun.endswith("s") or noun.endswith(("ss", "us", "is")):
        return noun
    is_long = noun.endswith(("sses", "xes", "ches", "shes", "toes"))
    return noun[:-2] if is_long else noun[:-3] + "y" if noun.endswith("ies") else noun[:-1]


@dataclass(frozen=True)
class ObjectPhrase:
    """An object as the question words it: `text` has no determiner, `noun` is the head noun, or a compound, singular.

    `is_given`: the text is the name under which the caller gave it.
    """

    text: str
    colour: str | None
    noun: str | None
    inside_box: bool = False  # drawn around it
    path_end: str | None = None  # it stands at the "start" or the "end" of a drawn path
    is_given: bool = False

    @property
    def head(self) -> str | None:
        """The last word of the noun: "car" of "toy car"."""
        return self.noun.rsplit(" ", 1)[-1] if self.noun else None

    @property
    def is_other(self) -> bool:
        """Whether it is "the other one": whatever else there is."""
        return self.text in {"other one", "other"}


Measure = Literal["speed", "distance", "share", "own_widths", "duration", "until", "within"]


class QuantityWords(NamedTuple):
    """How fast, how far or how long something moves, as some words say it."""

    what: Measure
    value: float = 1.0  # s, px or m; a share of the way to what it moves towards; widths of what moves
    is_metric: bool = False
    pace: SpeedWord | None = None  # a speed without a number


LEFT, RIGHT, UP, DOWN = (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)
WAYS: dict[str, Vector] = {"left": LEFT, "right": RIGHT, "up": UP, "down": DOWN}
SIDES = WAYS | {"leftmost": LEFT, "rightmost": RIGHT, "lowest": DOWN, "highest": UP}
VERB = "|".join(sorted(KINDS, key=len, reverse=True))
# What joins clauses, or opens them.
CONNECTORS = words(", . ? ! ; ( ) it first") | SETS["connectors"]


class Form(NamedTuple):
    """A pattern, and what a sentence of this form says: the words in front of it."""

    says: str
    pattern: re.Pattern[str]

    @property
    def asks(self) -> tuple[AskedForm, AskedRelation, bool]:
        """Form, relation and whether it is negated, of what asks."""
        form, relation, negated = (*self.says.split(), "", "", "")[:3]
        return cast(AskedForm, form), cast(AskedRelation, relation), bool(negated)


def roles(found: re.Match[str]) -> dict[str, str]:
    """The groups of a match by their names, in the order in which they stand."""
    spans = sorted((found.span(name), name) for name, text in found.groupdict().items() if text is not None)
    return {name.rstrip("0123456789"): found[name] for _, name in spans}


@cache
def forms() -> dict[str, tuple[Form, ...]]:
    """The forms by their section."""
    macros = dict(sections()["macros"]) | {"verbs": VERB, "causes": "|".join(LISTS["causes"])}
    macros |= {"colours": "|".join(COLOURS), "numerals": "|".join(NUMBER_WORDS), "units": "|".join(METRES)}
    macros["where"] = "|".join(f"(<{name.replace('-', '')}>){pattern}" for name, pattern in sections()["where"])

    def compiled(section: str, says: str, pattern: str) -> Form:
        is_text = section in {"idioms", "quantities"}
        if section == "asked":
            pattern = f"({pattern}){{tail}}"
        while "{" in pattern:
            pattern = re.sub(r"\{(\w+)\}", lambda macro: macros[macro[1]], pattern)
        if "\\1" not in says:  # in front of what refers to a group, (...) is one
            pattern = re.sub(r"(?<!\\)\((?![?<])", "(?:", f"({pattern})")
        numbers = count()
        pattern = re.sub(r"\(<(\w+)>", lambda group: f"(?P<{group[1]}{next(numbers)}>", pattern)
        return Form(says, re.compile(rf"(?<![\w'-]){pattern}(?![\w'-])" if is_text else rf"{pattern}(?= |$)"))

    return {
        section: tuple(compiled(section, *line) for line in lines)
        for section, lines in sections().items()
        if section not in {"words", "macros", "where"}
    }
