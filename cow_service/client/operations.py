"""What both clients do: which requests are sent, in which order, and what the responses mean."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any, ClassVar, TypeAlias
from urllib.parse import quote

import httpx

from cow_service.client.errors import (
    BadResponse,
    Canceled,
    ServerUnreachable,
    WaitTimeout,
    error_from,
    error_of,
    unreachable,
    with_request_id,
)
from cow_service.client.events import EventCursor
from cow_service.client.inputs import ImageLike
from cow_service.client.job_request import MINIMAL, JobRequest, job_request
from cow_service.client.models import Models
from cow_service.client.progress import ProgressLike, reporting
from cow_service.client.retries import pause_before_retry
from cow_service.client.serialization import job_in, object_in, plain, read
from cow_service.client.settings import endpoint_of
from cow_service.client.steps import Send, Shielded, Sleep, Steps
from cow_service.errors import CowError
from cow_service.records import TERMINAL, AcceptedRequest, Job, JobKind, JobPage, Workers

FIRST_POLL_SECONDS, POLL_GROWTH, MAX_POLL_SECONDS = 0.1, 1.5, 2.0  # between two requests for the state of a job
TIMEOUT_MARGIN_SECONDS = 1.0  # that a request may go on after the caller's timeout
CANCEL_TIMEOUT_SECONDS = 5.0  # for each of the two requests that cancel the job of a caller who has left
JOBS_PER_PAGE = 100
MAX_FIRST_ATTEMPTS = 3  # connections refused by a server that has never answered
ACCEPTED, NOT_FOUND = 202, 404

OnUpdate: TypeAlias = Callable[[Job], None]


class Operations:
    """The operations of a server, as steps. A connection performs them; it says what results and handles are made."""

    result_types: ClassVar[Mapping[JobKind, type[Any]]]
    handle_type: ClassVar[type[Any]]
    _http_type: ClassVar[type[Any]]

    def __init__(
        self,
        base_url: str | None,
        api_key: str | None,
        timeout: float | httpx.Timeout | None,
        retries: int,
        http: Any,
    ) -> None:
        self.endpoint = endpoint_of(base_url, api_key, timeout)
        self.retries = retries
        self._own_http = http is None
        self._http = self._http_type(limits=httpx.Limits(max_connections=None)) if http is None else http
        self._ever_answered = False
        self._refused = 0

    def run(self, steps: Steps[Any]) -> Any:
        """The result of steps, or a coroutine of it."""
        raise NotImplementedError

    def submit(
        self, kind: JobKind, image: ImageLike, question: str, options: Mapping[str, Any], key: str | None, fresh: bool
    ) -> Steps[Any]:
        """The handle of a new job."""
        request = job_request(kind, image, question, options, key, fresh)
        response = yield from self._exchange(request.send("respond-async"))
        return self.handle_type(self, job_in(response))

    def complete(
        self,
        kind: JobKind,
        image: ImageLike,
        question: str,
        options: Mapping[str, Any],
        timeout: float | None,
        progress: ProgressLike,
        key: str | None,
        fresh: bool,
        minimal: bool,
    ) -> Steps[Any]:
        """The result of a request. A caller who leaves in between cancels its job."""
        request = job_request(kind, image, question, options, key, fresh, minimal)
        server_wait = self.endpoint.server_wait(timeout) if progress is False else 0
        with reporting(progress) as on_update:
            return (yield from self.complete_request(request, server_wait, timeout, on_update))

    def complete_request(
        self,
        request: JobRequest,
        server_wait: int,
        timeout: float | None,
        on_update: OnUpdate | None,
        *,
        cancel_abandoned: bool = True,
    ) -> Steps[Any]:
        """The result of a request. The server waits for it `server_wait` seconds before the job is polled.

        Raises what the job failed with, and `WaitTimeout` after `timeout` seconds, all requests together. A caller who
        leaves in between cancels the job, unless `cancel_abandoned` is False.
        """
        until = _deadline(timeout)
        job_id: str | None = None
        try:
            send = request.send(f"wait={server_wait}" if server_wait > 0 else "respond-async")
            response = yield from self._exchange(send, until)
            if response.status_code != ACCEPTED:
                return self.result(request.kind, object_in(response))
            job_id = job_in(response).id
            return (yield from self._poll(job_id, timeout, until, on_update, request.minimal))
        except (CowError, GeneratorExit):
            raise
        except BaseException:
            if cancel_abandoned:
                yield Shielded(self._cancel_abandoned(request, job_id))
            raise

    def result(self, kind: JobKind, body: Any) -> Any:
        """The result that is this JSON; it downloads its pictures from here."""
        result = read(self.result_types[kind], body)
        result.bind(self)
        return result

    def job(self, job_id: str) -> Steps[Any]:
        """The handle of a job."""
        response = yield from self._exchange(Send("GET", _path(job_id)))
        return self.handle_type(self, job_in(response))

    def refresh(self, handle: Any) -> Steps[Job]:
        """The job as it is; the handle holds it."""
        handle.job = job_in((yield from self._exchange(Send("GET", _path(handle.id)))))
        return handle.job

    def request_of(self, handle: Any) -> Steps[AcceptedRequest]:
        """The request that became the job."""
        return read(AcceptedRequest, object_in((yield from self._exchange(Send("GET", f"{_path(handle.id)}/request")))))

    def cancel(self, handle: Any) -> Steps[Job]:
        """The canceled job; the handle holds it."""
        handle.job = yield from self.cancel_job(handle.id)
        return handle.job

    def cancel_job(self, job_id: str) -> Steps[Job]:
        """A job that was asked to end."""
        return job_in((yield from self._exchange(Send("POST", f"{_path(job_id)}/cancel"))))

    def delete(self, handle: Any) -> Steps[None]:
        """Removes a job and what only it holds."""
        yield from self._exchange(Send("DELETE", _path(handle.id)))

    def wait(self, handle: Any, timeout: float | None, progress: ProgressLike, minimal: bool) -> Steps[Any]:
        """The result of a job; the handle holds the job's last known state."""
        with reporting(progress) as report:

            def on_update(job: Job) -> None:
                handle.job = job
                if report is not None:
                    report(job)

            return (yield from self._poll(handle.id, timeout, _deadline(timeout), on_update, minimal))

    def page_of_jobs(self, filters: Mapping[str, Any], cursor: str | None) -> Steps[JobPage]:
        """Some jobs, and the cursor of the next ones."""
        given = {name: plain(value) for name, value in filters.items() if value is not None}
        params = {"limit": JOBS_PER_PAGE, **given, **({"cursor": cursor} if cursor else {})}
        return read(JobPage, object_in((yield from self._exchange(Send("GET", "/jobs", params=params)))))

    def artifact(self, sha256: str) -> Steps[bytes]:
        """The bytes of an artifact, checked against their digest."""
        response = yield from self._exchange(Send("GET", f"/artifacts/{quote(sha256, safe='')}", follow=True))
        if hashlib.sha256(response.content).hexdigest() != sha256:
            raise BadResponse(f"The artifact {sha256} came damaged ({len(response.content)} bytes): get it again.")
        return response.content

    def models(self) -> Steps[Models]:
        """What the server can do."""
        return read(Models, object_in((yield from self._exchange(Send("GET", "/models")))))

    def workers(self) -> Steps[Workers]:
        """What the processes on the job database do."""
        return read(Workers, object_in((yield from self._exchange(Send("GET", "/workers")))))

    def _exchange(self, send: Send, until: float | None = None, retries: int | None = None) -> Steps[httpx.Response]:
        """The response to a request, which is sent again where that may help (`retries.py`).

        No attempt begins after `until`, on the monotonic clock. Raises the error that the response holds (`errors.py`).
        """
        attempts = 0
        while True:
            if until is not None:
                send = replace(send, limit=max(until - time.monotonic(), 0) + TIMEOUT_MARGIN_SECONDS)
            outcome = yield send
            attempts += 1
            more = attempts <= (self.retries if retries is None else retries)
            pause = pause_before_retry(outcome, attempts) if more else None
            if pause is None or (until is not None and time.monotonic() + pause > until):
                break
            yield Sleep(pause)
        if isinstance(outcome, httpx.HTTPError):
            raise unreachable(outcome, self.endpoint.base_url) from outcome
        # What an earlier attempt deleted, whose response was lost, is gone.
        if send.method == "DELETE" and attempts > 1 and outcome.status_code == NOT_FOUND:
            return outcome
        if not outcome.is_success:
            raise error_of(outcome)
        return outcome

    def _poll(
        self, job_id: str, timeout: float | None, until: float | None, on_update: OnUpdate | None, minimal: bool
    ) -> Steps[Any]:
        """The result of a job, once it has ended. Raises what it failed with, and `WaitTimeout` after `until`."""
        pause = FIRST_POLL_SECONDS
        send = Send("GET", _path(job_id), {"Prefer": MINIMAL} if minimal else {})
        while True:
            response = yield from self._exchange(send, until)
            job = job_in(response)
            if on_update is not None:
                on_update(job)
            if job.status in TERMINAL:
                break
            rest = pause if until is None else until - time.monotonic()
            if rest <= 0:
                raise WaitTimeout.of(job_id, timeout or 0)
            yield Sleep(min(pause, rest))
            pause = min(pause * POLL_GROWTH, MAX_POLL_SECONDS)
        body = object_in(response)
        if job.status == "succeeded":
            return self.result(job.kind, body.get("result") or {})
        canceled = job.status == "canceled"
        error = Canceled(f"The job {job.id} was canceled.") if canceled else error_from(body.get("problem") or {})
        raise with_request_id(error, response)

    def _cancel_abandoned(self, request: JobRequest, job_id: str | None) -> Steps[None]:
        """Cancels the job of a caller who has left. Without retries: the server may be gone, too."""
        with suppress(Exception):
            if job_id is None:
                # Sent once more under the same key, the request returns the job that it has become, or becomes one now.
                again = request.send("respond-async", CANCEL_TIMEOUT_SECONDS)
                job_id = job_in((yield from self._exchange(again, retries=0))).id
            cancel = Send("POST", f"{_path(job_id)}/cancel", limit=CANCEL_TIMEOUT_SECONDS)
            yield from self._exchange(cancel, retries=0)

    def _arguments(self, send: Send) -> dict[str, Any]:
        """The arguments of `httpx.Client.request` for a step."""
        return {
            "method": send.method,
            "url": self.endpoint.base_url + send.path,
            "headers": self.endpoint.headers(send),
            "params": send.params,
            "content": send.content,
            "timeout": self.endpoint.limited(send.limit),
            **({"follow_redirects": True} if send.follow else {}),
        }

    def _stream_arguments(self, job_id: str, cursor: EventCursor) -> dict[str, Any]:
        """The arguments of `httpx.Client.stream` for the events of a job."""
        send = Send("GET", f"{_path(job_id)}/events", {"Accept": "text/event-stream", **cursor.headers})
        return self._arguments(send) | {"timeout": self.endpoint.stream_timeout}

    def _received(self, outcome: httpx.Response | httpx.HTTPError) -> httpx.Response | httpx.HTTPError:
        """What came of a request. Raises `ServerUnreachable` for a server that has refused the first few connections.

        Retries would only delay the message that no server is there.
        """
        if isinstance(outcome, httpx.Response):
            self._ever_answered = True
        elif isinstance(outcome, httpx.ConnectError):
            self._refused += 1
            if not self._ever_answered and self._refused >= MAX_FIRST_ATTEMPTS:
                raise unreachable(outcome, self.endpoint.base_url) from outcome
        return outcome


def closed() -> ServerUnreachable:
    """The error of a call of a closed client, such as for a picture that was not downloaded before."""
    return ServerUnreachable("The client is closed. Call `load()` or `save()` on results before that.")


def _deadline(timeout: float | None) -> float | None:
    return None if timeout is None else time.monotonic() + timeout


def _path(job_id: str) -> str:
    return f"/jobs/{quote(job_id, safe='')}"
