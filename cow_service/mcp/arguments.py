"""Arguments of the tools: fields of the service's requests, flat, because models fill in flat arguments best.

`requests.flat` has their names, the request models all else; the server checks the values.
"""

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import urlsplit
from urllib.request import url2pathname

from cow_service.client import CowError, ImageLike
from cow_service.errors import FieldError, InvalidRequest
from cow_service.media.artifacts import media_type_of
from cow_service.records import JobKind
from cow_service.requests import ImageArtifact
from cow_service.requests.flat import FLAT, flat_fields, put

ToolName: TypeAlias = JobKind
# Arguments that stand deeper in a request. Every other argument is the field of its name.
NESTED = {each.argument: each.path for group in FLAT.values() for each in group if each.argument and "/" in each.path}
# What the things in a list are described by.
_MEMBERS = {"objects": ("object", "bbox"), "place": ("object", "relation", "targets")}
_CHANGES = {
    "remove": "Objects to take away before anything moves, in words.",
    "place": "Objects to put somewhere: before anything else moves, or as the whole motion.",
}
# `simulate` is for a caller who looks at the pictures.
DEFAULTS: dict[ToolName, dict[str, Any]] = {"simulate": {"video": False}, "answer": {}}


def input_schema(tool: ToolName, image: str) -> dict[str, Any]:
    """The JSON schema of a tool's arguments; `image` says how an image may be given."""
    properties: dict[str, Any] = {"image": {"type": "string", "description": image}}
    properties |= {field.argument: schema for field, schema in flat_fields(tool).items() if field.argument}
    for name, members in _MEMBERS.items():
        known = properties[name]["items"]["properties"]
        item = {"type": "object", "properties": {each: known[each] for each in members}, "required": list(members)}
        properties[name] = {**properties[name], "items": item}
    for name, description in _CHANGES.items():
        items = properties[name]["items"] if name in _MEMBERS else {"type": "string"}
        properties[name] = {"type": "array", "items": items, "description": description}
    for name, default in DEFAULTS[tool].items():
        properties[name] = {**properties[name], "default": default}
    required = ["image", "question"]
    return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}


