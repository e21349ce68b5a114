"""Types of request fields: strict numbers, text that can be stored, points, images."""

import json
from collections.abc import Callable, Sequence
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field

from cow_service.errors import SHOWN_CHARACTERS, FieldError, pointer_part, shortened
from cow_service.records import Record, Sha256

MAX_NAME = 100  # characters of a backend's name


def _number(value: Any) -> Any:
    """Numbers only: `true` is not 1 and "81" is not 81, but 81.0 is 81."""
    if isinstance(value, bool | str):
        raise ValueError(f"must be a number, without quotes, got {json.dumps(value)[:40]}")
    return value


def writable(text: str) -> str:
    """Text that every database and file can store."""
    if "\0" in text:
        raise ValueError(f"contains the character NUL (U+0000) at position {text.index(chr(0))}; leave it out")
    return text


def _says_something(text: str) -> str:
    """Text with at least one visible character."""
    if not any(character.isprintable() and not character.isspace() for character in text):
        raise ValueError(f"is empty: it holds only {len(text)} blank or invisible characters")
    return text


def has_more_values(value: Any, most: int) -> bool:
    """Whether a JSON value contains more than `most` values, counting nested ones. Stops counting there."""
    held = [value]
    for _ in range(most):
        if not held:
            return False
        one = held.pop()
        held.extend(one.values() if isinstance(one, dict) else one if isinstance(one, list) else ())
    return bool(held)


Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]  # strict: no strings, no booleans
WHOLE = BeforeValidator(_number)  # comes after the limits of an integer: in a union, the JSON schema omits later ones
Whole = Annotated[int, WHOLE]
Flag = Annotated[bool, Field(strict=True)]
Words = Annotated[str, AfterValidator(writable), AfterValidator(_says_something)]
Name = Annotated[str, Field(max_length=MAX_NAME)]
# Only the first wrong element of a long list is reported: all of them would fill the memory.
Near = Annotated[Finite, Field(ge=-1e6, le=1e6)]  # px, of a point in the image or not too far from it
Points = Annotated[tuple[tuple[Near, Near], ...], Field(fail_fast=True)]
Flags = Annotated[tuple[Flag, ...], Field(fail_fast=True)]


class ImageArtifact(Record):
    """An image that the service already has, by its SHA-256."""

    artifact: Sha256


class ImageUrl(Record):
    """An image for the server to fetch; only from hosts that the server allows."""

    url: str = Field(max_length=4096)


ImageRef = Annotated[str, Field(description="data:image/png;base64,... (PNG, JPEG or WebP)")] | ImageArtifact | ImageUrl


def _no_address(mask: str | ImageArtifact) -> str | ImageArtifact:
    """Masks are drawn by the caller, so none is fetched from a URL."""
    if isinstance(mask, str) and not mask[:5].lower() == "data:":
        raise ValueError('must be a data URL (data:image/png;base64,...) or {"artifact": "<sha256>"}')
    return mask


MaskRef = Annotated[
    Annotated[str, Field(description="data:image/png;base64,...")] | ImageArtifact, AfterValidator(_no_address)
]


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
