"""Request headers that say how to answer: `Prefer` (RFC 7240), `Idempotency-Key`, `Cache-Control`."""

from __future__ import annotations

import re
from dataclasses import dataclass

from starlette.datastructures import Headers

from cow_service.errors import FieldError, InvalidRequest

MAX_WAIT_SECONDS = 600
_KEY = re.compile(r"[\x21-\x7e]{1,255}")


MINIMAL_APPLIED = {"Preference-Applied": "return=minimal"}


@dataclass(frozen=True)
class Preferences:
    """How a caller wants to be answered."""

    respond_async: bool = False
    wait: int | None = None  # seconds
    key: str | None = None  # the idempotency key
    fresh: bool = False  # no results of earlier requests
    minimal: bool = False  # results without their long lists

    @property
    def applied(self) -> str:
        """`Preference-Applied` of a response that is the job."""
        applied = ("respond-async",) if self.respond_async else ()
        return ", ".join(applied if self.wait is None else (*applied, f"wait={self.wait}"))


def preferences_of(headers: Headers) -> Preferences:
    """The preferences that a request's headers state; unknown ones are ignored, as RFC 7240 says.

    Raises `InvalidRequest` for an idempotency key that is none.
    """
    key = headers.get("idempotency-key")
    if key is not None and not _KEY.fullmatch(key):
        detail = "1 to 255 printable ASCII characters without spaces"
        raise InvalidRequest(f"The header `Idempotency-Key` takes {detail}.", errors=(FieldError("", detail),))
    stated: dict[str, str] = {}
    for item in ",".join(headers.getlist("prefer")).split(","):
        name, _, value = item.partition(";")[0].partition("=")
        stated.setdefault(name.strip().lower(), value.strip().strip('"'))  # the first of the same name counts
    wait = stated.get("wait", "")
    cached = {item.strip().lower() for item in headers.get("cache-control", "").split(",")}
    return Preferences(
        respond_async="respond-async" in stated,
        wait=min(int(wait), MAX_WAIT_SECONDS) if wait.isascii() and wait.isdigit() else None,
        key=key,
        fresh=bool(cached & {"no-cache", "no-store"}),
        minimal=stated.get("return", "").lower() == "minimal",
    )
