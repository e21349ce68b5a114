"""The prompts for the answer: a letter of the options and nothing else, or a few words where the question is open."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, cast

from cow_service.readers.base import AnswerReading, Imagined
from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.hypothesis import hypothesis
from cow_service.readers.mllm.replies import (
    ReplyError,
    Schema,
    fields_of,
    first_of,
    is_broken_json,
    is_none,
    nullable,
    one_of,
    schema_of,
    text_of,
    values_in,
    without_thinking,
    words,
)
from cow_service.readers.options import not_sure_option, option_saying, plain, question_without, says_not_sure
from cow_service.records import AnswerOption

MAX_ANSWER = 400  # characters of an open answer
MAX_REASONING = 4000  # characters that are kept
UNSURE_WORDS = 6  # an open answer that says "not sure" in more words says something besides
VOTING_TEMPERATURE = 0.7  # without chance every vote would be the same
_KEYS = ("answer", "final_answer", "choice", "option", "letter")
_REASONING_KEYS = ("reasoning", "reason", "explanation", "rationale", "thought", "thoughts")
MARKS = "*_`\"'“” \t."
_ANSWER_IS = re.compile(r"\b(?:final\s+)?answer\b[\s*_\"'`]*(?:is|:|=)[\s*_\"'`]*(?P<said>[^\n]*)", re.IGNORECASE)
_TAGGED = re.compile(r"<answer>(?P<said>.*?)(?:</answer>|$)", re.IGNORECASE | re.DOTALL)
_BOXED = re.compile(r"\\boxed\{(?:\\\w+\{)*(?P<said>[^{}]*)\}")
# A letter alone behind such words; with a word after it, it may be an article.
_CHOSEN = re.compile(
    r"\b(?:[Aa]nswer|[Cc]hoose|[Pp]ick|[Ss]elect)[\s*_:]+(?:[Oo]ption\s+)?(?P<said>[(\[]?[A-Z][)\]]?)(?=[.,;*\s]*(?:\n|$))"
    r"|^\W*(?:[Oo]ption\s+)?(?P<right>[(\[]?[A-Z][)\]]?) is (?:the )?(?:correct|right)\b",
    re.MULTILINE,
)
_SPECIAL = re.compile(r"<\|\w+\|>")
_LETTER = re.compile(
    r"(?:option\s+|choice\s+)?[(\[]?(?P<letter>[A-Za-z])[)\]]?\s*[.:)\-]?\s*(?P<text>.*)", re.DOTALL | re.IGNORECASE
)


def answer_calls(
    question: str,
    options: Sequence[AnswerOption],
    jpegs: tuple[bytes, ...],
    imagined: Imagined | None,
    votes: int,
    reasoning_length: int,
) -> list[PromptCall[AnswerReading]]:
    """One call per vote. `jpegs` are the image, then the frames; what the simulation found is told in words."""
    inputs: dict[str, object] = {"question": question_without(question, options), "options": tuple(options)}
    return [
        PromptCall(
            "answer-from-image" if imagined is None else "answer-with-frames",
            inputs if imagined is None else inputs | hypothesis(imagined),
            jpegs,
            answer_schema(options, reasoning_length),
            lambda reply: read_answer(reply, options),
            vote=vote,
            temperature=VOTING_TEMPERATURE if votes > 1 else None,
        )
        for vote in range(votes)
    ]


def answer_schema(options: Sequence[AnswerOption], reasoning_length: int) -> Schema:
    """JSON schema of the reply."""
    schema = schema_of(reasoning_length=reasoning_length)
    answer = one_of(*(option.letter for option in options)) if options else nullable(words(MAX_ANSWER))
    return schema | {"properties": schema["properties"] | {"answer": answer}, "required": ["reasoning", "answer"]}


def read_answer(reply: str, options: Sequence[AnswerOption]) -> AnswerReading:
    """The answer that a reply gives. Raises `ReplyError` where it gives none of the options, or more than one."""
    said = without_thinking(reply)
    values = values_in(said)
    fields = [found for value in values for found in _objects(value)]
    if any(key in found for found in fields for key in _KEYS):
        readings = [reading for found in fields for reading in _in_fields(found, options)]
    else:
        readings = _in_prose(said, options)
    if not readings:
        raise ReplyError(f"`answer` is missing; {_remedy(options)}")
    if len({(reading.answer, reading.not_sure) for reading in readings}) > 1:
        raise ReplyError(f"several answers are given; {_remedy(options)}")
    return readings[-1]


def _objects(value: object) -> Iterator[dict[str, Any]]:
    if isinstance(value, list):
        for part in cast("list[object]", value):
            yield from _objects(part)
    elif isinstance(value, dict):
        yield fields_of(cast("object", value))


def _in_fields(fields: dict[str, Any], options: Sequence[AnswerOption]) -> Iterator[AnswerReading]:
    """A reading of every field that answers; those beside the first must not say otherwise."""
    reasoning = text_of(first_of(fields, *_REASONING_KEYS))[:MAX_REASONING]
    present = [fields[key] for key in _KEYS if key in fields]
    for place, answer in enumerate(present):
        if place == 0 or not is_none(answer):
            yield _read(_unwrapped(answer), reasoning, options)


def _unwrapped(answer: Any) -> Any:
    """What stands in a list of one, or in an object."""
    if isinstance(answer, list) and len(cast("list[object]", answer)) == 1:
        return cast("list[object]", answer)[0]
    if isinstance(answer, dict):
        return first_of(fields_of(cast("object", answer)), *_KEYS, "text")
    return answer


def _in_prose(said: str, options: Sequence[AnswerOption]) -> list[AnswerReading]:
    """Answers that are announced as such in a text; else its first or last line, where that is one."""
    if is_broken_json(said):
        return []
    answers, lines = _announced(said), _edge_lines(said)
    if options:
        found = [option for each in answers or lines if (option := _option(each, options))]
        if answers and not found:
            raise ReplyError(f"the answer '{answers[-1][:80]}' is none of the options; {_remedy(options)}")
        return [_reading_of(option, "" if said == option.letter else said[:MAX_REASONING]) for option in found]
    if answers:
        return [_read_open(answer, said[:MAX_REASONING]) for answer in answers]
    return [_read_open(said, "")] if len(lines) == 1 and not said.startswith(("{", "[")) else []


def _read(answer: Any, reasoning: str, options: Sequence[AnswerOption]) -> AnswerReading:
    if not options:
        return _read_open(answer, reasoning)
    text = text_of(answer)
    option = _option(text, options)
    if option is None and text:
        found = {option.letter: option for each in _announced(text) if (option := _option(each, options))}
        option = next(iter(found.values())) if len(found) == 1 else None
    if option is None:
        raise ReplyError(f"the answer '{str(answer)[:80]}' is none of the options; {_remedy(options)}")
    return _reading_of(option, reasoning)


def _reading_of(option: AnswerOption, reasoning: str) -> AnswerReading:
    return AnswerReading(option.letter, says_not_sure(option.text), reasoning)


def _option(said: str, options: Sequence[AnswerOption]) -> AnswerOption | None:
    """The option that a short text means: by its letter, by its own words, or because neither is sure."""
    text = said.strip(MARKS)
    found = _lettered(text, options) or option_saying(options, text)
    if found is not None:
        return found
    begun = [o for o in options if re.match(rf"{re.escape(o.text)}\s*[,.;:!]\s", text, re.IGNORECASE)]
    if len(begun) == 1 and not says_not_sure(text):
        return begun[0]
    return not_sure_option(options) if says_not_sure(text) and len(text.split()) <= UNSURE_WORDS else None


def _lettered(text: str, options: Sequence[AnswerOption]) -> AnswerOption | None:
    """The option whose letter stands first, if what follows the letter is nothing or that option's own text."""
    found = _LETTER.fullmatch(text)
    if found is None:
        return None
    option = next((option for option in options if option.letter == found["letter"].upper()), None)
    rest = found["text"].strip(MARKS + ")")
    same = option is not None and (rest == option.text or plain(rest) == plain(option.text) != "")
    return option if not rest or same else None


