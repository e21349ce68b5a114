"""JSON as RFC 8259 has it, stricter than parsers are by default: what two readers could read differently is refused."""

from __future__ import annotations

import json
import re
from typing import Any, NoReturn

from cow_service.errors import MalformedBody

MAX_VALUES = 2_000_000  # the longest tracks that a request may hold, twice; parsed, each takes up to 100 bytes
MAX_KEYS = 1000  # of one object
_SHOWN_CHARACTERS = 80
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_NAMES = {list: "an array", str: "a string", int: "a number", float: "a number", bool: "a boolean", type(None): "null"}


def read_object(text: bytes | str, what: str) -> dict[str, Any]:
    """The JSON object of a body or of a form's field, which `what` names in messages. A byte order mark is skipped.

    Raises `MalformedBody` for anything else: other encodings, other values, keys given twice, NaN and infinities,
    halves of surrogate pairs (no UTF-8 could say them again), and more values, keys, digits or levels than any request
    needs.
    """
    try:
        unicode = text.decode("utf-8-sig") if isinstance(text, bytes) else text
    except UnicodeDecodeError as error:
        raise MalformedBody(
            f"{what} is not UTF-8 (byte {error.start} is {text[error.start]:#04x}): encode the JSON as UTF-8."
        ) from error
    if "\0" in unicode:
        raise MalformedBody(f"{what} holds NUL bytes, as UTF-16 does: encode the JSON as UTF-8.")
    if (commas := unicode.count(",")) > MAX_VALUES:
        raise MalformedBody(f"{what} holds {commas} commas: no request needs more than {MAX_VALUES} values.")
    try:
        value = json.loads(unicode, object_pairs_hook=_unique, parse_constant=_no_number)
    except json.JSONDecodeError as error:
        told = f"{error.msg[0].lower()}{error.msg[1:]}, line {error.lineno} column {error.colno}"
        raise MalformedBody(f"{what} is not JSON ({told}): send one JSON object.") from error
    except RecursionError as error:
        raise MalformedBody(f"{what} is JSON that is nested too deep: no field needs more than ten levels.") from error
    except ValueError as error:
        raise MalformedBody(f"{what} holds a whole number of thousands of digits: no field takes one.") from error
    if not isinstance(value, dict):
        raise MalformedBody(f"{what} must be a JSON object, got {_NAMES[type(value)]}: send {{...}}.")
    if _SURROGATE.search(unicode):
        _check_pairs(value, what)
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, if no key stands in it twice: readers differ on which of the two counts."""
    if len(pairs) > MAX_KEYS:
        raise MalformedBody(f"A JSON object has {len(pairs)} keys: none of a request has more than {MAX_KEYS}.")
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise MalformedBody(f"The key {_shown(twice)} stands twice in one JSON object: give it once.")
    return found


def _no_number(literal: str) -> NoReturn:
    raise MalformedBody(f"{literal} is no JSON number: give a finite one, or leave the field out.")


def _check_pairs(value: dict[str, Any], what: str) -> None:
    try:
        json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        half = error.object[error.start]
        raise MalformedBody(
            f"{what} holds {_shown(half)}, half of a surrogate pair: send the whole character, or none."
        ) from error


def _shown(text: str) -> str:
    return json.dumps(text[:_SHOWN_CHARACTERS])
