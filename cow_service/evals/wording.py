"""The text of a question around its options, so that they can be shown in any order."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.readers.options import split_options
from cow_service.records import AnswerOption

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"
Wording = tuple[tuple[str, ...], tuple[AnswerOption, ...]]


def listed_wording(question: str) -> Wording | None:
    """The parts of a question around the options that it lists, and these; None where it lists none.

    The letters and all words between the options stay where they are.
    """
    listed = split_options(question)
    if not listed.options or len(listed.places) != len(listed.options):
        return None
    edges = [0, *(edge for place in listed.places for edge in place), len(question)]
    parts = tuple(question[begin:end] for begin, end in zip(edges[::2], edges[1::2], strict=True))
    # As it stands there: a text may go over several lines.
    options = tuple(
        AnswerOption(letter=letter, text=question[begin:end])
        for (letter, _), (begin, end) in zip(listed.options, listed.places, strict=True)
    )
    return parts, options


def appended_wording(question: str, options: Sequence[str]) -> Wording:
    """The same for a question whose options stand beside it: they are put below it, a line each, with letters."""
    letters = LETTERS[: len(options)]
    heads = [f"\n({letter}) " for letter in letters]
    parts = (f"{question}\n{heads[0]}", *heads[1:], "")
    return parts, tuple(AnswerOption(letter=letter, text=text) for letter, text in zip(letters, options, strict=True))