def _read_open(answer: Any, reasoning: str) -> AnswerReading:
    if isinstance(answer, bool):
        answer = "Yes" if answer else "No"
    if isinstance(answer, int | float):
        if not -1e15 < answer < 1e15 or math.isnan(answer):
            raise ReplyError(f"the answer is no usable number; {_remedy(())}")
        answer = f"{answer:g}"
    if isinstance(answer, list):
        answer = ", ".join(text_of(part) for part in cast("list[object]", answer))
    text = text_of(answer)[:MAX_ANSWER].strip()
    unsure = says_not_sure(text) and len(text.split()) <= UNSURE_WORDS
    if plain(text) in {"", "null"} or unsure:
        return AnswerReading(None, True, reasoning)
    return AnswerReading(text, False, reasoning)


def _remedy(options: Sequence[AnswerOption]) -> str:
    if not options:
        return "give it in a few words"
    return f"give one letter of {', '.join(option.letter for option in options)}"


def _announced(said: str) -> list[str]:
    """Answers that a text announces as such, the surest kind of announcement alone."""
    text = _SPECIAL.sub(" ", said)
    for pattern in (_BOXED, _TAGGED, _ANSWER_IS, _CHOSEN):
        groups = [next(group for group in found.groups() if group is not None) for found in pattern.finditer(text)]
        answers = [group.strip(MARKS) for group in groups if group.strip(MARKS)]
        if answers:
            return answers
    return []


def _edge_lines(said: str) -> list[str]:
    """First and last line of a text, without special tokens: where an answer that is not announced stands."""
    lines = [line.strip(MARKS) for line in _SPECIAL.sub(" ", said).splitlines() if line.strip(MARKS)]
    if not lines:
        return []
    last = re.sub(r"^(?:so|therefore|thus|hence)\W+", "", lines[-1], flags=re.IGNORECASE)
    return list(dict.fromkeys((lines[0], last)))
