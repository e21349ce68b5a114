"""The answers that a question offers: their letters, which of them says that it is not sure, which one a text means."""

from __future__ import annotations

import re
from collections.abc import Sequence

from cow_service.readers.sentences import split_options
from cow_service.records import AnswerOption

_NOT_SURE = re.compile(
    r"\b(not (quite |really )?(sure|certain)|unsure|uncertain|(can(no|'|’)?t|cannot|can not|could not|impossible to) "
    r"(be )?(tell|told|say|said|know|known|determined?|decided?)|don'?t know|unknown|undecided|not enough information|"
    r"insufficient information)\b",
    re.IGNORECASE,
)


def read_choices(question: str, given: Sequence[str] | None) -> tuple[AnswerOption, ...]:
    """The options of the request, lettered A, B, C..., else those that the question lists; empty where it is open."""
    if given:
        lettered = [(chr(ord("A") + place), _unlettered(text, place)) for place, text in enumerate(given)]
    else:
        lettered = list(split_options(question)[0])
    return tuple(AnswerOption(letter=letter, text=text) for letter, text in lettered)


def says_not_sure(text: str) -> bool:
    """Whether a text says that the answer is not known."""
    return _NOT_SURE.search(text) is not None


def not_sure_option(options: Sequence[AnswerOption]) -> AnswerOption | None:
    """The option that says so, where there is exactly one."""
    unsure = [option for option in options if says_not_sure(option.text)]
    return unsure[0] if len(unsure) == 1 else None


def option_saying(options: Sequence[AnswerOption], text: str) -> AnswerOption | None:
    """The only option whose text is this, but for case, spaces and punctuation."""
    said = [option for option in options if plain(option.text) == plain(text) != ""]
    return said[0] if len(said) == 1 else None


def plain(text: str) -> str:
    """Lower-case words alone."""
    return " ".join(re.findall(r"\w+", text.lower()))


def _unlettered(text: str, place: int) -> str:
    """An option without its own letter in front, where that is the one that it gets: "(A) Yes" is "Yes"."""
    letter = chr(ord("A") + place)
    return re.sub(rf"^\s*(?:\({letter}\)|{letter}[.):])\s*(?=\S)", "", text).strip()
