"""Checks of whole requests: how much they hold, and what was wrong with them in words."""

import json
from collections.abc import Callable, Sequence
from typing import Any

from cow_service.errors import SHOWN_CHARACTERS, FieldError, pointer_part, shortened


def has_more_values(value: Any, most: int) -> bool:
    """Whether a JSON value contains more than `most` values, counting nested ones. Stops counting there."""
    held = [value]
    for _ in range(most):
        if not held:
            return False
        one = held.pop()
        held.extend(one.values() if isinstance(one, dict) else one if isinstance(one, list) else ())
    return bool(held)


_OURS = {"extra_forbidden": "there is no such field", "string_too_short": "is empty"}  # by pydantic's type
_HIDDEN = ("function-", "constrained-", "is-instance")
_UNION_BRANCHES = frozenset({"ImageArtifact", "ImageUrl", "str", "texts", "pairs"})


def field_errors(
    found: Sequence[Any], placed: Callable[[str], str] = lambda pointer: pointer
) -> tuple[FieldError, ...]:
    """One error per place in a pydantic error's `errors()`; `placed` maps a JSON Pointer into the request."""
    fields: dict[str, FieldError] = {}
    for item in found:
        # Without the names of union branches and validators, which callers cannot see.
        parts = [p for p in item["loc"] if not str(p).startswith(_HIDDEN) and p not in _UNION_BRANCHES]
        pointer = placed("".join("/" + pointer_part(part) for part in parts))
        detail = _with_value(_OURS.get(item["type"], str(item["msg"])), item["input"])
        if "is empty" in detail and pointer.endswith("/question"):
            detail += ". Ask, for example: 'If the red ball moves to the left, will it hit the vase?'"
        fields.setdefault(pointer, FieldError(pointer, detail))
    return tuple(fields.values())


def _with_value(message: str, value: Any) -> str:
    """A validator's message with the value. Our own messages contain it already where it helps."""
    ours = message.removeprefix("Value error, ")
    if ours != message or not isinstance(value, str | int | float):
        return ours
    reason = message.partition(", got ")[0]  # pydantic says the kind of number there, we say the number
    if isinstance(value, str) and len(value) > SHOWN_CHARACTERS:
        return f"{reason}, got {len(value)} characters"
    return f"{reason}, got {shortened(json.dumps(value))}"