def request_fields(tool: ToolName, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The request for the arguments of a call. Null is the same as leaving an argument out.

    Raises `InvalidRequest` for an unknown argument, and where `image` or `question` is missing.
    """
    known = input_schema(tool, "")["properties"]
    unknown = [name for name in arguments if name not in known]
    if unknown:
        named = [name if (own := _argument_at(name)) == name else f"{name} (instead: {own})" for name in unknown]
        raise InvalidRequest(f"No argument of this tool: {', '.join(named)}. It takes: {', '.join(known)}.")
    missing = [name for name in ("image", "question") if not isinstance(arguments.get(name), str)]
    if missing:
        faults = tuple(FieldError(f"/{name}", "is required, as text") for name in missing)
        raise InvalidRequest("The arguments of the tool are not valid.", errors=faults)
    request: dict[str, Any] = {}
    given = DEFAULTS[tool] | {name: value for name, value in arguments.items() if value is not None}
    for name, argument in given.items():
        value = argument
        if isinstance(argument, str) and known[name].get("type") != "string":
            with suppress(ValueError):  # some clients write lists and numbers as JSON in a string
                value = json.loads(argument)
        if name not in _CHANGES:
            put(request, NESTED.get(name, name), value)
        elif value != []:  # models fill in empty lists: the question's changes stay
            put(request, "interventions", _changes(name, value))
    return request


def _changes(kind: str, value: Any) -> list[Any]:
    """The interventions of a kind that an argument lists, or is the only one of."""
    things = value if isinstance(value, list) else [value]
    changes = ({"object": thing} if kind == "remove" else thing for thing in things)
    return [{"kind": kind, **change} if isinstance(change, Mapping) else change for change in changes]


ARTIFACTS = "cow://artifacts/"
_KEPT = "the 64-digit sha256 of the `image` in an earlier result, to ask about that image again without sending it"
HELP_WITH_PATHS = f"The image: the absolute path of a PNG, JPEG or WebP file, a data URL, an http(s) URL, or {_KEPT}."
HELP_WITHOUT_PATHS = (
    f"The image (PNG, JPEG or WebP): a data URL (data:image/png;base64,...), an http(s) URL, or {_KEPT}. A path is not "
    "accepted: this server does not read files."
)
_DIGEST = re.compile(rf"(?:{ARTIFACTS})?([0-9a-f]{{64}})", re.IGNORECASE | re.ASCII)
_SCHEME = re.compile(r"(data:|[a-z][a-z0-9+.-]*://)", re.IGNORECASE | re.ASCII)
_SENT_AS_IS = ("data:", "http://", "https://")
MAX_FILE_BYTES = 100_000_000  # servers take less
_SIGNATURE_BYTES = 12  # that tell what a file is
_MAX_SHOWN = 200  # characters of the caller's text in an error


def image_of(text: str, *, paths: bool) -> ImageLike:
    """The image as the SDK takes it. A path is read, if `paths` allows it.

    Raises `InvalidRequest`, also for a file that is not an image: no other file leaves the machine.
    """
    text = text.strip()
    if digest := digest_of(text):
        return ImageArtifact(artifact=digest)
    scheme = found[0].lower() if (found := _SCHEME.match(text)) else None
    if scheme in _SENT_AS_IS:
        return scheme + text[len(scheme) :]
    if not paths:
        raise _wrong(f"{_shown(text)} is not a data URL, http(s) URL or SHA-256 digest; this server reads no files")
    if scheme not in (None, "file://"):
        raise _wrong(f"{_shown(text)} cannot be opened: give a path, a data URL, an http(s) URL or a digest")
    path = Path(url2pathname(urlsplit(text).path)) if scheme else Path(text)
    try:
        path = path.expanduser().absolute()
        if not path.is_file():  # devices and pipes may never end
            raise _wrong(f"there is no file {_shown(str(path))}; give an absolute path")
        with path.open("rb") as file:
            head = file.read(_SIGNATURE_BYTES)
            if media_type_of(head) not in ("image/png", "image/jpeg", "image/webp"):
                raise _wrong(f"{_shown(str(path))} is not a PNG, JPEG or WebP file")
            rest = file.read(MAX_FILE_BYTES)
    except (OSError, RuntimeError, ValueError) as error:  # no home folder; NUL in the name
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise _wrong(f"{_shown(str(path))} cannot be read: {why or type(error).__name__}") from error
    if len(head) + len(rest) > MAX_FILE_BYTES:
        raise _wrong(f"{_shown(str(path))} is larger than {MAX_FILE_BYTES // 1_000_000} MB")
    return head + rest


def digest_of(text: str) -> str | None:
    """The SHA-256 digest in a text, by itself or in the URI of a resource; None if there is none."""
    found = _DIGEST.fullmatch(text)
    return found and found[1].lower()


def _shown(text: str) -> str:
    return repr(text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}...")


def _wrong(detail: str) -> InvalidRequest:
    return InvalidRequest("The image cannot be used.", errors=(FieldError("/image", detail),))


_GIVE_PLACE = (
    "Look at the image and call again with `bbox` [x0, y0, x1, y1] or `point` [x, y] of the moving object, in pixels "
    "of the image, and its name as `object`. List the other objects of the question in `objects`, each with `object` "
    "and `bbox`."
)
_RETRY_LATER = "Call again in a while, with the same arguments."
REMEDIES = {
    **dict.fromkeys(("cannot-ground", "object-not-found"), _GIVE_PLACE),
    "cannot-read-direction": "Call again with `direction` [dx, dy] (x right, y down; [-1, 0] is to the left), or with "
    '`motion_kind` "fall" if the object is dropped.',
    "artifact-not-found": "Send the image itself: the server has no image with that digest for you.",
    "image-url-not-allowed": "Give the image itself instead of its URL. COW_ALLOW_IMAGE_URLS on the server sets which "
    "hosts it fetches images from.",
    "image-url-unreachable": "Check the URL, or give the image itself.",
    "unauthorized": "Whoever set up this tool must give it a valid key: COW_API_KEY in the environment of `cow mcp`, "
    "or the header `Authorization: Bearer <key>` for MCP over HTTP.",
    **dict.fromkeys(("queue-full", "rate-limited", "shutting-down", "not-ready"), _RETRY_LATER),
    "mllm-unavailable": "Call again in a while, or with another `reader` ('embedded' needs no model).",
    "mllm-refused": "The same call would be rejected again: change the image or the question, or name another "
    "`reader`.",
    "canceled": "The job was canceled. Call again if you still want it.",
}


def error_text(error: CowError) -> str:
    """An error as text that helps a model to correct its call: the code, what was wrong, and what to do."""
    lines = [f"{error.code}: {error.title}"]
    # The detail repeats the fields under the names of HTTP requests, so it is shown only without fields.
    lines += [f"- {_argument_at(field.pointer)}: {field.detail}" for field in error.errors] or [error.detail]
    if error.code in REMEDIES:
        lines.append(f"What to do: {REMEDIES[error.code]}")
    if error.request_id is not None:
        lines.append(f"(request id {error.request_id})")
    return "\n".join(lines)


def _argument_at(pointer: str) -> str:
    """The argument of a tool for a JSON Pointer into the service's request."""
    path = pointer.lstrip("/")
    for name, known in NESTED.items():
        if path == known or path.startswith(f"{known}/"):
            return name + path.removeprefix(known)
    of_record = [f"`{name}`" for name, known in NESTED.items() if path and known.startswith(f"{path}/")]
    return ", ".join(of_record) or path or "arguments"
