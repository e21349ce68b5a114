"""What both clients do without I/O: addresses and headers, when to retry, what events and responses mean."""

import email.utils
import json
import math
import os
import random
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC
from typing import Any, Literal, TypeAlias, TypeVar, cast, get_args
from urllib.parse import quote

import httpx
from httpx_sse import ServerSentEvent
from pydantic import BaseModel, ValidationError

from cow_service import __version__
from cow_service.client import errors
from cow_service.records import Job

R = TypeVar("R", bound=BaseModel)
DEFAULT_URL = "http://127.0.0.1:8000"
STREAM_TIMEOUT_SECONDS = 60.0  # of silence in a stream of events; the server sends something every 15
MAX_SERVER_WAIT_SECONDS = 10  # that the server holds one request for a result; then the job is polled
FIRST_POLL_SECONDS, POLL_GROWTH, MAX_POLL_SECONDS = 0.1, 1.5, 2.0  # between two requests for the state of a job
TIMEOUT_MARGIN_SECONDS = 1.0  # that a request may go on after the caller's timeout
CANCEL_TIMEOUT_SECONDS = 5.0  # for each of the two requests that cancel the job of a caller who has left
JOBS_PER_PAGE = 100
MAX_FIRST_ATTEMPTS = 3  # connections refused by a server that has never answered
OK, ACCEPTED, NO_CONTENT, NOT_FOUND = 200, 202, 204, 404
_KEY = re.compile(r"[\x21-\x7e]+")


@dataclass(frozen=True)
class Endpoint:
    """A server: address, key and timeouts."""

    base_url: str
    api_key: str | None
    timeout: httpx.Timeout

    def server_wait(self, timeout: float | None) -> int:
        """Seconds that the server may hold a request for a result (`Prefer: wait`): well within the read timeout."""
        read = self.timeout.read
        longest = MAX_SERVER_WAIT_SECONDS if read is None else min(MAX_SERVER_WAIT_SECONDS, int(read / 2))
        return longest if timeout is None else min(longest, int(timeout))

    @property
    def stream_timeout(self) -> httpx.Timeout:
        """Timeouts of a stream of events, in which the server may be silent for longer."""
        return httpx.Timeout(**{**self.timeout.as_dict(), "read": STREAM_TIMEOUT_SECONDS})

    def limited(self, seconds: float | None) -> httpx.Timeout:
        """Timeouts of a request, each limited to a number of seconds."""
        if seconds is None:
            return self.timeout
        limits = self.timeout.as_dict().items()
        return httpx.Timeout(**{name: seconds if limit is None else min(limit, seconds) for name, limit in limits})

    def headers(self, headers: Mapping[str, str]) -> dict[str, str]:
        """The headers of a request: its own, and those of every request."""
        authorization = {} if self.api_key is None else {"Authorization": f"Bearer {self.api_key}"}
        agent = {"User-Agent": f"cow-service/{__version__}", "Accept": "application/json, */*"}
        return {**agent, **headers, **authorization}


def endpoint_of(base_url: str | None, api_key: str | None, timeout: float | httpx.Timeout | None) -> Endpoint:
    """The server of these arguments, else of COW_BASE_URL and COW_API_KEY, else the one on this machine.

    Raises `ValueError` for what is no address, and for what is no key.
    """
    address = (base_url or os.environ.get("COW_BASE_URL") or DEFAULT_URL).rstrip("/")
    if not address.startswith(("http://", "https://")):
        raise ValueError(f"base_url must begin with http:// or https://, got {address!r}")
    try:
        url = httpx.URL(address)
    except httpx.InvalidURL as error:
        raise ValueError(f"base_url {address!r} is no address: {error}") from error
    if not url.host or "%" in url.host or not 0 < (url.port or 80) < 65536 or url.query or url.fragment:
        raise ValueError(f"base_url must be a host, maybe a port and a path, and nothing else, got {address!r}")
    key = (os.environ.get("COW_API_KEY") if api_key is None else api_key) or None  # empty: none, whatever is set
    if key is not None and not _KEY.fullmatch(key):
        raise ValueError("api_key must be printable ASCII without spaces; has a line break been read with it?")
    limit = timeout if isinstance(timeout, httpx.Timeout) else httpx.Timeout(timeout, connect=min(10, timeout or 10))
    return Endpoint(address, key, limit)


MAX_RETRY_AFTER_SECONDS = 60.0  # a server that asks for more is asked again after this time
FIRST_BACKOFF_SECONDS, BACKOFF_GROWTH, MAX_BACKOFF_SECONDS = 0.5, 2.0, 8.0  # without a Retry-After
# Refusals before a job is made. What a job has failed with is final: the same key would return it again.
RETRYABLE = (errors.QueueFull, errors.RateLimited, errors.ShuttingDown, errors.NotReady, errors.BodyTooSlow)
RETRYABLE_CODES = frozenset(kind.code for kind in RETRYABLE)
RETRYABLE_STATUS = frozenset({408, 425, 429, 502, 503, 504})  # of a proxy in front of the server
_BROKEN_CONNECTION = (httpx.NetworkError, httpx.TimeoutException, httpx.RemoteProtocolError)


