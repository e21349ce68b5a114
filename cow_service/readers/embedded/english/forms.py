"""The sentence forms of `forms.txt`, compiled."""

import re
from functools import cache
from itertools import count
from typing import NamedTuple, cast

from cow_service.readers.embedded.english import lexicon as lex
from cow_service.records import AskedForm, AskedRelation, PlaceRelation, Vector

LEFT, RIGHT, UP, DOWN = (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)
WAYS: dict[str, Vector] = {"left": LEFT, "right": RIGHT, "up": UP, "down": DOWN}
SIDES = WAYS | {"leftmost": LEFT, "rightmost": RIGHT, "lowest": DOWN, "highest": UP}
VERBS = "|".join(sorted(lex.KINDS, key=len, reverse=True))
# What joins clauses, or opens them.
CONNECTORS = lex.words(", . ? ! ; ( ) it first") | lex.SETS["connectors"]


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


def relation_of(said: dict[str, str]) -> PlaceRelation | None:
    """The relation that the groups of a placing name."""
    names = (name for name, _ in lex.sections()["where"] if name.replace("-", "") in said)
    return cast(PlaceRelation | None, next(names, None))


@cache
def forms() -> dict[str, tuple[Form, ...]]:
    """The forms by their section."""
    macros = dict(lex.sections()["macros"]) | {"verbs": VERBS, "causes": "|".join(lex.LISTS["causes"])}
    macros |= {
        "colours": "|".join(lex.COLOURS),
        "numerals": "|".join(lex.LISTS["numerals"]),
        "units": "|".join(lex.METRES),
    }
    macros["where"] = "|".join(f"(<{name.replace('-', '')}>){pattern}" for name, pattern in lex.sections()["where"])

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
        for section, lines in lex.sections().items()
        if section not in {"words", "macros", "where"}
    }
