"""Reads the body of a request, JSON or multipart, within the limits, into one checked record."""

from __future__ import annotations

from collections import Counter
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any, TypeVar

from fastapi import Request
from pydantic import ValidationError
from python_multipart.multipart import parse_options_header
from starlette.datastructures import FormData, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from cow_service.api.json_body import read_object
from cow_service.api.problems import invalid
from cow_service.errors import (
    BodyTypeUnsupported,
    FieldError,
    InvalidRequest,
    MalformedBody,
    pointer_part,
    shortened,
)
from cow_service.media.images import DecodedImage
from cow_service.requests import SimulateRequest
from cow_service.service import Service

FORM_FIELDS = ("image", "question", "request")
SHOWN_CHARACTERS = 80  # of what the caller sent

Body = TypeVar("Body", bound=SimulateRequest)


def body_of(model: type[SimulateRequest]) -> dict[str, Any]:
    """The request body of an operation that takes this record, for the OpenAPI document."""
    form = {
        "type": "object",
        "required": ["image"],
        "additionalProperties": False,
        "properties": {
            "image": {"type": "string", "format": "binary", "description": "PNG, JPEG or WebP."},
            "question": {"type": "string", "description": "Here, or in `request`."},
            "request": {"type": "string", "description": f"The rest of `{model.__name__}` as JSON."},
        },
    }
    return {
        "required": True,
        "content": {
            "application/json": {"schema": {"$ref": f"#/components/schemas/{model.__name__}"}},
            "multipart/form-data": {"schema": form},
        },
    }


@dataclass(frozen=True)
class Posted:
    """A body as it came: JSON, or the parts of a form. Nothing of it has been checked or decoded."""

    json: bytes | None = None
    request: str = "{}"  # the form field that holds the rest as JSON
    question: str | None = None
    image: bytes | None = None


async def receive(request: Request) -> Posted:
    """Takes the body in.

    Raises `BodyTypeUnsupported`, `BodyTooLarge`, `BodyTooSlow`, and for a form also `MalformedBody`.
    """
    raw_type, parameters = parse_options_header(request.headers.get("content-type", ""))
    media_type = raw_type.decode("latin-1")[:SHOWN_CHARACTERS]
    if media_type == "multipart/form-data":
        charset = parameters.get(b"charset", b"utf-8").decode("latin-1").lower()
        if charset not in ("utf-8", "utf8", "us-ascii", "ascii"):
            raise BodyTypeUnsupported(
                f"The form has the character set '{charset[:SHOWN_CHARACTERS]}': send UTF-8, and name no other."
            )
        return await _receive_form(request)
    if media_type == "application/json" or media_type.endswith("+json"):
        return Posted(json=await request.body())
    raise BodyTypeUnsupported(
        f"The body has the media type '{media_type or 'none'}'. Send application/json or multipart/form-data."
    )


def check(posted: Posted, model: type[Body], service: Service) -> tuple[Body, DecodedImage | None]:
    """The checked request, and the image of a form, kept and decoded. This computes: not for the event loop."""
    try:
        if posted.json is not None:
            return model.model_validate(read_object(posted.json, "The body")), None
        given = read_object(posted.request, "The form field `request`")
        twice = [name for name in ("image", "question") if name in given and getattr(posted, name) is not None]
        if twice:
            detail = "stands in the form and in its field `request`; give it once"
            raise InvalidRequest(
                f"{' and '.join(f'`{name}`' for name in twice)} {detail}.",
                errors=tuple(FieldError(f"/{name}", detail) for name in twice),
            )
        if posted.question is not None:
            given["question"] = posted.question
        image = None
        if posted.image is not None:
            artifact, image = service.keep_image(posted.image)
            given["image"] = {"artifact": artifact.sha256}
        return model.model_validate(given), image
    except ValidationError as error:
        raise invalid(error) from error


class _FormParser(MultiPartParser):
    """Knows whether the form's last boundary came: what is cut off before it must not count as left out."""

    ended = False

    def on_end(self) -> None:
        self.ended = True


async def _receive_form(request: Request) -> Posted:
    try:
        async with aclosing(request.stream()) as stream:
            parser = _FormParser(request.headers, stream, max_files=3, max_fields=8)
            form = await parser.parse()
    except (MultiPartException, ValueError) as error:
        told = error.message if isinstance(error, MultiPartException) else error
        raise MalformedBody(f"The multipart body could not be read: {told} Send an `image` file part.") from error
    try:
        if not parser.ended:
            raise MalformedBody("The multipart body ends before its last boundary: send it whole.")
        unknown = sorted(set(form.keys()) - set(FORM_FIELDS))
        if unknown:
            named = ", ".join(shortened(name, SHOWN_CHARACTERS) for name in unknown)
            raise InvalidRequest(
                f"The form has fields that nothing reads: {named}. Put them into `request` as JSON.",
                errors=tuple(FieldError(f"/{pointer_part(name)}", "not a form field") for name in unknown),
            )
        twice = [name for name, times in Counter(name for name, _ in form.multi_items()).items() if times > 1]
        if twice:
            detail = "stands in the form more than once; give it once"
            raise InvalidRequest(
                f"{' and '.join(f'`{name}`' for name in twice)} {detail}.",
                errors=tuple(FieldError(f"/{name}", detail) for name in twice),
            )
        image = form.get("image")
        if image is not None and not isinstance(image, UploadFile):
            detail = "`image` must be a file part with a file name."
            raise InvalidRequest(detail, errors=(FieldError("/image", detail),))
        return Posted(
            request=_text(form, "request") or "{}",
            question=_text(form, "question"),
            image=None if image is None else await image.read(),
        )
    finally:
        await form.close()


def _text(form: FormData, name: str) -> str | None:
    value = form.get(name)
    if isinstance(value, UploadFile):
        detail = f"`{name}` must be a plain field, not a file."
        raise InvalidRequest(detail, errors=(FieldError(f"/{name}", detail),))
    return value
