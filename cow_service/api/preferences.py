"""Request headers that say how to answer: `Prefer` (RFC 7240), `Idempotency-Key`, `Cache-Control`."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from typing import Any

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


LEFT_OUT = ("states", "scale", "rotation", "band", "futures", "tracks", "tracks_visible")  # of `Path`, all per frame
SEPARATORS = (",", ":")


def minimal_result(result: str) -> str:
    """A `Simulation` or an `Answer`, as JSON, without the lists. CPU work: not for the event loop."""
    return _written(_without_lists(json.loads(result)))


def minimal_job(job: str) -> str:
    """A `Job`, as JSON, the same with its result."""
    read: dict[str, Any] = json.loads(job)
    if read.get("result") is not None:
        _without_lists(read["result"])
    return _written(read)


def _without_lists(result: dict[str, Any]) -> dict[str, Any]:
    simulation = result.get("simulation", result)  # that of an answer, which may be null
    trajectory = None if simulation is None else simulation["trajectory"]
    while trajectory is not None:
        for path in trajectory["paths"]:
            for name in LEFT_OUT:
                path.pop(name, None)
        trajectory = trajectory.get("factual")
    return result


def _written(value: dict[str, Any]) -> str:
    return json.dumps(value, separators=SEPARATORS, ensure_ascii=False)
