"""From the raw text of a model's reply to plain values: objects and lists, wherever in the text they stand.

Models fence their JSON, quote it as Python does, think aloud before it or write prose around it. What is malformed is
repaired by a library, but only where its brackets close: a reply that was cut short must not become a shorter number.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any, cast

from json_repair import repair_json

MAX_LENGTH = 200_000  # characters; a longer reply is not looked through
_FENCE = re.compile(r"```[\w+-]*[ \t]*\n?(.*?)```", re.DOTALL)
_OPENING = {"{": "}", "[": "]"}
_BEFORE_STRING = frozenset("{[,:(")
_AFTER_STRING = frozenset("}],:)")


class ReplyError(Exception):
    """A reply cannot be used. The message says why, in words that the model can act on."""


def without_thinking(text: str) -> str:
    """The reply behind its thinking. Raises `ReplyError` where there is nothing else, or far too much."""
    if len(text) > MAX_LENGTH:
        raise ReplyError(f"the reply has {len(text)} characters; answer in a few sentences")
    head, closed, tail = text.rpartition("</think>")
    if not closed and "<think>" in text:
        raise ReplyError("the reply ended while it was still thinking; think less and give the JSON object")
    said = (tail if closed else head + tail).strip()
    if not said:
        raise ReplyError("the reply is empty; give the JSON object")
    return said


def values_in(text: str) -> tuple[Any, ...]:
    """Every JSON object and list in a reply, in order; those in code fences alone where there are any.

    Numbers, words and null are values only where they are the whole reply.
    """
    whole = _parsed(text)
    if whole is not None:
        return _unwrapped(whole.value)
    fenced = [value for block in _FENCE.findall(text) for value in _bracketed(block)]
    return tuple(fenced or _bracketed(text))


def fields_of(value: object) -> dict[str, Any]:
    """An object's fields with plain names: lower case, words joined by _; none where the value is no object."""
    if not isinstance(value, dict):
        return {}
    fields = cast("dict[object, Any]", value)
    return {"_".join(re.split(r"[\s_-]+", str(name).strip().lower())): held for name, held in fields.items()}


def first_of(fields: dict[str, Any], *names: str) -> Any:
    """The value of the first of some fields that is there; None where none is."""
    return next((fields[name] for name in names if name in fields), None)


def text_of(value: object) -> str:
    """A field that should hold words, as one line; empty where it holds something else."""
    return " ".join(value.split()) if isinstance(value, str) else ""


class _Parsed:
    """A value that may be None, told apart from no value."""

    def __init__(self, value: object) -> None:
        self.value = value


def _parsed(text: str) -> _Parsed | None:
    try:
        return _Parsed(json.loads(text))
    except (ValueError, RecursionError):
        return None


def _unwrapped(value: object) -> tuple[Any, ...]:
    """A JSON string may hold the JSON that was meant."""
    inner = _parsed(value) if isinstance(value, str) else None
    return (value if inner is None else inner.value,)


def _bracketed(text: str) -> list[Any]:
    values: list[Any] = []
    for span in _spans(text):
        strict = _parsed(span)
        value = _repaired(span) if strict is None else strict.value
        if isinstance(value, dict | list):
            values.append(value)
    return values


def _repaired(span: str) -> object:
    try:
        return repair_json(span, return_objects=True, skip_json_loads=True)
    except (ValueError, RecursionError):
        return None


def _spans(text: str) -> Iterator[str]:
    """Outermost bracketed parts of a text whose brackets close, strings inside them left alone."""
    at = 0
    while at < len(text):
        if text[at] in _OPENING and (end := _closing(text, at)):
            yield text[at:end]
            at = end
        else:
            at += 1


def _closing(text: str, start: int) -> int:
    """One past the bracket that closes the one at `start`; 0 where none does."""
    waiting: list[str] = []
    quote = ""
    at = start
    while at < len(text):
        char = text[at]
        if quote:
            if char == "\\":
                at += 1
            elif char == quote and _neighbour(text, at, 1) in _AFTER_STRING:
                quote = ""
        elif char in "\"'" and _neighbour(text, at, -1) in _BEFORE_STRING:
            quote = char
        elif char in _OPENING:
            waiting.append(_OPENING[char])
        elif waiting and char == waiting[-1]:
            waiting.pop()
            if not waiting:
                return at + 1
        at += 1
    return 0


def _neighbour(text: str, at: int, step: int) -> str:
    at += step
    while 0 <= at < len(text) and text[at].isspace():
        at += step
    return text[at] if 0 <= at < len(text) else ""
