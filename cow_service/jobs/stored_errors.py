"""Errors as JSON values: in the job database, and between processes."""

from __future__ import annotations

from typing import Any

from cow_service.errors import CowError, FieldError, InternalError, kinds


def error_as_json(error: CowError) -> dict[str, Any]:
    """Its code, detail, fields and usage."""
    fields = [{"pointer": field.pointer, "detail": field.detail} for field in error.errors]
    return {"code": error.code, "detail": error.detail, "errors": fields, "usage": error.usage}


def error_from_json(kept: dict[str, Any]) -> CowError:
    """The same error; an internal one where a later version made it, and it is not known here."""
    kind = kinds().get(kept["code"], InternalError)
    error = kind(kept["detail"], errors=tuple(FieldError(**field) for field in kept["errors"]))
    error.usage = kept.get("usage")
    return error
