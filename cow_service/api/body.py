"""Reads the body of a request, JSON or multipart, within the limits, into one validated record.

JSON is read as RFC 8259 has it, more strictly than parsers do by default: what two parsers could read differently is
refused.
"""

import hashlib
import json
import re
from collections import Counter
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any, NoReturn, TypeVar

from fastapi import Request
from pydantic import ValidationError
from python_multipart.multipart import parse_options_header
from starlette.datastructures import FormData, UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser

from cow_service.api.problems import invalid
from cow_service.errors import BodyTypeUnsupported, FieldError, InvalidRequest, MalformedBody, pointer_part, shortened
from cow_service.requests import SHOWN_CHARACTERS, LookRequest, SimulateRequest

FORM_FIELDS = ("image", "question", "request")
MAX_VALUES = 2_000_000  # of a JSON text: the longest tracks that a request may hold, twice; each takes up to 100 bytes
MAX_KEYS = 1000  # of one JSON object
MAX_OBJECTS = 100_000  # of a JSON text; each is checked in Python
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")
_NAMES = {list: "an array", str: "a string", int: "a number", float: "a number", bool: "a boolean", type(None): "null"}

Body = TypeVar("Body", bound=SimulateRequest | LookRequest)


def body_of(model: type[SimulateRequest | LookRequest]) -> dict[str, Any]:
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
class RawBody:
    """A body as received: JSON, or the parts of a form. Nothing of it is validated or decoded."""

    json: bytes | None = None
    request: str = "{}"  # the form field that holds the rest as JSON
    question: str | None = None
    image: bytes | None = None


MAX_PART_BYTES = 64 * 2**20  # of `request`, which may hold masks and a depth map; the body has a separate limit


class _FormParser(MultiPartParser):
    """Records whether the last boundary arrived: fields cut off before it must not count as omitted."""

    ended = False

    def on_end(self) -> None:
        self.ended = True


async def receive(request: Request) -> RawBody:
    """Receives the body.

    Raises `BodyTypeUnsupported`, `BodyTooLarge`, `BodyTooSlow`, and for a form also `MalformedBody`.
    """
    raw_type, parameters = parse_options_header(request.headers.get("content-type", ""))
    media_type = raw_type.decode("latin-1")[:SHOWN_CHARACTERS]
    if media_type == "application/json" or media_type.endswith("+json"):
        return RawBody(json=b"".join([part async for part in request.stream()]))
    if media_type != "multipart/form-data":
        raise BodyTypeUnsupported(
            f"The body has the media type '{media_type or 'none'}'. Send application/json or multipart/form-data."
        )
    charset = parameters.get(b"charset", b"utf-8").decode("latin-1").lower()
    if charset not in ("utf-8", "utf8", "us-ascii", "ascii"):
        raise BodyTypeUnsupported(f"The form has the character set '{charset[:SHOWN_CHARACTERS]}': send UTF-8.")
    try:
        async with aclosing(request.stream()) as stream:
            parser = _FormParser(request.headers, stream, max_files=3, max_fields=8, max_part_size=MAX_PART_BYTES)
            form = await parser.parse()
    except (MultiPartException, ValueError) as error:
        reason = error.message if isinstance(error, MultiPartException) else error
        raise MalformedBody(f"The multipart body could not be read: {reason} Send an `image` file part.") from error
    try:
        if not parser.ended:
            raise MalformedBody("The multipart body ends before its last boundary: send it whole.")
        unknown = sorted(set(form.keys()) - set(FORM_FIELDS))
        if unknown:
            named = ", ".join(shortened(name, SHOWN_CHARACTERS) for name in unknown)
            raise InvalidRequest(
                f"The form has unknown fields: {named}. Put request fields into `request` as JSON.",
                errors=tuple(FieldError(f"/{pointer_part(name)}", "not a form field") for name in unknown),
            )
        twice = [name for name, times in Counter(name for name, _ in form.multi_items()).items() if times > 1]
        _check_unique(twice, "appears more than once in the form; give it once")
        image = form.get("image")
        if image is not None and not isinstance(image, UploadFile):
            detail = "`image` must be a file part with a file name."
            raise InvalidRequest(detail, errors=(FieldError("/image", detail),))
        return RawBody(
            request=_text(form, "request") or "{}",
            question=_text(form, "question"),
            image=None if image is None else await image.read(),
        )
    finally:
        await form.close()


