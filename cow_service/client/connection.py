"""A server and the way to it: requests with retries, jobs and their events, batches, and the artifacts of results.

All of it is written once, as coroutines. `AsyncClient` awaits them. `Client` runs them without an event loop: the
methods of its `BlockingIO` block where those of `AsyncIO` wait, so that each coroutine runs to its end at once.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import aclosing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias, TypeVar
from urllib.parse import quote

import httpx
from pydantic import BaseModel

from cow_service import records
from cow_service.client import errors, protocol
from cow_service.client.progress import ProgressLike, reporting
from cow_service.client.request import MINIMAL, JobRequest, job_request, plain

if TYPE_CHECKING:
    from cow_service.adaptive import AdaptiveLimit
    from cow_service.client.async_io import AsyncIO
    from cow_service.client.batches import Batch, BatchResult
    from cow_service.client.journal import Question
    from cow_service.client.sync_io import BlockingIO

M = TypeVar("M", bound=BaseModel)
LOOK_TIMEOUT = 2.0  # seconds, for what a batch's progress shows beside its numbers
OnUpdate: TypeAlias = Callable[[records.Job], None] | None


class Connection:
    """A server and what reaches it. `kinds` are the classes of results, `handle` that of jobs."""

    def __init__(
        self, endpoint: protocol.Endpoint, retries: int, io: AsyncIO | BlockingIO, kinds: Mapping[str, Any], handle: Any
    ) -> None:
        self.endpoint, self.retries, self.io = endpoint, retries, io
        self._kinds, self._handle = kinds, handle
        self._ever_answered = False
        self._refused = 0

    async def exchange(
        self,
        method: str,
        path: str,
        headers: Mapping[str, str] | None = None,
        *,
        until: float = math.inf,
        limit: float | None = None,
        retries: int | None = None,
        pace: AdaptiveLimit | None = None,
        **arguments: Any,
    ) -> httpx.Response:
        """The response to a request, which is sent again where that may help (`pause_before_retry`).

        No attempt begins after `until`, on the monotonic clock; `limit` is how long the server may say nothing, in
        seconds; `pace` is told of refusals. Raises the error that the response holds (`errors.py`).
        """
        url, headers = self.endpoint.base_url + path, self.endpoint.headers(headers or {})
        attempt = 0
        while True:
            attempt += 1
            if until < math.inf:
                limit = max(until - time.monotonic(), 0) + protocol.TIMEOUT_MARGIN_SECONDS
            timeout = self.endpoint.limited(limit)
            began = time.monotonic()
            outcome = await self._attempt(method, url, headers=headers, timeout=timeout, **arguments)
            if pace is not None and protocol.is_refusal(outcome):
                pace.refuse(began, protocol.retry_after(outcome) if isinstance(outcome, httpx.Response) else None)
            is_last = attempt > (self.retries if retries is None else retries)
            pause = None if is_last else protocol.pause_before_retry(outcome, attempt)
            if pause is None or time.monotonic() + pause > until:
                break
            await self.io.sleep(pause)
        if isinstance(outcome, httpx.HTTPError):
            raise errors.unreachable(outcome, self.endpoint.base_url) from outcome
        # A second DELETE finds nothing where the first succeeded and its response was lost.
        was_deleted = method == "DELETE" and attempt > 1 and outcome.status_code == protocol.NOT_FOUND
        if not outcome.is_success and not was_deleted:
            raise errors.error_of(outcome)
        return outcome

    async def _attempt(self, method: str, url: str, **arguments: Any) -> httpx.Response | httpx.HTTPError:
        """Raises `ServerUnreachable` for a server that has never answered and has refused the first few connections.

        Retries would only delay the message that no server is there.
        """
        if self.io.http.is_closed:
            raise errors.ServerUnreachable("The client is closed. Call `load()` or `save()` on results before that.")
        try:
            response = await self.io.request(method, url, **arguments)
        except httpx.HTTPError as error:
            if isinstance(error, httpx.ConnectError):
                self._refused += 1
                if not self._ever_answered and self._refused >= protocol.MAX_FIRST_ATTEMPTS:
                    raise errors.unreachable(error, self.endpoint.base_url) from error
            return error
        self._ever_answered = True
        return response

    async def get(self, model: type[M], path: str, **arguments: Any) -> M:
        """The record at a path."""
        return protocol.read(model, protocol.object_in(await self.exchange("GET", path, **arguments)))

    async def artifact(self, sha256: str) -> bytes:
        """The bytes of an artifact, checked against their digest."""
        # A redirect leads to another host where the server keeps artifacts in an object store; it gets no API key.
        response = await self.exchange("GET", f"/artifacts/{quote(sha256, safe='')}", follow_redirects=True)
        data = response.content
        if hashlib.sha256(data).hexdigest() != sha256:
            raise errors.BadResponse(f"The artifact {sha256} came damaged ({len(data)} bytes): get it again.")
        return data

    # Jobs

    async def submit(self, *arguments: Any) -> Any:
        """The handle of a new job; the arguments are those of `job_request`."""
        return self._handle(self, protocol.job_in(await self._post(job_request(*arguments), "respond-async")))

    async def _post(self, request: JobRequest, prefer: str, **arguments: Any) -> httpx.Response:
        headers = request.headers(prefer)
        return await self.exchange("POST", f"/{request.kind}", headers, content=request.content, **arguments)

    async def job(self, job_id: str) -> Any:
        """The handle of a job."""
        return self._handle(self, await self.refresh(job_id))

    async def refresh(self, job_id: str) -> records.Job:
        """The state of a job."""
        return protocol.job_in(await self.exchange("GET", protocol.job_path(job_id)))

    async def cancel(self, job_id: str, **arguments: Any) -> records.Job:
        """Cancels a job; returns its state."""
        return protocol.job_in(await self.exchange("POST", f"{protocol.job_path(job_id)}/cancel", **arguments))

    async def simulate_or_answer(self, timeout: float | None, progress: ProgressLike, *arguments: Any) -> Any:
        """The result of a request, with its progress shown; the arguments are those of `job_request`."""
        request = job_request(*arguments)
        server_wait = self.endpoint.server_wait(timeout) if progress is False else 0
        with reporting(progress) as on_update:
            return await self.complete(request, server_wait, timeout, on_update)

    async def complete(
        self,
        request: JobRequest,
        server_wait: int,
        timeout: float | None,
        on_update: OnUpdate,
        *,
        cancel_abandoned: bool = True,
        pace: AdaptiveLimit | None = None,
    ) -> Any:
        """The result of a request. The server waits for it `server_wait` seconds before the job is polled.

        Raises what the job failed with, and `WaitTimeout` after `timeout` seconds, all requests together. A caller who
        leaves in between cancels the job, unless `cancel_abandoned` is False.
        """
        until = protocol.deadline(timeout)
        job_id: str | None = None
        try:
            prefer = f"wait={server_wait}" if server_wait else "respond-async"
            response = await self._post(request, prefer, until=until, pace=pace)
            if response.status_code != protocol.ACCEPTED:
                return self.result(request.kind, protocol.object_in(response))
            job_id = protocol.job_in(response).id
            return await self.poll(job_id, timeout, until, on_update, request.minimal, pace)
        except (errors.CowError, GeneratorExit):
            raise
        except BaseException:
            if cancel_abandoned:
                await self.io.shield(partial(self._cancel_abandoned, request, job_id))
            raise

    async def _cancel_abandoned(self, request: JobRequest, job_id: str | None) -> None:
        """Cancels the job of a caller who has left. Without retries: the server may be gone, too."""
        once: dict[str, Any] = {"limit": protocol.CANCEL_TIMEOUT_SECONDS, "retries": 0}
        with suppress(Exception):
            if job_id is None:
                # Sent once more under the same key, the request returns the job that it has become, or becomes one now.
                job_id = protocol.job_in(await self._post(request, "respond-async", **once)).id
            await self.cancel(job_id, **once)

    async def poll(
        self,
        job_id: str,
        timeout: float | None,
        until: float,
        on_update: OnUpdate,
        minimal: bool,
        pace: AdaptiveLimit | None = None,
    ) -> Any:
        """The result of a job, once it has ended. Raises what it failed with, and `WaitTimeout` after `until`."""
        pause = protocol.FIRST_POLL_SECONDS
        headers = {"Prefer": MINIMAL} if minimal else {}
        while True:
            response = await self.exchange("GET", protocol.job_path(job_id), headers, until=until, pace=pace)
            job = protocol.job_in(response)
            if on_update is not None:
                on_update(job)
            if job.status in records.TERMINAL:
                return self.result(job.kind, protocol.result_in(response, job))
            rest = min(pause, until - time.monotonic())
            if rest <= 0:
                raise errors.WaitTimeout.of(job_id, timeout or 0)
            await self.io.sleep(rest)
            pause = min(pause * protocol.POLL_GROWTH, protocol.MAX_POLL_SECONDS)

    def result(self, kind: records.JobKind, body: Any) -> Any:
        """The result that is this JSON; it downloads its pictures from here."""
        result = protocol.read(self._kinds[kind], body)
        result.files.connection = self
        return result

    async def jobs(self, filters: Mapping[str, Any]) -> AsyncGenerator[Any]:
        """The handles of the jobs of this key, page by page."""
        params = {name: plain(value) for name, value in filters.items() if value is not None}
        while True:
            page = await self.get(records.JobPage, "/jobs", params={"limit": protocol.JOBS_PER_PAGE, **params})
            for job in page.jobs:
                yield self._handle(self, job)
            if page.next is None:
                return
            params["cursor"] = page.next

    async def events(self, handle: Any, after: int) -> AsyncGenerator[protocol.Event]:
        """The events of a job after a number, through broken connections."""
        position, attempts, ended = after, 0, False
        url = f"{self.endpoint.base_url}{protocol.job_path(handle.id)}/events"
        while not ended:
            resume = {"Last-Event-ID": str(position)} if position else {}
            headers = self.endpoint.headers({"Accept": "text/event-stream", **resume})
            timeout = self.endpoint.stream_timeout
            try:
                async with self.io.stream(url, headers=headers, timeout=timeout) as (response, events):
                    outcome: httpx.Response | httpx.HTTPError = response
                    ended = response.status_code == protocol.NO_CONTENT
                    if protocol.is_event_stream(response):
                        async for sent in events:
                            attempts = 0
                            if (event := protocol.event_in(sent)) is None:
                                continue
                            ended = event.name in protocol.FINAL
                            if event.number is None or event.number > position:  # else it came before
                                position = event.number or position
                                handle.job = event.job or handle.job
                                yield event
                            if ended:
                                break
            except httpx.HTTPError as error:
                outcome = error
            attempts += 1
            if not ended:
                await self.io.sleep(protocol.pause_before_reconnect(outcome, attempts, self.retries))

    # Batches

    async def map(self, batch: Batch) -> AsyncGenerator[BatchResult[Any]]:
        """The results of a batch as they come, then those of earlier runs."""
        with batch:
            ask = partial(self._ask, batch)
            async with aclosing(self.io.map_concurrently(ask, batch.pending(), batch.pace)) as results:
                async for result in results:
                    if batch.wants_load():
                        with suppress(errors.CowError):
                            batch.show_load(await self.get(records.Workers, "/workers", limit=LOOK_TIMEOUT, retries=0))
                    batch.count(result)
                    yield result
            for result in batch.earlier_results(self.result):
                yield result

    async def _ask(self, batch: Batch, question: Question, began: float) -> BatchResult[Any]:
        """The result of a question, which is written down. Raises what no question could get past (`OutageTimer`)."""
        timeout = batch.options.timeout
        while True:
            result: Any = None
            failed: errors.CowError | None = None
            try:
                request = await self.io.call_blocking(partial(batch.request, question))  # reads and encodes pictures
                result = await self.complete(
                    request,
                    self.endpoint.server_wait(timeout),
                    timeout,
                    lambda _: batch.outage.reset(),
                    cancel_abandoned=batch.journal is None,  # with a journal, the next start asks for the job again
                    pace=batch.pace,
                )
                if (folder := batch.folder_of(question)) is not None:
                    await result.files.save(folder, result)
            except errors.CowError as error:
                failed = error
                if isinstance(error, errors.WaitTimeout):
                    with suppress(errors.CowError):
                        await self.cancel(error.job_id)
            pause = None if failed is None else batch.outage.pause_after(failed)
            if pause is None:
                batch.pace.end(began, succeeded=failed is None)
                return batch.keep(question, result, failed, time.monotonic() - began)
            await self.io.sleep(pause)


class Files:
    """The artifacts of one result, by their digests: downloaded when they are first asked for, then held.

    They are no part of what a result says: results that say the same are equal.
    """

    connection: Connection | None = None

    def __init__(self) -> None:
        self.held: dict[str, bytes] = {}
        self.download_failed = False

    async def fetch(self, sha256: str) -> bytes:
        """The bytes of an artifact, which are downloaded the first time."""
        if sha256 not in self.held:
            if self.connection is None:
                raise ValueError(f"This result is from a file or another process: get {sha256} by `Client.artifact`.")
            self.held[sha256] = await self.connection.artifact(sha256)
        return self.held[sha256]

    async def load(self, result: records.Simulation | records.Answer) -> None:
        """Downloads overlay, frames and video of a result."""
        for sha256 in records.artifacts_of(result).values():
            await self.fetch(sha256)

    async def save(self, folder: str | Path, result: records.Simulation | records.Answer) -> Path:
        """Writes a result and its artifacts into a folder, which is made if missing."""
        await self.load(result)
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for name, sha256 in records.artifacts_of(result).items():
            (folder / name).write_bytes(self.held[sha256])
        for name, text in records.documents_of(result).items():
            (folder / name).write_text(text, encoding="utf-8")
        return folder

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Files)

    __hash__ = object.__hash__

    def __deepcopy__(self, _: dict[int, Any]) -> Self:
        return self  # bytes by their digests are the same for every copy

    def __reduce__(self) -> tuple[Any, ...]:
        # A connection does not go into another process; what it has downloaded does.
        return type(self), (), {"held": self.held}
