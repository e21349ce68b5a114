"""Reads the body of a simulation request, JSON or multipart, within the limits, into one checked record."""

from __future__ import annotations

import json
from typing import Any

from fastapi import Request
from pydantic import ValidationError
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException

from cow_service.api.problems import invalid
from cow_service.errors import BodyTypeUnsupported, FieldError, InvalidRequest, MalformedBody
from cow_service.requests import SimulateRequest
from cow_service.service import Service

BODY = {
    "required": True,
    "content": {
        "application/json": {"schema": {"$ref": "#/components/schemas/SimulateRequest"}},
        "multipart/form-data": {
            "schema": {
                "type": "object",
                "required": ["image", "question"],
                "properties": {
                    "image": {"type": "string", "format": "binary", "description": "PNG, JPEG or WebP."},
                    "question": {"type": "string"},
                    "request": {"type": "string", "description": "The rest of `SimulateRequest` as JSON."},
                },
            }
        },
    },
}


async def read_simulate_request(request: Request, service: Service) -> SimulateRequest:
    """The request's record. Raises `BodyTypeUnsupported`, `MalformedBody`, `InvalidRequest` or an image error."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type == "multipart/form-data":
        given = await _read_form(request, service)
    elif media_type == "application/json" or media_type.endswith("+json"):
        given = _parse(await request.body(), "The body")
    else:
        raise BodyTypeUnsupported(
            f"The body has the media type '{media_type or 'none'}'. Send application/json or multipart/form-data."
        )
    try:
        return SimulateRequest.model_validate_json(json.dumps(given))
    except ValidationError as error:
        raise invalid(error) from error


async def _read_form(request: Request, service: Service) -> dict[str, Any]:
    """The multipart form as the JSON body that it stands for; its image is kept as an artifact."""
    try:
        form = await request.form(max_files=1, max_fields=8)
    except (HTTPException, ValueError) as error:  # starlette turns its own parser errors into HTTP ones
        told = error.detail if isinstance(error, HTTPException) else error
        raise MalformedBody(f"The multipart body could not be read: {told} Send an `image` file part.") from error
    try:
        given = _parse(_text(form, "request") or "{}", "The form field `request`")
        image = form.get("image")
        unknown = sorted(set(form.keys()) - {"image", "question", "request"})
        if unknown:
            raise InvalidRequest(
                f"The form has fields that nothing reads: {', '.join(unknown)}. Put them into `request` as JSON.",
                errors=tuple(FieldError(f"/{name}", "not a form field") for name in unknown),
            )
        if "question" in form:
            given["question"] = _text(form, "question")
        if isinstance(image, UploadFile):
            given["image"] = {"artifact": service.keep_image(await image.read()).sha256}
        elif image is not None:
            detail = "`image` must be a file part with a file name."
            raise InvalidRequest(detail, errors=(FieldError("/image", detail),))
        return given
    finally:
        await form.close()


def _text(form: Any, name: str) -> str | None:
    value = form.get(name)
    if isinstance(value, UploadFile):
        detail = f"`{name}` must be a plain field, not a file."
        raise InvalidRequest(detail, errors=(FieldError(f"/{name}", detail),))
    return value


def _parse(text: str | bytes, what: str) -> dict[str, Any]:
    """A JSON object. NaN and Infinity are not JSON and are refused."""
    try:
        value = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise MalformedBody(f"{what} is not JSON: {error}.") from error
    if not isinstance(value, dict):
        raise MalformedBody(f"{what} must be a JSON object, got {type(value).__name__}.")
    return value


def _refuse(name: str) -> None:
    raise ValueError(f"{name} is not a JSON number")
