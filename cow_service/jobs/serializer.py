"""Values in the job database are JSON, long ones deflated, never pickles: reading it runs no code."""

from __future__ import annotations

import json
from typing import Any

from dbos import Serializer

from cow_service.errors import CowError, InternalError
from cow_service.jobs.packing import packed, unpacked
from cow_service.jobs.stored_errors import error_as_json, error_from_json

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
            data = {_ERROR: error_as_json(error)}
        return packed(json.dumps(data, separators=(",", ":")))

    def deserialize(self, serialized_data: str) -> Any:
        """The value of a JSON text, errors as exceptions."""
        value = json.loads(unpacked(serialized_data))
        if not isinstance(value, dict) or set(value) != {_ERROR}:
            return value
        return error_from_json(value[_ERROR])
