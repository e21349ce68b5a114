"""The answers that a question offers: their letters, which of them says that it is not sure, which one a text means."""

from __future__ import annotations

import re
from collections.abc import Sequence

from cow_service.readers.question.listed_options import split_options
from cow_service.records import AnswerOption, OptionsSource

_NOT_SURE = re.compile(
    r"\b(not (quite |really )?(sure|certain)|unsure|uncertain|(can(no|'|’)?t|cannot|can not|could not|impossible to) "
    r"(be )?(tell|told|say|said|know|known|determined?|decided?)|don'?t know|unknown|undecided|not enough information|"
    r"insufficient information)\b",
    re.IGNORECASE,
)


def read_choices(question: str, given: Sequence[str | AnswerOption] | None) -> tuple[AnswerOption, ...]:
    """The options of the request, lettered A, B, C..., else those that the question lists; empty where it is open."""
    if not given:
        return tuple(AnswerOption(letter=letter, text=text) for letter, text in split_options(question).options)
    plain_texts = [" ".join(text.split()) for text in given if isinstance(text, str)]
    if not plain_texts:
        pairs = (option for option in given if isinstance(option, AnswerOption))
        return tuple(AnswerOption(letter=pair.letter, text=" ".join(pair.text.split())) for pair in pairs)
    bare = [_unlettered(text, place) for place, text in enumerate(plain_texts)]
    # Letters are taken off where every option has its own: "A. M." may be a text.
    texts = bare if all(a != b for a, b in zip(bare, plain_texts, strict=True)) else plain_texts
    return tuple(AnswerOption(letter=chr(ord("A") + place), text=text) for place, text in enumerate(texts))


def choices_source(question: str, given: Sequence[str | AnswerOption] | None) -> OptionsSource:
    """Where the options of `read_choices` stand."""
    if given:
        return "request"
    listed = split_options(question)
    if not listed.options:
        return "none"
    return "question-letters" if listed.lettered else "question-list"


def question_without(question: str, options: Sequence[AnswerOption]) -> str:
    """The question for these options: without those that it lists itself where they are others."""
    listed = split_options(question)
    same = [(one.letter, plain(one.text)) for one in options] == [(a, plain(text)) for a, text in listed.options]
    if same or not listed.options or not options:
        return question
    return " ".join(listed.rest.replace(" . ", " ").split())


def says_not_sure(text: str) -> bool:
    """Whether a text says that the answer is not known."""
    return _NOT_SURE.search(text) is not None


def not_sure_option(options: Sequence[AnswerOption]) -> AnswerOption | None:
    """The first option that says so, if any."""
    return next((option for option in options if says_not_sure(option.text)), None)


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
