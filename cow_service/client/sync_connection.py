"""A server and the way to it: requests with retries, jobs and their events, and the results with their pictures.

Written by `make unasync` from `async_connection.py`.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, Self, TypeAlias, TypeVar
from urllib.parse import quote

import httpx
from httpx_sse import EventSource
from pydantic import BaseModel, PrivateAttr

from cow_service import records
from cow_service.client import protocol
from cow_service.client import sync_io as io
from cow_service.client.display import AnswerView, HeldFiles, SimulationView, picture_of, stacked
from cow_service.client.errors import BadResponse, ServerUnreachable, WaitTimeout, error_of, unreachable
from cow_service.client.progress import ProgressLike, reporting
from cow_service.client.protocol import BaseJobHandle, Event, EventCursor, job_in, job_path, object_in, read
from cow_service.client.request import MINIMAL, JobRequest, job_request, plain
from cow_service.errors import CowError
from cow_service.records import TERMINAL, AcceptedRequest, Job, JobKind, JobPage

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from PIL import Image

    from cow_service.client.batches import Batch, BatchResult
    from cow_service.client.journal import Question

M = TypeVar("M", bound=BaseModel)
OnUpdate: TypeAlias = Callable[[Job], None] | None


class Connection:
    """A server and the HTTP client that reaches it."""

    def __init__(
        self,
        base_url: str | None,
        api_key: str | None,
        timeout: float | httpx.Timeout | None,
        retries: int,
        http: httpx.Client | None,
    ) -> None:
        self.endpoint = protocol.endpoint_of(base_url, api_key, timeout)
        self.retries = retries
        self._own_http = http is None
        self._http = httpx.Client(limits=httpx.Limits(max_connections=None)) if http is None else http
        self._ever_answered = False
        self._refused = 0
        self._shield = io.Shield()

    def close(self) -> None:
        """Closes the HTTP client, where it was made here, once the server knows which callers have left."""
        self._shield.wait()
        if self._own_http:
            self._http.close()

    def exchange(
        self,
        method: str,
        path: str,
        headers: Mapping[str, str] | None = None,
        *,
        until: float | None = None,
        limit: float | None = None,
        retries: int | None = None,
        **arguments: Any,
    ) -> httpx.Response:
        """The response to a request, which is sent again where that may help (`pause_before_retry`).

        No attempt begins after `until`, on the monotonic clock; `limit` is how long the server may say nothing, in
        seconds. Raises the error that the response holds (`errors.py`).
        """
        url, headers = self.endpoint.base_url + path, self.endpoint.headers(headers or {})
        attempt = 0
        while True:
            attempt += 1
            if until is not None:
                limit = max(until - time.monotonic(), 0) + protocol.TIMEOUT_MARGIN_SECONDS
            timeout = self.endpoint.limited(limit)
            outcome = self._attempt(method, url, headers=headers, timeout=timeout, **arguments)
            is_last = attempt > (self.retries if retries is None else retries)
            pause = None if is_last else protocol.pause_before_retry(outcome, attempt)
            if pause is None or (until is not None and time.monotonic() + pause > until):
                break
            io.sleep(pause)
        if isinstance(outcome, httpx.HTTPError):
            raise unreachable(outcome, self.endpoint.base_url) from outcome
        # A second DELETE finds nothing where the first succeeded and its response was lost.
        was_deleted = method == "DELETE" and attempt > 1 and outcome.status_code == protocol.NOT_FOUND
        if not outcome.is_success and not was_deleted:
            raise error_of(outcome)
        return outcome

    def _attempt(self, method: str, url: str, **arguments: Any) -> httpx.Response | httpx.HTTPError:
        """Raises `ServerUnreachable` for a server that has never answered and has refused the first few connections.

        Retries would only delay the message that no server is there.
        """
        io.raise_if_stopped()
        if self._http.is_closed:
            raise ServerUnreachable("The client is closed. Call `load()` or `save()` on results before that.")
        try:
            response = self._http.request(method, url, **arguments)
        except httpx.HTTPError as error:
            if isinstance(error, httpx.ConnectError):
                self._refused += 1
                if not self._ever_answered and self._refused >= protocol.MAX_FIRST_ATTEMPTS:
                    raise unreachable(error, self.endpoint.base_url) from error
            return error
        self._ever_answered = True
        return response

    def get(self, model: type[M], path: str, **arguments: Any) -> M:
        """The record at a path."""
        return read(model, object_in(self.exchange("GET", path, **arguments)))

    def artifact(self, sha256: str) -> bytes:
        """The bytes of an artifact, checked against their digest."""
        # A redirect leads to another host where the server keeps artifacts in an object store; it gets no API key.
        response = self.exchange("GET", f"/artifacts/{quote(sha256, safe='')}", follow_redirects=True)
        if hashlib.sha256(response.content).hexdigest() != sha256:
            raise BadResponse(f"The artifact {sha256} came damaged ({len(response.content)} bytes): get it again.")
        return response.content

    # Jobs

    def submit(self, *arguments: Any) -> JobHandle[Any]:
        """The handle of a new job; the arguments are those of `job_request`."""
        request = job_request(*arguments)
        headers = request.headers("respond-async")
        response = self.exchange("POST", f"/{request.kind}", headers, content=request.content)
        return JobHandle(self, job_in(response))

    def job(self, job_id: str) -> JobHandle[Any]:
        """The handle of a job."""
        return JobHandle(self, job_in(self.exchange("GET", job_path(job_id))))

    def simulate_or_answer(self, timeout: float | None, progress: ProgressLike, *arguments: Any) -> Any:
        """The result of a request, with its progress shown; the arguments are those of `job_request`."""
        request = job_request(*arguments)
        server_wait = self.endpoint.server_wait(timeout) if progress is False else 0
        with reporting(progress) as on_update:
            return self.complete(request, server_wait, timeout, on_update)

    def complete(
        self,
        request: JobRequest,
        server_wait: int,
        timeout: float | None,
        on_update: OnUpdate,
        *,
        cancel_abandoned: bool = True,
    ) -> Any:
        """The result of a request. The server waits for it `server_wait` seconds before the job is polled.

        Raises what the job failed with, and `WaitTimeout` after `timeout` seconds, all requests together. A caller who
        leaves in between cancels the job, unless `cancel_abandoned` is False.
        """
        until = None if timeout is None else time.monotonic() + timeout
        job_id: str | None = None
        headers = request.headers(f"wait={server_wait}" if server_wait > 0 else "respond-async")
        try:
            response = self.exchange("POST", f"/{request.kind}", headers, content=request.content, until=until)
            if response.status_code != protocol.ACCEPTED:
                return self.result(request.kind, object_in(response))
            job_id = job_in(response).id
            return self.poll(job_id, timeout, until, on_update, request.minimal)
        except (CowError, GeneratorExit):
            raise
        except BaseException:
            if cancel_abandoned:
                self._shield.run(partial(self._cancel_abandoned, request, job_id))
            raise

    def _cancel_abandoned(self, request: JobRequest, job_id: str | None) -> None:
        """Cancels the job of a caller who has left. Without retries: the server may be gone, too."""
        once: dict[str, Any] = {"limit": protocol.CANCEL_TIMEOUT_SECONDS, "retries": 0}
        with suppress(Exception):
            if job_id is None:
                # Sent once more under the same key, the request returns the job that it has become, or becomes one now.
                headers = request.headers("respond-async")
                response = self.exchange("POST", f"/{request.kind}", headers, content=request.content, **once)
                job_id = job_in(response).id
            self.exchange("POST", f"{job_path(job_id)}/cancel", **once)

    def poll(self, job_id: str, timeout: float | None, until: float | None, on_update: OnUpdate, minimal: bool) -> Any:
        """The result of a job, once it has ended. Raises what it failed with, and `WaitTimeout` after `until`."""
        pause = protocol.FIRST_POLL_SECONDS
        headers = {"Prefer": MINIMAL} if minimal else {}
        while True:
            response = self.exchange("GET", job_path(job_id), headers, until=until)
            job = job_in(response)
            if on_update is not None:
                on_update(job)
            if job.status in TERMINAL:
                break
            rest = pause if until is None else until - time.monotonic()
            if rest <= 0:
                raise WaitTimeout.of(job_id, timeout or 0)
            io.sleep(min(pause, rest))
            pause = min(pause * protocol.POLL_GROWTH, protocol.MAX_POLL_SECONDS)
        return self.result(job.kind, protocol.result_in(response, job))

    def result(self, kind: JobKind, body: Any) -> Simulation | Answer:
        """The result that is this JSON; it downloads its pictures from here."""
        result = read(Simulation if kind == "simulate" else Answer, body)
        result.files.connection = self
        return result

    def jobs(self, filters: Mapping[str, Any]) -> Generator[JobHandle[Any]]:
        """The jobs of this key, page by page."""
        params = {name: plain(value) for name, value in filters.items() if value is not None}
        while True:
            page = self.get(JobPage, "/jobs", params={"limit": protocol.JOBS_PER_PAGE, **params})
            for job in page.jobs:
                yield JobHandle(self, job)
            if page.next is None:
                return
            params["cursor"] = page.next

    def events(self, handle: JobHandle[Any], after: int) -> Generator[Event]:
        """The events of a job after a number, through broken connections."""
        cursor = EventCursor(after, self.retries)
        url = f"{self.endpoint.base_url}{job_path(handle.id)}/events"
        while not cursor.ended:
            headers = self.endpoint.headers({"Accept": "text/event-stream", **cursor.headers})
            timeout = self.endpoint.stream_timeout
            try:
                with self._http.stream("GET", url, headers=headers, timeout=timeout) as response:
                    outcome: httpx.Response | httpx.HTTPError = response
                    if protocol.is_event_stream(response):
                        for sent in EventSource(response).iter_sse():
                            if (event := cursor.take(sent)) is not None:
                                handle.job = event.job or handle.job
                                yield event
                            if cursor.ended:
                                break
                    else:
                        response.read()
            except httpx.HTTPError as error:
                outcome = error
            if not cursor.ended:
                io.sleep(cursor.pause_after(outcome))

    # Batches

    def map(self, batch: Batch) -> Generator[BatchResult[Any]]:
        """The results of a batch as they come, then those of earlier runs."""
        with batch:
            ask = partial(self._ask, batch)
            with closing(io.map_concurrently(ask, batch.pending(), batch.options.concurrency)) as results:
                for result in results:
                    batch.count(result)
                    yield result
            for result in batch.earlier_results(self.result):
                yield result

    def _ask(self, batch: Batch, question: Question) -> BatchResult[Any]:
        """The result of a question, which is written down. Raises what no question could get past (`OutageTimer`)."""
        began, timeout = time.monotonic(), batch.options.timeout
        while True:
            result: Simulation | Answer | None = None
            failed: CowError | None = None
            try:
                request = io.call_blocking(partial(batch.request, question))  # reads files, encodes pictures
                result = self.complete(
                    request,
                    self.endpoint.server_wait(timeout),
                    timeout,
                    lambda _: batch.outage.reset(),
                    cancel_abandoned=batch.journal is None,  # with a journal, the next start asks for the job again
                )
                if result is not None and (folder := batch.folder_of(question)) is not None:
                    result.save(folder)
            except CowError as error:
                failed = error
                if isinstance(error, WaitTimeout):
                    with suppress(CowError):
                        self.exchange("POST", f"{job_path(error.job_id)}/cancel")
            pause = None if failed is None else batch.outage.pause_after(failed)
            if pause is None:
                return batch.keep(question, result, failed, time.monotonic() - began)
            io.sleep(pause)


class Files(HeldFiles):
    """The artifacts of one result, downloaded when they are first asked for."""

    connection: Connection | None = None

    def fetch(self, sha256: str) -> bytes:
        """The bytes of an artifact, which are downloaded the first time."""
        if sha256 not in self.held:
            if self.connection is None:
                raise self.without_connection(sha256)
            self.held[sha256] = self.connection.artifact(sha256)
        return self.held[sha256]

    def save(self, folder: str | Path, result: records.Simulation | records.Answer) -> Path:
        """Writes a result and its artifacts into a folder."""
        for sha256 in records.artifacts_of(result).values():
            self.fetch(sha256)
        return self.write(Path(folder), result)


class Simulation(SimulationView):
    """A simulation, and its pictures, each downloaded when it is first asked for.

    >>> question = "If the yellow ball moves to the left, will it hit the blue mug?"
    >>> simulation = client.simulate("image.jpg", question)
    >>> [frame.index for frame in simulation.frames]
    [1, 3, 5]
    >>> (simulation.numpy_frames()).shape
    (3, 295, 512, 3)
    """

    _files: Files = PrivateAttr(default_factory=Files)

    @property
    def files(self) -> Files:
        """Its artifacts."""
        return self._files

    def pil_frames(self) -> list[Image.Image]:
        """The frames chosen for reasoning as PIL images, RGB, in order of time."""
        return [picture_of(self._files.fetch(frame.sha256)) for frame in self.frames]

    def numpy_frames(self) -> NDArray[np.uint8]:
        """The same frames as one array (frames, height, width, 3), RGB, uint8."""
        return stacked(self.pil_frames())

    def pil_overlay(self) -> Image.Image:
        """The input with box, point, arrow and path drawn on it, RGB."""
        return picture_of(self._files.fetch(self.overlay.sha256))

    def video_bytes(self) -> bytes:
        """The clip as mp4 (H.264). Raises `ValueError` where the request said `video=False`."""
        if self.video is None:
            raise ValueError("This simulation has no video: ask for one with video=True.")
        return self._files.fetch(self.video.sha256)

    def load(self) -> Self:
        """Downloads overlay, frames and video now."""
        for sha256 in records.artifacts_of(self).values():
            self._files.fetch(sha256)
        return self

    def save(self, folder: str | Path) -> Path:
        """Writes frame_*.png, overlay.jpg, video.mp4 and simulation.json into a folder, which is made if missing."""
        return self._files.save(folder, self)

    def picture_bytes(self, sha256: str) -> bytes | None:
        """The bytes of a picture or the video for a notebook; None where they are not available."""
        return io.picture_bytes(self._files, sha256)


class Answer(AnswerView):
    """An answer; its `simulation` has the pictures that it was reasoned on.

    >>> question = "If the yellow ball moves to the left, will it hit the blue mug? (A) Yes (B) No"
    >>> answer = client.answer("image.jpg", question)
    >>> answer.answer, answer.option
    ('B', 'No')
    >>> answer.simulation.trajectory.outcome.probability
    0.0
    """

    simulation: Simulation | None  # pyright: ignore[reportIncompatibleVariableOverride] - frozen: nobody assigns it

    @property
    def files(self) -> Files:
        """The artifacts of its simulation."""
        return Files() if self.simulation is None else self.simulation.files

    def load(self) -> Self:
        """Downloads overlay, frames and video now."""
        if self.simulation is not None:
            self.simulation.load()
        return self

    def save(self, folder: str | Path) -> Path:
        """Writes answer.json, and what `Simulation.save` writes, into a folder, which is made if missing."""
        return self.files.save(folder, self)


R_co = TypeVar("R_co", bound=Simulation | Answer, covariant=True)


class JobHandle(BaseJobHandle, Generic[R_co]):
    """A job on the server, which goes on whether or not anybody holds this. `job` is its last known state."""

    _connection: Connection

    def refresh(self) -> Job:
        """Gets the state of the job. Raises `JobNotFound` where it was deleted."""
        self.job = job_in(self._connection.exchange("GET", job_path(self.id)))
        return self.job

    def request(self) -> AcceptedRequest:
        """Gets the request that became the job: `client.submit(**request.request, kind=request.kind)` sends it again.

        Raises `JobNotFound` where the job was deleted.
        """
        return self._connection.get(AcceptedRequest, f"{job_path(self.id)}/request")

    def wait(self, timeout: float | None = None, *, progress: ProgressLike = False, minimal: bool = False) -> R_co:
        """The job's result, once it has ended; `minimal` as for `Client.simulate`.

        Raises what it failed with (`errors.py`), `Canceled`, and `WaitTimeout` after `timeout` seconds.
        """
        until = None if timeout is None else time.monotonic() + timeout
        with reporting(progress) as report:

            def on_update(job: Job) -> None:
                self.job = job
                if report is not None:
                    report(job)

            return self._connection.poll(self.id, timeout, until, on_update, minimal)

    def cancel(self) -> Job:
        """Cancels the job; work on it stops at the next step. One that has ended stays as it is."""
        self.job = job_in(self._connection.exchange("POST", f"{job_path(self.id)}/cancel"))
        return self.job

    def delete(self) -> None:
        """Cancels the job and removes it, with artifacts that no other job holds."""
        self._connection.exchange("DELETE", job_path(self.id))

    def events(self, after: int = 0) -> Iterator[Event]:
        """What happens to the job until its end, through broken connections.

        `after` leaves out events up to that number.
        """
        return self._connection.events(self, after)
