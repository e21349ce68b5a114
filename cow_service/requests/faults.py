"""What pydantic found wrong with input, as our fields: where it is, what is wrong, and the value."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

from cow_service.errors import FieldError, pointer_part, shortened

SHOWN_CHARACTERS = 80  # of what the caller sent
_HIDDEN = ("function-", "constrained-", "is-instance")
_UNION_BRANCHES = frozenset({"ImageArtifact", "ImageUrl", "str", "texts", "pairs"})


def field_errors(
    found: Sequence[Any], placed: Callable[[str], str] = lambda pointer: pointer
) -> tuple[FieldError, ...]:
    """One for each place of a pydantic error's `errors()`; `placed` says where a JSON Pointer stands in the request."""
    fields: dict[str, FieldError] = {}
    for item in found:
        pointer = placed("".join("/" + pointer_part(part) for part in _location(item["loc"])))
        fields.setdefault(pointer, FieldError(pointer, _with_value(str(item["msg"]), item["input"])))
    return tuple(fields.values())


def _with_value(message: str, value: Any) -> str:
    """A validator's message with the value; our own messages name it where it helps."""
    ours = message.removeprefix("Value error, ")
    if ours != message or not isinstance(value, str | int | float):
        return ours
    reason = message.partition(", got ")[0]  # a kind of number, in place of the number
    if isinstance(value, str) and len(value) > SHOWN_CHARACTERS:
        return f"{reason}, got {len(value)} characters"
    return f"{reason}, got {shortened(json.dumps(value), SHOWN_CHARACTERS)}"


def _location(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """A pydantic location without the names of union branches and validators, which callers cannot see."""
    return tuple(p for p in loc if not (isinstance(p, str) and (p.startswith(_HIDDEN) or p in _UNION_BRANCHES)))