def pause_before_retry(outcome: httpx.Response | httpx.HTTPError, attempts: int) -> float | None:
    """Seconds to wait after a number of attempts; None if another would have the same outcome."""
    if not is_refusal(outcome):
        return None
    if isinstance(outcome, httpx.Response) and (seconds := retry_after(outcome)) is not None:
        return min(seconds, MAX_RETRY_AFTER_SECONDS) + random.uniform(0, 0.25)
    pause = min(FIRST_BACKOFF_SECONDS * BACKOFF_GROWTH ** (attempts - 1), MAX_BACKOFF_SECONDS)
    return pause * random.uniform(0.75, 1.25)


def is_refusal(outcome: httpx.Response | httpx.HTTPError) -> bool:
    """Whether the server has not taken a request, and may take it later."""
    if isinstance(outcome, httpx.HTTPError):
        return isinstance(outcome, _BROKEN_CONNECTION)
    code = errors.code_of(outcome)
    return code in RETRYABLE_CODES if code is not None else outcome.status_code in RETRYABLE_STATUS


def retry_after(response: httpx.Response) -> float | None:
    """The header `Retry-After`, a number or a date (RFC 9110), as seconds from now."""
    header = response.headers.get("retry-after", "")
    if header.isascii() and header.isdecimal():
        return float(header)
    try:
        date = email.utils.parsedate_to_datetime(header)
    except ValueError:
        return None
    # Without a zone it is the old asctime form, which is in GMT as well.
    return max(0.0, (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp() - time.time())


EventName: TypeAlias = Literal["queued", "running", "stage", "progress", "succeeded", "failed", "canceled", "deleted"]
FINAL: frozenset[str] = frozenset({"succeeded", "failed", "canceled", "deleted"})


@dataclass(frozen=True)
class Event:
    """One thing that happened to a job.

    `number` is the same however often events are read, and None for `progress`, which is not repeated. `job` is the
    job as it then was, without its result; None if it was deleted.
    """

    name: EventName
    number: int | None
    job: Job | None


def event_in(sent: ServerSentEvent) -> Event | None:
    """The event that was sent; None for one whose kind this version does not know.

    Raises `BadResponse` for one that cannot be read.
    """
    if sent.event not in get_args(EventName):
        return None
    name = cast("EventName", sent.event)
    # An event without an id of its own repeats the last one (the HTML standard's rule).
    number = int(sent.id) if name != "progress" and sent.id.isdecimal() else None
    try:
        body = json.loads(sent.data)
    except ValueError:
        body = sent.data
    job = read(Job, {**body, "result": None} if isinstance(body, dict) else body) if body != {} else None
    return Event(name, number, job)


def pause_before_reconnect(outcome: httpx.Response | httpx.HTTPError, attempts: int, retries: int) -> float:
    """Seconds before a stream of events is opened again that broke, was refused or ended before the job.

    Raises the error for which it is not.
    """
    if isinstance(outcome, httpx.Response) and is_event_stream(outcome):
        outcome = httpx.RemoteProtocolError("the stream ended before the job", request=outcome.request)
    pause = pause_before_retry(outcome, attempts) if attempts <= retries else None
    if pause is not None:
        return pause
    if isinstance(outcome, httpx.Response):
        raise errors.error_of(outcome)
    raise errors.unreachable(outcome) from outcome


def is_event_stream(response: httpx.Response) -> bool:
    """Whether a response is a stream of events."""
    media_type = response.headers.get("content-type", "").partition(";")[0].strip().lower()
    return response.status_code == OK and media_type == "text/event-stream"


def read(model: type[R], body: Any) -> R:
    """A record from JSON. Fields that only a later version of the server knows are left out."""
    try:
        return model.model_validate(body, extra="ignore", strict=False)
    except ValidationError as error:
        wrong = error.errors()[0]
        place = ".".join(str(part) for part in wrong["loc"])
        raise errors.BadResponse(
            f"The response is no {model.__name__} that this version reads ({place}: {wrong['msg']}): are server and "
            "SDK of the same version?"
        ) from error


def object_in(response: httpx.Response) -> dict[str, Any]:
    """The JSON object that a response holds."""
    try:
        body = response.json()
    except ValueError:
        body = None
    if not isinstance(body, dict):
        raise errors.error_of(response)
    return body


def job_in(response: httpx.Response) -> Job:
    """The job that a response holds, without its result: that is read where its kind is known."""
    return read(Job, {**object_in(response), "result": None})


def result_in(response: httpx.Response, job: Job) -> Any:
    """The result that the response to a request for an ended job holds. Raises what the job failed with."""
    body = object_in(response)
    if job.status == "succeeded":
        return body.get("result") or {}
    error: errors.CowError = errors.Canceled(f"The job {job.id} was canceled.")
    if job.status == "failed":
        error = errors.error_from(body.get("problem") or {})
    raise errors.with_request_id(error, response)


def deadline(timeout: float | None) -> float:
    """When a time in seconds will have passed, on the monotonic clock; never without one."""
    return math.inf if timeout is None else time.monotonic() + timeout


def job_path(job_id: str) -> str:
    """The path of a job on its server."""
    return f"/jobs/{quote(job_id, safe='')}"
