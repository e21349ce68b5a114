"""From the raw text of a model's reply to plain values: objects and lists, wherever in the text they stand.

Models fence their JSON, quote it as Python does, think aloud before it or write prose around it. What is malformed is
repaired by a library, but only where its brackets close: a reply that was cut short must not become a shorter number.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, TypeGuard, cast

from json_repair import repair_json

MAX_LENGTH = 20_000  # characters behind the thinking; a longer reply is not looked through
_FENCE = re.compile(r"```[\w+-]*[ \t]*\n?(.*?)```", re.DOTALL)
_THOUGHT = re.compile(r"</(?:think|thinking|thought|reasoning|seed:think)>|◁/think▷|<\|channel\|>final<\|message\|>")
_THINKING = re.compile(r"<(?:think|thinking|thought|seed:think)>|◁think▷|<\|channel\|>analysis")
_OPENING = {"{": "}", "[": "]"}
_NOTHING = frozenset({"", "none", "null", "n/a", "not found", "nothing"})
_NO_JSON = object()
_DETERMINERS = frozenset({"the", "a", "an", "this", "that"})
_BEFORE_STRING = frozenset("{[,:(")
_AFTER_STRING = frozenset("}],:)")


class ReplyError(Exception):
    """A reply cannot be used. The message says why, in words that the model can act on."""


def without_thinking(text: str) -> str:
    """The reply behind its thinking. Raises `ReplyError` where there is nothing else, or far too much."""
    ends = list(_THOUGHT.finditer(text))
    if not ends and _THINKING.search(text):
        raise ReplyError("the reply ended while it was still thinking; think less and give the JSON object")
    said = (text[ends[-1].end() :] if ends else text).strip()
    if not said:
        raise ReplyError("the reply is empty; give the JSON object")
    if len(said) > MAX_LENGTH:
        raise ReplyError(f"the reply has {len(said)} characters; answer in a few sentences")
    return said


def values_in(text: str) -> tuple[Any, ...]:
    """Every JSON object and list in a reply, in order; those in code fences alone where there are any.

    Numbers, words and null are values only where they are the whole reply.
    """
    whole = _parsed(text)
    if whole is not _NO_JSON:
        inner = _parsed(whole) if isinstance(whole, str) else _NO_JSON  # a string may hold the JSON that was meant
        return (whole if inner is _NO_JSON else inner,)
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


def is_none(value: object) -> bool:
    """Whether a field says that there is nothing: null, an empty list, or a word for it."""
    return value is None or value == [] or (isinstance(value, str) and value.strip().lower() in _NOTHING)


def is_number(value: object) -> TypeGuard[int | float]:
    """Whether a value is a number; true and false are none."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def truth_of(value: object) -> bool | None:
    """A field that should hold true or false, also as a word; None where it holds neither."""
    words = {"true": True, "yes": True, "false": False, "no": False}
    return value if isinstance(value, bool) else words.get(value.strip().lower()) if isinstance(value, str) else None


def text_of(value: object) -> str:
    """A field that should hold words, as one line; empty where it holds something else."""
    return " ".join(value.split()) if isinstance(value, str) else ""


def name_words(name: str) -> list[str]:
    """The words of an object's name without determiners, lower case."""
    return [word for word in re.findall(r"\w+", name.lower()) if word not in _DETERMINERS]


def _parsed(text: str) -> Any:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return _NO_JSON


def _bracketed(text: str) -> list[Any]:
    values: list[Any] = []
    for span in _spans(text):
        with suppress(ValueError, RecursionError):
            values.append(repair_json(span, return_objects=True))  # which leaves well-formed JSON as it is
    return [value for value in values if isinstance(value, dict | list)]


def _spans(text: str) -> Iterator[str]:
    """Outermost bracketed parts of a text, strings inside them left alone; up to the first that does not close.

    What stands inside a bracket that never closes may be half of what was meant. One pass: a reply may be nothing but
    opening brackets.
    """
    waiting: list[str] = []
    start, quote, skipped = 0, "", False
    for at, char in enumerate(text):
        if skipped:
            skipped = False
        elif quote:
            skipped = char == "\\"
            if char == quote and _next(text, at) in _AFTER_STRING:
                quote = ""
        elif waiting and char in "\"'" and _previous(text, at) in _BEFORE_STRING:
            quote = char
        elif char in _OPENING:
            start = start if waiting else at
            waiting.append(_OPENING[char])
        elif waiting and char == waiting[-1]:
            waiting.pop()
            if not waiting:
                yield text[start : at + 1]


def _next(text: str, at: int) -> str:
    """The next character that is no space; only a few are looked at."""
    return text[at + 1 : at + 40].lstrip()[:1]


def _previous(text: str, at: int) -> str:
    return text[max(0, at - 40) : at].rstrip()[-1:]
