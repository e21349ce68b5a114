"""JSON schemas of replies, in the few forms that every server with structured output takes."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from cow_service.readers.mllm.coordinates import CoordinateFrame

Schema = dict[str, Any]


def object_of(optional: Collection[str] = (), /, **properties: Schema) -> Schema:
    """An object with these fields and no others, in this order: reasoning comes first. `optional` may be left out."""
    required = [name for name in properties if name not in optional]
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def words(longest: int) -> Schema:
    """Text of at most so many characters."""
    return {"type": "string", "maxLength": longest}


def one_of(*values: str) -> Schema:
    """One of some words."""
    return {"type": "string", "enum": list(values)}


def nullable(schema: Schema) -> Schema:
    """That, or null."""
    return {"anyOf": [schema, {"type": "null"}]}


def numbers(frame: CoordinateFrame, count: int) -> Schema:
    """`count` coordinates as the frame's family writes them."""
    units = frame.coordinates.units
    highest = max(frame.seen) if units == "pixels" else {"thousandths": 1000, "fractions": 1}[units]
    number = {"type": "number" if units == "fractions" else "integer", "minimum": 0, "maximum": highest}
    return {"type": "array", "items": number, "minItems": count, "maxItems": count}
