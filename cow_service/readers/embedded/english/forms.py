"""The sentence forms of `forms.txt`, compiled."""

import re
from functools import cache
from importlib.resources import files
from itertools import count
from typing import NamedTuple, cast

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.records import AskedForm, AskedRelation, PlaceRelation, Vector

LEFT, RIGHT, UP, DOWN = (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)
WAYS: dict[str, Vector] = {"LEFT": LEFT, "RIGHT": RIGHT, "UP": UP, "DOWN": DOWN}
SIDES = {"leftmost": LEFT, "rightmost": RIGHT, "lowest": DOWN, "highest": UP, "left": LEFT, "right": RIGHT}
_RELATIONS: dict[PlaceRelation, str] = {
    "into": "(right |back )?{in}", "onto": "{on}", "in-front-of": "(right )?in front of", "behind": "behind",
    "next-to": "(right )?(next to|beside|near)", "left-of": "(to|on)? ?(the )?left of", "right-of": "(to|on)? ?(the )?right of",
}  # fmt: skip
_BETWEEN = r"(right |halfway |midway |in )*(<between>between) (<y>[XP]\d+|ALLOF S\d+)( and (<z>X\d+))?"
# What joins clauses, or opens them.
CONNECTORS = lex.words(
    ", . ? ! ; ( ) if when while once suppose supposing imagine assume assuming given and then so that as after consider CLAIM "
    "upon it first SOMETIME THERE"
)


class Form(NamedTuple):
    """A pattern, and what a sentence of this form says: the words in front of it."""

    says: str
    pattern: re.Pattern[str]

    @property
    def asks(self) -> tuple[AskedForm, AskedRelation, bool]:
        """Form, relation and whether it is negated, of what asks."""
        form, relation, *negated = self.says.split()
        return cast(AskedForm, form), cast(AskedRelation, relation), bool(negated)


def roles(found: re.Match[str]) -> dict[str, str]:
    """The groups of a match by their names, in the order in which they stand."""
    spans = sorted((found.span(name), name) for name, text in found.groupdict().items() if text is not None)
    return {name.rstrip("0123456789"): found[name] for _, name in spans}


@cache
def forms() -> dict[str, tuple[Form, ...]]:
    """The forms by their section."""
    text = files("cow_service.readers.embedded.english").joinpath("forms.txt").read_text(encoding="utf-8")
    where = "|".join([*(f"(<{name.replace('-', '')}>{words}) (<y>X\\d+|it)" for name, words in _RELATIONS.items()), _BETWEEN])
    verbs = "|".join(sorted(lex.KINDS, key=len, reverse=True))
    macros = {"colours": "|".join(lex.COLOURS), "verbs": verbs, "causes": "|".join(sorted(lex.CAUSES)), "where": f"({where})"}
    found, section = dict[str, tuple[Form, ...]](), ""
    for line in text.splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif line and not line.startswith("#"):
            says, _, pattern = line.partition("= ") if line.startswith("= ") else line.partition(" = ")
            while "{" in pattern:
                pattern = re.sub(r"\{(\w+)\}", lambda macro: macros[macro[1]], pattern)
            if section == "macros":
                macros[says] = pattern
                continue
            numbers, edges = count(), (r"(?<![\w'-])", r"(?![\w'-])") if section == "idioms" else ("", r"(?= |$)")
            if "\\1" not in says:  # in front of what refers to a group, (...) is one
                pattern = re.sub(r"(?<!\\)\((?![?<])", "(?:", f"({pattern})" + (macros["tail"] if section == "asked" else ""))
            pattern = re.sub(r"\(<(\w+)>", lambda group: f"(?P<{group[1]}{next(numbers)}>", pattern)
            form = Form(says.strip(), re.compile(edges[0] + pattern + edges[1]))
            found[section] = (*found.get(section, ()), form)
    return found


def relation_of(said: dict[str, str]) -> PlaceRelation | None:
    """The relation that the groups of a placing name."""
    names: dict[str, PlaceRelation] = {name.replace("-", ""): name for name in (*_RELATIONS, "between")}
    return next((names[name] for name in said if name in names), None)
