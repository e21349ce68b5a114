"""Every call, without the doing: what is sent, in which order, and what the responses mean.

A call is a generator: it yields what is to be done next (`Send`, `Pause`) and is sent what came of it. `sync.py` and
`aio.py` do it, each in its own way, so that both behave the same.
"""

from __future__ import annotations

import hashlib
import json
import re
import secrets
import time
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel, ValidationError

from cow_service.client.errors import BadResponse, Canceled, WaitTimeout, error_from, error_of, known_by, unreachable
from cow_service.client.inputs import ImageLike, Reference, Upload, image_input
from cow_service.client.retries import pause_before_retry
from cow_service.errors import FieldError, InvalidRequest
from cow_service.records import TERMINAL, Job, JobKind, JobPage, Models

FIRST_LOOK, GROWTH, SLOWEST_LOOK = 0.1, 1.5, 2.0  # seconds between two looks at a job
PATIENCE = 10  # seconds that one request waits for a job; after that, looks at it do not hang on one connection
AFTER = 1.0  # seconds that a request may go on after the caller's time is over
LEAVING = 5.0  # seconds for each of the two requests that end the job of a caller who does not want it any more
PAGE = 100  # jobs
ACCEPTED, NOT_FOUND = 202, 404

_KEY = re.compile(r"[\x21-\x7e]{1,255}")

T = TypeVar("T")
R = TypeVar("R", bound=BaseModel)
Tell: TypeAlias = Callable[[Job], None]


@dataclass(frozen=True)
class Send:
    """A request to be sent. `limit` is how many seconds the server may say nothing, where that is less than else."""

    method: str
    path: str
    headers: Mapping[str, str] = field(default_factory=dict[str, str])
    params: Mapping[str, Any] = field(default_factory=dict[str, Any])
    content: bytes | None = None
    media_type: str | None = None
    limit: float | None = None


@dataclass(frozen=True)
class Pause:
    """Seconds to do nothing."""

    seconds: float


Steps: TypeAlias = Generator[Send | Pause, httpx.Response | httpx.HTTPError | None, T]


def exchange(send: Send, retries: int, until: float | None = None) -> Steps[httpx.Response]:
    """The response to a request, which is sent again where that may help.

    That ends at `until`, on the monotonic clock. Raises what the response tells (`errors.py`).
    """
    tried = 0
    while True:
        outcome = yield send if until is None else replace(send, limit=max(until - time.monotonic(), 0) + AFTER)
        assert outcome is not None
        tried += 1
        pause = pause_before_retry(outcome, tried) if tried <= retries else None
        if pause is None or (until is not None and time.monotonic() + pause > until):
            break
        yield Pause(pause)
    if isinstance(outcome, httpx.HTTPError):
        raise unreachable(outcome) from outcome
    # What an earlier try deleted, whose response was lost, is not there any more.
    if send.method == "DELETE" and tried > 1 and outcome.status_code == NOT_FOUND:
        return outcome
    if not outcome.is_success:
        raise error_of(outcome)
    return outcome


@dataclass(frozen=True)
class Order:
    """A request for work, as it is sent however often."""

    kind: JobKind
    content: bytes
    media_type: str
    key: str
    fresh: bool = False

    def send(self, prefer: str, limit: float | None = None) -> Send:
        """The request that hands it in."""
        headers = {"Idempotency-Key": self.key, "Prefer": prefer}
        if self.fresh:
            headers["Cache-Control"] = "no-cache"
        return Send("POST", f"/{self.kind}", headers, {}, self.content, self.media_type, limit)


@dataclass
class Placed:
    """An order, and the id of its job once a response has told it."""

    order: Order
    job_id: str | None = None


def order_of(
    kind: JobKind, image: ImageLike, question: str, options: Mapping[str, Any], key: str | None, fresh: bool
) -> Order:
    """A request for work; without a key it gets one of its own.

    Raises what `image_input` does, and `InvalidRequest` for a key that no header can hold and for text that is none.
    """
    if key is not None and not _KEY.fullmatch(key):
        detail = "takes 1 to 255 printable ASCII characters without spaces"
        raise InvalidRequest(f"`idempotency_key` {detail}, got {key[:80]!r}.", errors=(FieldError("", detail),))
    sent = image_input(image)
    rest = {name: value for name, value in options.items() if value is not None}
    try:
        content, media_type = _body_of(sent, question, rest)
    except UnicodeEncodeError as error:
        detail = f"holds half of a surrogate pair ({error.object[error.start]!r}), which is no text"
        raise InvalidRequest(f"The request {detail}.", errors=(FieldError("", detail),)) from error
    return Order(kind, content, media_type, key or secrets.token_urlsafe(18), fresh)


def _body_of(sent: Upload | Reference, question: str, rest: Mapping[str, Any]) -> tuple[bytes, str]:
    if isinstance(sent, Reference):
        return to_json({**rest, "image": sent.json, "question": question}), "application/json"
    boundary = hashlib.sha256(sent.data).hexdigest()[:32]  # the same in every try, and nothing that the image holds
    form = httpx.Request(
        "POST",
        "http://form",
        files={"image": ("image", sent.data, "application/octet-stream")},
        data={"question": question, "request": to_json(rest).decode()},
        headers={"Content-Type": f"multipart/form-data; boundary={boundary}"},
    )
    return form.read(), form.headers["content-type"]


def submitted(order: Order, retries: int) -> Steps[Job]:
    """The job that an order becomes."""
    return job_in((yield from exchange(order.send("respond-async"), retries)))


