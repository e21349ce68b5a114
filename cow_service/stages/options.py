"""Checks `generator_options` against what the chosen generator takes, before any work is done."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ValidationError

from cow_service.errors import FieldError, InvalidRequest
from cow_service.generators.base import Generator


def read_options(generator: Generator, given: dict[str, Any]) -> BaseModel:
    """The generator's own options. Raises `InvalidRequest` with a JSON Pointer for each that it does not take."""
    try:
        return generator.options_model.model_validate(given)
    except ValidationError as error:
        known = ", ".join(sorted(generator.options_model.model_fields)) or "none"
        fields = tuple(
            FieldError("/generator_options/" + "/".join(str(part) for part in item["loc"]), item["msg"])
            for item in error.errors()
        )
        raise InvalidRequest(
            f"`generator_options` are not valid for this generator. It takes: {known}.", errors=fields
        ) from error
