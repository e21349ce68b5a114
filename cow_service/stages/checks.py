"""Checks of a request that need the generator: made before any work is done."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ValidationError

from cow_service.errors import FieldError, InvalidRequest, pointer_part
from cow_service.generators.base import Limits
from cow_service.requests import SimulateRequest


def check_request(generator: Limits, request: SimulateRequest) -> BaseModel:
    """The generator's own options, checked, as is the length of the clip.

    Raises `InvalidRequest` with a JSON Pointer for each option that the generator does not take, for a clip that it
    cannot make, and for frames that the clip does not have.
    """
    options = _read_options(generator, request.generator_options)
    if request.num_frames not in (legal := generator.nearest_lengths(request.num_frames)):
        detail = f"this generator makes no clip of {request.num_frames} frames; take {' or '.join(map(str, legal))}"
        raise InvalidRequest(f"`num_frames`: {detail}.", errors=(FieldError("/num_frames", detail),))
    last = request.num_frames - 1
    errors = tuple(
        FieldError(f"/frames/indices/{place}", f"the clip has frames 0 to {last}, got {index}")
        for place, index in enumerate(request.frames.indices or ())
        if index > last
    )
    if errors:
        raise InvalidRequest(
            f"`frames.indices` names frames that the clip does not have: it has 0 to {last}.", errors=errors
        )
    return options


def _read_options(generator: Limits, given: dict[str, Any]) -> BaseModel:
    try:
        return generator.options_model.model_validate(given)
    except ValidationError as error:
        known = ", ".join(sorted(generator.options_model.model_fields)) or "none"
        fields = tuple(
            FieldError("/generator_options/" + "/".join(pointer_part(part) for part in item["loc"]), item["msg"])
            for item in error.errors()
        )
        raise InvalidRequest(
            f"`generator_options` are not valid for this generator. It takes: {known}.", errors=fields
        ) from error