def done(
    placed: Placed, patience: int, timeout: float | None, tell: Tell | None, retries: int
) -> Steps[dict[str, Any]]:
    """The result of an order as JSON. The first request waits for it for `patience` seconds.

    Raises what it failed with, and `WaitTimeout` after `timeout` seconds, all requests together.
    """
    until = deadline(timeout)
    send = placed.order.send(f"wait={patience}" if patience > 0 else "respond-async")
    response = yield from exchange(send, retries, until)
    if response.status_code != ACCEPTED:
        return object_in(response)
    placed.job_id = job_in(response).id
    return (yield from awaited(placed.job_id, timeout, until, tell, retries))


def withdrawn(placed: Placed) -> Steps[None]:
    """Ends the job of an order that nobody waits for any more. Soon: whoever leaves may leave a dead server."""
    if placed.job_id is None:
        # Handed in once more under the same key, the order tells the job that it has become, or becomes, unnoticed.
        response = yield from exchange(placed.order.send("respond-async", LEAVING), retries=0)
        placed.job_id = job_in(response).id
    yield from exchange(Send("POST", f"{_path(placed.job_id)}/cancel", limit=LEAVING), retries=0)


def deadline(timeout: float | None) -> float | None:
    """When so many seconds from now are over, on the monotonic clock."""
    return None if timeout is None else time.monotonic() + timeout


def looked_at(job_id: str, retries: int, until: float | None = None) -> Steps[httpx.Response]:
    """The response that tells of a job."""
    return (yield from exchange(Send("GET", _path(job_id)), retries, until))


def events_of(job_id: str) -> Send:
    """The request that follows a job."""
    return Send("GET", f"{_path(job_id)}/events", {"Accept": "text/event-stream"})


def result_in(response: httpx.Response) -> dict[str, Any]:
    """The result, as JSON, of the job that a response tells of. Raises what it failed with."""
    job, body = job_in(response), object_in(response)
    if job.status == "succeeded":
        return body.get("result") or {}
    canceled = job.status == "canceled"
    error = Canceled(f"The job {job.id} was canceled.") if canceled else error_from(body.get("problem") or {})
    raise known_by(error, response)


def awaited(
    job_id: str, timeout: float | None, until: float | None, tell: Tell | None, retries: int
) -> Steps[dict[str, Any]]:
    """The result of a job as JSON, once it has ended. Raises what it failed with, and `WaitTimeout` after `until`."""
    pause = FIRST_LOOK
    while True:
        response = yield from looked_at(job_id, retries, until)
        job = job_in(response)
        if tell is not None:
            tell(job)
        if job.status in TERMINAL:
            return result_in(response)
        rest = pause if until is None else until - time.monotonic()
        if rest <= 0:
            raise WaitTimeout.of(job_id, timeout or 0)
        yield Pause(min(pause, rest))
        pause = min(pause * GROWTH, SLOWEST_LOOK)


def canceled(job_id: str, retries: int) -> Steps[Job]:
    """A job that was asked to end."""
    return job_in((yield from exchange(Send("POST", f"{_path(job_id)}/cancel"), retries)))


def deleted(job_id: str, retries: int) -> Steps[None]:
    """Removes a job and what only it holds."""
    yield from exchange(Send("DELETE", _path(job_id)), retries)


def job_page(filters: Mapping[str, Any], cursor: str | None, retries: int) -> Steps[JobPage]:
    """Some jobs, and where the next ones are."""
    given = {name: _plain(value) for name, value in filters.items() if value is not None}
    params = {"limit": PAGE, **given, **({"cursor": cursor} if cursor else {})}
    return parsed(JobPage, (yield from exchange(Send("GET", "/jobs", params=params), retries)))


def artifact(sha256: str, retries: int) -> Steps[bytes]:
    """The bytes of an artifact, which are those of its name."""
    response = yield from exchange(Send("GET", f"/artifacts/{quote(sha256, safe='')}"), retries)
    if hashlib.sha256(response.content).hexdigest() != sha256:
        raise BadResponse(f"The artifact {sha256} came damaged ({len(response.content)} bytes): get it again.")
    return response.content


def models(retries: int) -> Steps[Models]:
    """What the server can do."""
    return parsed(Models, (yield from exchange(Send("GET", "/models"), retries)))


def _path(job_id: str) -> str:
    return f"/jobs/{quote(job_id, safe='')}"


def job_in(response: httpx.Response) -> Job:
    """The job that a response holds, without its result: that is read where its kind is known."""
    return read(Job, {**object_in(response), "result": None})


def parsed(model: type[R], response: httpx.Response) -> R:
    """The record that a response holds."""
    return read(model, object_in(response))


def read(model: type[R], body: Any) -> R:
    """A record from JSON. Fields that only a later version of the server knows are left out."""
    try:
        return model.model_validate(body, extra="ignore", strict=False)
    except ValidationError as error:
        wrong = error.errors()[0]
        place = ".".join(str(part) for part in wrong["loc"])
        raise BadResponse(
            f"The response is no {model.__name__} that this version reads ({place}: {wrong['msg']}): are server and "
            "SDK of the same version?"
        ) from error


def to_json(value: Any) -> bytes:
    """JSON of plain values, records and arrays."""
    return json.dumps(value, default=_plain, ensure_ascii=False, separators=(",", ":")).encode()


def _plain(value: Any) -> Any:
    """What JSON can hold of a record, an array or number of numpy's, or a time; tuples and lists stay."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_unset=True)
    if hasattr(value, "tolist"):
        return value.tolist()
    if hasattr(value, "isoformat"):
        return (value if value.tzinfo else value.astimezone()).isoformat()
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, list | tuple | str | int | float):
        return value
    raise TypeError(f"{type(value).__name__} cannot be sent; give plain values, records or arrays")


def object_in(response: httpx.Response) -> dict[str, Any]:
    """The JSON object that a response holds."""
    try:
        body = response.json()
    except ValueError:
        body = None
    if not isinstance(body, dict):
        raise error_of(response)
    return body
