"""Names, directions and places in English; and the templates of each language, with its numbers, names and lists."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import yaml

from cow_service.weights.manifests import Resources

if TYPE_CHECKING:  # the command line prints its help without records
    from cow_service.records import Intervention, PlaceRelation, Vector

MAX_OBJECT = 200  # characters
ALONG_AXIS = 0.95  # sine of the angle out of the image plane from which only the depth is worth a word
IN_PLANE = 0.3  # and up to which it is not

# 16 sectors of 22.5 degrees, from the right, turning upwards.
_QUARTERS = (("to the right", "up"), ("up", "to the left"), ("to the left", "down"), ("down", "to the right"))
_DETERMINERS = ("the ", "a ", "an ", "this ", "that ")


def direction_words(direction: Vector | None, depth: float) -> str:
    """A direction as a short phrase, such as "to the right and slightly up"; empty where there is none.

    `direction` is in image pixels, x right, y down, of any length; `depth` as in `Motion`.
    """
    flat = ""
    if direction is not None and math.hypot(*direction) > 0 and all(map(math.isfinite, direction)):
        sector = round(math.atan2(-direction[1], direction[0]) / (math.pi / 8)) % 16
        main, side = _QUARTERS[sector // 4]
        words = (main, f"{main} and slightly {side}", f"{main} and {side}", f"{side} and slightly {main}")
        flat = words[sector % 4]
    away = "away from the camera" if depth > 0 else "towards the camera"
    if not flat or abs(depth) >= ALONG_AXIS:
        return away if abs(depth) > IN_PLANE else flat
    return f"{flat} and {away}" if abs(depth) > IN_PLANE else flat


def same_name(one: str, other: str) -> bool:
    """Whether two texts name an object alike, whatever their determiners, letters' case and spaces."""
    words = [re.findall(r"\w+", bare_name(name).lower()) for name in (one, other)]
    return words[0] == words[1] != []


def bare_name(object: str) -> str:
    """An object's name in one line, without its determiner."""
    name = " ".join(object.split())[:MAX_OBJECT].rstrip()
    determiner = next((word for word in _DETERMINERS if name.lower().startswith(word)), "")
    return name[len(determiner) :]


PREPOSITIONS: dict[PlaceRelation, str] = {
    "into": "into", "onto": "onto", "between": "between", "in-front-of": "in front of", "behind": "behind",
    "next-to": "next to", "left-of": "to the left of", "right-of": "to the right of",
}  # fmt: skip
_OTHER_WORDS: dict[str, PlaceRelation] = {
    "in": "into", "inside": "into", "on": "onto", "on top of": "onto", "beside": "next-to", "left of": "left-of",
    "right of": "right-of",
}  # fmt: skip
RELATION_WORDS: dict[str, PlaceRelation] = {
    **{name: name for name in PREPOSITIONS},
    **{words: relation for relation, words in PREPOSITIONS.items()},
    **_OTHER_WORDS,
}


def place_words(placed: Intervention) -> str:
    """Where something is put, as in: between the bowl and the cone."""
    to = " and ".join(f"the {bare_name(target.object)}" for target in placed.targets)
    return f"{PREPOSITIONS[placed.relation or 'into']} {to}"


TEMPLATES = Resources("prompts/narration", ".yaml", "language")
MAX_NAME = 60  # characters


@dataclass(frozen=True)
class Phrases:
    """The templates of one language by their keys. A template's values are in braces: `rolls {way}`."""

    language: str
    templates: dict[str, str]

    def __call__(self, key: str, /, **values: str) -> str:
        """The template with its values filled in. Raises `KeyError` where there is no such template, or value."""
        return self.templates[key].format_map(values)

    def name(self, object: str) -> str:
        """An object: behind an article in English, else in quotation marks, since its gender is not known."""
        short = bare_name(object).rstrip(".?!;:") or "object"
        return self("name", name=short if len(short) <= MAX_NAME else short[:MAX_NAME].rstrip() + "\u2026")

    def names(self, objects: Sequence[str], last: str = "names-and") -> str:
        """Objects in a list, each as by `name`."""
        return self.joined([self.name(each) for each in objects], last)

    def joined(self, parts: Sequence[str], last: str = "names-and") -> str:
        """Parts in a list; `last` is the template that joins the last one."""
        before = self.templates[f"{last.partition('-')[0]}-comma"].join(parts[:-1])
        return self(last, first=before, last=parts[-1]) if before else parts[-1]

    def sentence(self, subject: str, clauses: Sequence[str]) -> str:
        """A whole sentence of a subject and what it does, one thing after another."""
        return capitalised(self("sentence", subject=subject, clauses=self.joined(clauses, "clauses-and")))

    def seconds(self, time: float) -> str:
        """Seconds with one decimal, without their unit: the one way in which times are written."""
        return f"{time:.1f}".replace(".", self.templates["decimal"])


def capitalised(sentence: str) -> str:
    """The sentence with its first letter as a capital."""
    return sentence[:1].upper() + sentence[1:]


@cache
def phrases_of(language: str) -> Phrases:
    """The templates of a language. Raises `LookupError`, naming those that exist."""
    return Phrases(language, yaml.safe_load(TEMPLATES.read(language)))
