"""The prompts for the answer: a letter of the options and nothing else, or a few words where the question is open."""

import math
import re
from collections.abc import Iterator, Sequence
from typing import Any

from cow_service.readers.base import AnswerReading, Imagined
from cow_service.readers.mllm import replies
from cow_service.readers.mllm.client import PromptCall
from cow_service.readers.mllm.contents import hypothesis
from cow_service.readers.options import MARKS, not_sure_option, option_named, plain, question_without, says_not_sure
from cow_service.records import AnswerOption

MAX_ANSWER = 400  # characters of an open answer
MAX_REASONING = 4000  # characters that are kept
UNSURE_WORDS = 6  # an open answer that says "not sure" in more words says something besides
VOTING_TEMPERATURE = 0.7  # without chance every vote would be the same
_KEYS = ("answer", "final_answer", "choice", "option", "letter")
_REASONING_KEYS = ("reasoning", "reason", "explanation", "rationale", "thought", "thoughts")
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


def answer_calls(
    question: str,
    options: Sequence[AnswerOption],
    jpegs: tuple[bytes, ...],
    imagined: Imagined | None,
    votes: int,
    reasoning_length: int,
) -> list[PromptCall[AnswerReading]]:
    """One call per vote. `jpegs` are the image, then the frames; the prompt describes the simulation in words."""
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


def answer_schema(options: Sequence[AnswerOption], reasoning_length: int) -> replies.Schema:
    """JSON schema of the reply."""
    letters = [option.letter for option in options]
    answer = replies.one_of(*letters) if letters else replies.nullable(replies.words(MAX_ANSWER))
    schema = replies.schema_of(reasoning_length=reasoning_length)
    return schema | {"properties": schema["properties"] | {"answer": answer}, "required": ["reasoning", "answer"]}


def read_answer(reply: str, options: Sequence[AnswerOption]) -> AnswerReading:
    """The answer that a reply gives. Raises `ReplyError` if it gives none of the options, or more than one."""
    said = replies.without_thinking(reply)
    parts = (part for value in replies.values_in(said) for part in replies.listed(value))
    objects = [replies.fields_of(part) for part in parts if isinstance(part, dict)]
    if any(key in fields for fields in objects for key in _KEYS):
        readings = [reading for fields in objects for reading in _read_fields(fields, options)]
    else:
        readings = _read_prose(said, options)
    if not readings:
        raise replies.ReplyError(f"`answer` is missing; {_remedy(options)}")
    if len({(reading.answer, reading.not_sure) for reading in readings}) > 1:
        raise replies.ReplyError(f"several answers are given; {_remedy(options)}")
    return readings[-1]


def _read_fields(fields: dict[str, Any], options: Sequence[AnswerOption]) -> Iterator[AnswerReading]:
    """The answer of every field that holds one; later ones must not contradict the first."""
    reasoning = replies.text_of(replies.first_of(fields, *_REASONING_KEYS))[:MAX_REASONING]
    present = [fields[key] for key in _KEYS if key in fields]
    for written in present[:1] + [each for each in present[1:] if not replies.is_none(each)]:
        answer = written  # or what stands in a list of one, or in an object
        if isinstance(written, list) and len(replies.listed(written)) == 1:
            (answer,) = replies.listed(written)
        elif isinstance(written, dict):
            answer = replies.first_of(replies.fields_of(written), *_KEYS, "text")
        if not options:
            yield _read_open(answer, reasoning)
            continue
        text = replies.text_of(answer)
        option = _option(text, options)
        if option is None:
            meant = {option.letter: option for each in _announced(text) if (option := _option(each, options))}
            if len(meant) != 1:
                raise replies.ReplyError(f"the answer '{str(answer)[:80]}' is none of the options; {_remedy(options)}")
            (option,) = meant.values()
        yield _reading_of(option, reasoning)


def _read_prose(said: str, options: Sequence[AnswerOption]) -> list[AnswerReading]:
    """Answers that are announced as such in a text; else its first or last line, where that is one."""
    if replies.is_broken_json(said):
        return []
    answers = _announced(said)
    lines = [line.strip(MARKS) for line in _SPECIAL.sub(" ", said).splitlines() if line.strip(MARKS)]
    if lines:
        last = re.sub(r"^(?:so|therefore|thus|hence)\W+", "", lines[-1], flags=re.IGNORECASE)
        lines = list(dict.fromkeys((lines[0], last)))
    if options:
        found = [option for each in answers or lines if (option := _option(each, options))]
        if answers and not found:
            raise replies.ReplyError(f"the answer '{answers[-1][:80]}' is none of the options; {_remedy(options)}")
        return [_reading_of(option, "" if said == option.letter else said[:MAX_REASONING]) for option in found]
    if answers:
        return [_read_open(answer, said[:MAX_REASONING]) for answer in answers]
    return [_read_open(said, "")] if len(lines) == 1 and not said.startswith(("{", "[")) else []


def _reading_of(option: AnswerOption, reasoning: str) -> AnswerReading:
    return AnswerReading(option.letter, says_not_sure(option.text), reasoning)


def _option(said: str, options: Sequence[AnswerOption]) -> AnswerOption | None:
    """The option that a short text means: it names it, begins with its words, or neither is sure."""
    if found := option_named(options, said):
        return found
    text = said.strip(MARKS)
    begun = [o for o in options if re.match(rf"{re.escape(o.text)}\s*[,.;:!]\s", text, re.IGNORECASE)]
    if len(begun) == 1 and not says_not_sure(text):
        return begun[0]
    return not_sure_option(options) if says_not_sure(text) and len(text.split()) <= UNSURE_WORDS else None


def _read_open(answer: Any, reasoning: str) -> AnswerReading:
    if isinstance(answer, bool):
        answer = "Yes" if answer else "No"
    if isinstance(answer, int | float):
        if not -1e15 < answer < 1e15 or math.isnan(answer):
            raise replies.ReplyError(f"the answer is no usable number; {_remedy(())}")
        answer = f"{answer:g}"
    if isinstance(answer, list):
        answer = ", ".join(replies.text_of(part) for part in replies.listed(answer))
    text = replies.text_of(answer)[:MAX_ANSWER].strip()
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