def parse(raw: RawBody, model: type[Body]) -> Body:
    """The validated request; the image of a form by the SHA-256 that it will be kept by. CPU work: not for the event
    loop."""
    try:
        if raw.json is not None:
            return model.model_validate(read_object(raw.json, "The body"))
        given = read_object(raw.request, "The form field `request`")
        twice = [name for name in ("image", "question") if name in given and getattr(raw, name) is not None]
        _check_unique(twice, "appears both in the form and in its field `request`; give it once")
        if raw.question is not None:
            given["question"] = raw.question
        if raw.image is not None:
            given["image"] = {"artifact": hashlib.sha256(raw.image).hexdigest()}
        return model.model_validate(given)
    except ValidationError as error:
        raise invalid(error) from error


def _check_unique(twice: list[str], detail: str) -> None:
    """Raises `InvalidRequest` if there are fields that were given twice."""
    if twice:
        names = " and ".join(f"`{name}`" for name in twice)
        raise InvalidRequest(f"{names} {detail}.", errors=tuple(FieldError(f"/{name}", detail) for name in twice))


def _text(form: FormData, name: str) -> str | None:
    value = form.get(name)
    if isinstance(value, UploadFile):
        detail = f"`{name}` must be a plain field, not a file."
        raise InvalidRequest(detail, errors=(FieldError(f"/{name}", detail),))
    return value


def read_object(text: bytes | str, what: str) -> dict[str, Any]:
    """The JSON object of a body or of a form's field, which `what` names in messages. A byte order mark is skipped.

    Raises `MalformedBody` for anything else: other encodings, other values, keys given twice, NaN and infinities,
    halves of surrogate pairs (no UTF-8 could say them again), and more values, keys, digits or levels than any request
    needs.
    """
    try:
        unicode = text.decode("utf-8-sig") if isinstance(text, bytes) else text
    except UnicodeDecodeError as error:
        raise MalformedBody(
            f"{what} is not UTF-8 (byte {error.start} is {text[error.start]:#04x}): encode the JSON as UTF-8."
        ) from error
    if "\0" in unicode:
        raise MalformedBody(f"{what} holds NUL bytes, as UTF-16 does: encode the JSON as UTF-8.")
    for sign, most in ((",", MAX_VALUES), ("{", MAX_OBJECTS)):
        if (count := unicode.count(sign)) > most:
            raise MalformedBody(f"{what} holds {count} times the sign {sign} and no request needs more than {most}.")
    try:
        value = json.loads(unicode, object_pairs_hook=_unique, parse_constant=_reject_constant)
    except json.JSONDecodeError as error:
        reason = f"{error.msg[0].lower()}{error.msg[1:]}, line {error.lineno} column {error.colno}"
        raise MalformedBody(f"{what} is not JSON ({reason}): send one JSON object.") from error
    except RecursionError as error:
        raise MalformedBody(f"{what} is JSON that is nested too deep: no field needs more than ten levels.") from error
    except ValueError as error:
        raise MalformedBody(f"{what} holds a whole number of thousands of digits: no field takes one.") from error
    if not isinstance(value, dict):
        raise MalformedBody(f"{what} must be a JSON object, got {_NAMES[type(value)]}: send {{...}}.")
    try:
        if _SURROGATE.search(unicode):
            json.dumps(value, ensure_ascii=False).encode()
    except UnicodeEncodeError as error:
        half = _shown(error.object[error.start])
        detail = f"{what} holds {half}, half of a surrogate pair: send the whole character, or none."
        raise MalformedBody(detail) from error
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object, if no key stands in it twice: readers differ on which of the two counts."""
    if len(pairs) > MAX_KEYS:
        raise MalformedBody(f"A JSON object has {len(pairs)} keys: none of a request has more than {MAX_KEYS}.")
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))
        raise MalformedBody(f"The key {_shown(twice)} stands twice in one JSON object: give it once.")
    return found


def _reject_constant(literal: str) -> NoReturn:
    raise MalformedBody(f"{literal} is no JSON number: give a finite one, or leave the field out.")


def _shown(text: str) -> str:
    return json.dumps(text[:SHOWN_CHARACTERS])
