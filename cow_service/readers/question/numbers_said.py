"""Times and counts as the options of a question word them: "about 2 seconds", "between 1 and 2 s", "three or more"."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from itertools import pairwise

from cow_service.readers.question import lexicon as lex

Span = tuple[float, float]  # from, to; both the same where one value is named

MOST = 1000  # of what is counted
ALONE = 0.25  # share of a single value that it may be off
_WORDS = {"zero": "0", "no": "0", **{word: str(value) for word, value in lex.NUMBER_WORDS.items()}}
_UNITS = {"ms": 0.001, "milliseconds": 0.001, "millisecond": 0.001, "min": 60.0, "minute": 60.0, "minutes": 60.0}
_N = r"(\d{1,6}(?:\.\d{1,6})?)"
_UNIT = r"(?: ?(ms|milliseconds?|s|secs?|seconds?|min|minutes?))?"
_ABOUT = r"(?:at|after|in|about|around|approximately|roughly|circa|ca|exactly|almost|nearly|it hits|it takes|~)"
_BELOW = r"(?:less than|under|below|fewer than|within|before|in under|in less than|sooner than|<)"
_ABOVE = r"(?:more than|over|above|longer than|later than|after more than|>)"
_TIME_FORMS: tuple[tuple[re.Pattern[str], str], ...] = (
    (re.compile(rf"(?:between|from)? ?{_N}{_UNIT} ?(?:and|to|-|–) ?{_N}{_UNIT}"), "range"),
    (re.compile(rf"{_BELOW} ?{_N}{_UNIT}|(?:the )?first {_N}{_UNIT}"), "below"),
    (re.compile(rf"{_ABOVE} ?{_N}{_UNIT}|{_N}{_UNIT} or (?:more|longer|later)"), "above"),
    (re.compile(rf"(?:{_ABOUT} )*{_N}{_UNIT}(?: later)?"), "value"),
)
_THINGS = r"(?:(?: of (?:them|these|the objects))|(?: (?:other )?(?:objects?|things?|items?|obstacles?|bodies|body)))?"
_COUNT_FORMS: tuple[tuple[re.Pattern[str], str], ...] = (
    (re.compile(rf"(?:exactly |only |just )?(\d{{1,3}}){_THINGS}"), "value"),
    (re.compile(rf"(?:between )?(\d{{1,3}}) ?(?:and|to|-|–|or) ?(\d{{1,3}}){_THINGS}"), "range"),
    (re.compile(rf"(?:more than|over) (\d{{1,3}}){_THINGS}"), "above"),
    (re.compile(rf"at least (\d{{1,3}}){_THINGS}|(\d{{1,3}})(?: ?\+| or more){_THINGS}"), "least"),
    (re.compile(rf"(?:less than|fewer than) (\d{{1,3}}){_THINGS}"), "below"),
    (re.compile(rf"(?:at most|up to) (\d{{1,3}}){_THINGS}|(\d{{1,3}}) or (?:less|fewer){_THINGS}"), "most"),
)


def seconds_of(text: str) -> Span | None:
    """The time that a text names, s; None where it names none, or more than a time."""
    said = _digits(text)
    for pattern, form in _TIME_FORMS:
        match = pattern.fullmatch(said)
        if match is None:
            continue
        found = [group for group in match.groups() if group is not None]
        numbers = [float(group) for group in found if group[0].isdigit()]
        units = [_UNITS.get(group, 1.0) for group in found if not group[0].isdigit()] or [1.0]
        values = [number * unit for number, unit in zip(numbers, (units * 2)[-len(numbers) :], strict=False)]
        if form == "range":
            return (values[0], values[1]) if values[0] < values[1] else None
        return {"below": (0.0, values[0]), "above": (values[0], math.inf), "value": (values[0], values[0])}[form]
    return None


def spans(said: Sequence[Span]) -> list[Span]:
    """The span that each time stands for: a value, for all that is nearer to it than to another value named."""
    values = sorted({low for low, high in said if low == high})
    gaps = [high - low for low, high in pairwise(values)]
    return [_around(low, values, gaps) if low == high else (low, high) for low, high in said]


def _around(value: float, values: Sequence[float], gaps: Sequence[float]) -> Span:
    if not gaps:
        return value * (1 - ALONE), value * (1 + ALONE)
    at = values.index(value)
    before, after = gaps[max(at - 1, 0)], gaps[min(at, len(gaps) - 1)]
    return max(value - before / 2, 0.0), value + after / 2


def count_of(text: str) -> range | None:
    """The numbers that a text allows for what is counted; None where it names none."""
    said = _digits(text)
    if said in {"none", "nothing", "0 of them", "none of them"}:
        return range(1)
    for pattern, form in _COUNT_FORMS:
        match = pattern.fullmatch(said)
        if match is not None:
            first, *rest = (int(group) for group in match.groups() if group is not None)
            spans = {
                "value": (first, first + 1), "range": (first, rest[0] + 1 if rest else 0), "above": (first + 1, MOST),
                "least": (first, MOST), "below": (0, first), "most": (0, first + 1),
            }  # fmt: skip
            return range(*spans[form])
    return None


def _digits(text: str) -> str:
    """Lower case, number words as digits, without a full stop at the end."""
    said = re.sub(r"(?<=\d),(?=\d)", ".", text.lower().strip()).rstrip(".!")
    said = re.sub(r"\bhalf a (?=second)", "0.5 ", said)
    said = re.sub(r"\ba (?=second)", "1 ", said)
    said = re.sub(r"\band a half\b", "and_a_half", said)
    said = " ".join(_WORDS.get(word, word) for word in re.split(r"[\s]+", said))
    said = re.sub(r"(\d+) and_a_half\b", r"\1.5", said)
    return " ".join(said.split())
