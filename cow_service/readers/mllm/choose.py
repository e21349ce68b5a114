"""The prompts for the answer: a letter of the options and nothing else, or a few words where the question is open."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any, cast

from cow_service.readers.base import AnswerReading
from cow_service.readers.choices import not_sure_option, option_saying, plain, says_not_sure
from cow_service.readers.mllm.schemas import Schema, nullable, object_of, one_of, words
from cow_service.readers.replies import ReplyError, fields_of, first_of, text_of, values_in, without_thinking
from cow_service.records import AnswerOption

MAX_ANSWER = 400  # characters of an open answer
MAX_REASONING = 4000  # characters that are kept
_KEYS = ("answer", "final_answer", "choice", "option", "letter")
_REASONING_KEYS = ("reasoning", "reason", "explanation", "rationale", "thought", "thoughts")
_LETTER = re.compile(
    r"(?:option\s+|choice\s+)?[(\[]?(?P<letter>[A-Za-z])[)\]]?\s*[.:)\-]?\s*(?P<text>.*)", re.DOTALL | re.IGNORECASE
)
_TOLD = re.compile(
    r"(?:<answer>|\b(?:final\s+)?answer\b[\s*_\"'`]*(?:is|:|=)[\s*_\"'`]*)(?P<said>[^\n<}]*)", re.IGNORECASE
)
_BOXED = re.compile(r"\\boxed\{(?:\\text\{)?([^{}]*)\}*")
_MARKS = "*_`\"'“” \t."


def schema(options: Sequence[AnswerOption], reasoning_length: int) -> Schema:
    """JSON schema of the reply."""
    answer = one_of(*(option.letter for option in options)) if options else nullable(words(MAX_ANSWER))
    return object_of(reasoning=words(reasoning_length), answer=answer)


def read_answer(reply: str, options: Sequence[AnswerOption]) -> AnswerReading:
    """The answer that a reply gives. Raises `ReplyError` where it gives none of the options, or more than one."""
    said = without_thinking(reply)
    values = values_in(said)
    told = [(answer, reasoning) for value in values for answer, reasoning in _answers(value)]
    if not told:
        told = [(answer, "" if answer == said else said) for answer in _in_prose(said)]
    if not told:
        raise ReplyError(f"`answer` is missing; {_remedy(options)}")
    readings = [_read(answer, reasoning[:MAX_REASONING], options) for answer, reasoning in told]
    if len({(reading.answer, reading.not_sure) for reading in readings}) > 1:
        raise ReplyError(f"several answers are given; {_remedy(options)}")
    return readings[-1]


def _answers(value: object) -> Iterator[tuple[object, str]]:
    if isinstance(value, list):
        for part in cast("list[object]", value):
            if isinstance(part, dict):
                yield from _answers(part)
    fields = fields_of(value)
    if any(key in fields for key in _KEYS):
        yield first_of(fields, *_KEYS), text_of(first_of(fields, *_REASONING_KEYS))


def _in_prose(said: str) -> list[str]:
    """Answers that are announced as such in a text; else the whole text where it is one short line."""
    boxed = [found[1].strip(_MARKS) for found in _BOXED.finditer(said)]
    if boxed:
        return boxed
    told = [found["said"].strip(_MARKS) for found in _TOLD.finditer(said)]
    told = [answer for answer in told if answer]
    if told:
        return told
    return [said] if "\n" not in said and len(said.split()) <= 8 and not said.startswith(("{", "[")) else []


def _read(answer: Any, reasoning: str, options: Sequence[AnswerOption]) -> AnswerReading:
    if not options:
        return _read_open(answer, reasoning)
    text = text_of(answer).strip(_MARKS)
    option = option_saying(options, text) or _lettered(text, options)
    if option is None:
        raise ReplyError(f"the answer '{str(answer)[:80]}' is none of the options; {_remedy(options)}")
    return AnswerReading(option.letter, option == not_sure_option(options), reasoning)


def _lettered(text: str, options: Sequence[AnswerOption]) -> AnswerOption | None:
    """The option whose letter stands first, if what follows the letter is nothing or that option's own text."""
    found = _LETTER.fullmatch(text)
    if found is None:
        return None
    option = next((option for option in options if option.letter == found["letter"].upper()), None)
    rest, own = plain(found["text"]), "" if option is None else plain(option.text)
    return option if not rest or rest == own else None


def _read_open(answer: Any, reasoning: str) -> AnswerReading:
    text = text_of(answer)[:MAX_ANSWER]
    if isinstance(answer, int | float) and not isinstance(answer, bool):
        text = f"{answer:g}"
    if isinstance(answer, bool):
        text = "Yes" if answer else "No"
    if answer is None or plain(text) in {"", "null", "none"} or says_not_sure(text):
        return AnswerReading(None, True, reasoning)
    return AnswerReading(text, False, reasoning)


def _remedy(options: Sequence[AnswerOption]) -> str:
    if not options:
        return "give it in a few words"
    return f"give one letter of {', '.join(option.letter for option in options)}"
