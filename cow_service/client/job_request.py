"""Requests for simulations and answers, as they are sent."""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import httpx

from cow_service.client.inputs import ImageLike, Reference, Upload, image_input
from cow_service.client.request_fields import request_fields
from cow_service.client.serialization import to_json
from cow_service.client.steps import Send
from cow_service.errors import FieldError, InvalidRequest
from cow_service.records import JobKind

MINIMAL = "return=minimal"  # the preference of RFC 7240
_KEY = re.compile(r"[\x21-\x7e]{1,255}")


@dataclass(frozen=True)
class JobRequest:
    """A request for a simulation or an answer: the same bytes and idempotency key in every attempt."""

    kind: JobKind
    content: bytes
    media_type: str
    key: str
    fresh: bool = False
    minimal: bool = False  # the result without its long lists

    def send(self, prefer: str, limit: float | None = None) -> Send:
        """The step that sends it."""
        headers = {"Idempotency-Key": self.key, "Prefer": f"{prefer}, {MINIMAL}" if self.minimal else prefer}
        if self.fresh:
            headers["Cache-Control"] = "no-cache"
        return Send("POST", f"/{self.kind}", headers, {}, self.content, self.media_type, limit)


def job_request(
    kind: JobKind,
    image: ImageLike,
    question: str,
    options: Mapping[str, Any],
    key: str | None,
    fresh: bool,
    minimal: bool = False,
) -> JobRequest:
    """A request for work; without a key it gets a random one.

    Raises what `image_input` and `request_fields` do, and `InvalidRequest` for a key that no header can hold and for
    text that is none.
    """
    if key is not None and not _KEY.fullmatch(key):
        detail = "takes 1 to 255 printable ASCII characters without spaces"
        raise InvalidRequest(f"`idempotency_key` {detail}, got {key[:80]!r}.", errors=(FieldError("", detail),))
    sent = image_input(image)
    rest = request_fields(options)
    try:
        content, media_type = _body_of(sent, question, rest)
    except UnicodeEncodeError as error:
        detail = f"holds half of a surrogate pair ({error.object[error.start]!r}), which is no text"
        raise InvalidRequest(f"The request {detail}.", errors=(FieldError("", detail),)) from error
    return JobRequest(kind, content, media_type, key or secrets.token_urlsafe(18), fresh, minimal)


def _body_of(sent: Upload | Reference, question: str, rest: Mapping[str, Any]) -> tuple[bytes, str]:
    if isinstance(sent, Reference):
        return to_json({**rest, "image": sent.json, "question": question}), "application/json"
    boundary = hashlib.sha256(sent.data).hexdigest()[:32]  # the same in every attempt, and nothing the image holds
    form = httpx.Request(
        "POST",
        "http://form",
        files={"image": ("image", sent.data, "application/octet-stream")},
        data={"question": question, "request": to_json(rest).decode()},
        headers={"Content-Type": f"multipart/form-data; boundary={boundary}"},
    )
    return form.read(), form.headers["content-type"]
