"""What calls raise: the server's own errors, one class for each code, and those of the connection.

    CowError                        everything here
    ├── (cow_service.errors)        one class for each problem code: CannotGround, QueueFull, Unauthorized...
    ├── ServerUnreachable           no connection, or it broke, more often than `retries`
    ├── WaitTimeout                 a job had not ended in time; it goes on, and `job_id` names it
    └── BadResponse                 not a response of COW: a proxy's page, a damaged artifact

Each has `code`, `status` (0 where it is not the server's), `detail` (what was wrong, with the value, and what to do),
`errors` (a JSON Pointer for each invalid field) and `request_id` (by which the server's log knows the request).
"""

from __future__ import annotations

import json
from typing import Any

import httpx

from cow_service.errors import *  # noqa: F403 - each class can be imported from here, too
from cow_service.errors import CowError, FieldError, kinds

MAX_BODY_SHOWN = 200  # characters of a response that is not COW's


class ServerUnreachable(CowError):
    """The server could not be reached."""

    code, status = "server-unreachable", 0


class WaitTimeout(CowError):
    """The job had not ended in time."""

    code, status = "wait-timeout", 0

    job_id = ""

    @classmethod
    def of(cls, job_id: str, timeout: float) -> WaitTimeout:
        """The error of a wait for a job."""
        error = cls(f"The job {job_id} had not ended within {timeout:g} s. It goes on: wait again.")
        error.job_id = job_id
        return error


class BadResponse(CowError):
    """The response is not one of COW's."""

    code, status = "bad-response", 0


_OWN: dict[str, type[CowError]] = {kind.code: kind for kind in (ServerUnreachable, WaitTimeout, BadResponse)}


def unreachable(error: httpx.HTTPError, base_url: str | None = None) -> ServerUnreachable | BadResponse:
    """The error of a request without a response, or with one that cannot be decoded.

    With the server's address it says where a redirect pointed elsewhere.
    """
    sent, url = error.request, error.request.url
    request = f"{sent.method} {url.scheme}://{url.netloc.decode()}{url.path}: {str(error) or type(error).__name__}."
    if isinstance(error, httpx.DecodingError):
        return BadResponse(f"{request} Does a proxy stand between?")
    server = url if base_url is None else httpx.URL(base_url)
    if (url.scheme, url.host, url.port) != (server.scheme, server.host, server.port):
        return ServerUnreachable(
            f"{request} The server keeps its artifacts there. Where callers cannot reach that place, the server must "
            "pass them on (COW_ARTIFACTS_REDIRECT=false)."
        )
    return ServerUnreachable(f"{request} Is the server running (`cow serve`), and is this its address (COW_BASE_URL)?")


def error_of(response: httpx.Response) -> CowError:
    """The error that a response holds; its body has been read."""
    problem = _problem(response)
    if problem is None:
        body = " ".join(response.text.split())
        moved = response.headers.get("location")
        error: CowError = BadResponse(
            f"{response.request.method} {response.url.path} was answered with {response.status_code} "
            f"{response.reason_phrase}, and with nothing of COW's: {body[:MAX_BODY_SHOWN] or 'no body'}. "
            + (f"It points to {moved}: is that its address (COW_BASE_URL)?" if moved else "Does a proxy stand between?")
        )
        error.status = response.status_code
    else:
        error = error_from(problem, response.headers)
    return with_request_id(error, response)


def with_request_id(error: CowError, response: httpx.Response) -> CowError:
    """The same error, with the id of its request in the server's log; tracebacks show it."""
    error.request_id = response.headers.get("x-request-id")
    if error.request_id is not None:
        error.add_note(f"request id: {error.request_id}")
    return error


def error_from(problem: dict[str, Any], headers: httpx.Headers | None = None) -> CowError:
    """The error that a problem (RFC 9457) is. A code of a later version than this comes as a plain `CowError`."""
    code = _code(problem)
    given = problem.get("errors")
    fields = [field for field in given if isinstance(field, dict)] if isinstance(given, list) else []
    error = (kinds() | _OWN).get(code, CowError)(
        str(problem.get("detail") or problem.get("title") or ""),
        remedy=str(problem.get("remedy") or ""),
        errors=tuple(FieldError(str(field.get("pointer", "")), str(field.get("detail", ""))) for field in fields),
        headers=dict(headers or {}),
    )
    error.code = code or error.code
    for name, kind in (("usage", dict), ("refusal", dict), ("status", int)):
        if isinstance(value := problem.get(name), kind):
            setattr(error, name, value)
    return error


def code_of(response: httpx.Response) -> str | None:
    """The problem code of a response; None if it has none."""
    problem = _problem(response)
    return None if problem is None else _code(problem)


def _code(problem: dict[str, Any]) -> str:
    return str(problem.get("type", "")).rpartition(":")[2]


def _problem(response: httpx.Response) -> dict[str, Any] | None:
    """The problem that a response holds; its body has been read."""
    if not response.headers.get("content-type", "").lower().startswith("application/problem+json"):
        return None
    try:
        body = json.loads(response.content)
    except ValueError:
        return None
    return body if isinstance(body, dict) else None
