"""Values in the job database are JSON, never pickles: reading it runs no code."""

from __future__ import annotations

import json
from typing import Any

from dbos import Serializer

from cow_service.errors import CowError, FieldError, InternalError, kinds

_ERROR = "cow_error"


class JsonSerializer(Serializer):
    """JSON values unchanged; a `CowError` as its code, detail, fields and usage."""

    def name(self) -> str:
        """The name that the database keeps beside each value."""
        return "cow_json"

    def serialize(self, data: Any) -> str:
        """One value as JSON text. Any other exception becomes an internal error without its text."""
        if isinstance(data, BaseException):
            error = data if isinstance(data, CowError) else InternalError("The job met an error that nobody foresaw.")
            fields = [{"pointer": field.pointer, "detail": field.detail} for field in error.errors]
            data = {_ERROR: {"code": error.code, "detail": error.detail, "errors": fields, "usage": error.usage}}
        return json.dumps(data, separators=(",", ":"))

    def deserialize(self, serialized_data: str) -> Any:
        """The value of a JSON text, errors as exceptions."""
        value = json.loads(serialized_data)
        if not isinstance(value, dict) or set(value) != {_ERROR}:
            return value
        kept = value[_ERROR]
        kind = kinds().get(kept["code"], InternalError)  # one of a later version may not be known here
        error = kind(kept["detail"], errors=tuple(FieldError(**field) for field in kept["errors"]))
        error.usage = kept.get("usage")
        return error
