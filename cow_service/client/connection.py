"""How `Client` performs steps: it blocks."""

from __future__ import annotations

import threading
import time
from collections.abc import Generator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import httpx
from httpx_sse import EventSource

from cow_service.client.events import Event, EventCursor, is_event_stream
from cow_service.client.handles import JobHandle
from cow_service.client.operations import Operations, closed
from cow_service.client.results import Answer, Simulation
from cow_service.client.steps import Blocking, Send, Shielded, Sleep, Step, Steps, Stopped
from cow_service.records import JobKind

if TYPE_CHECKING:
    from cow_service.client.batches import Batch, Outcome

T = TypeVar("T")


class Connection(Operations):
    """A server and the way to it, for calls that block."""

    result_types: ClassVar[Mapping[JobKind, type[Any]]] = {"simulate": Simulation, "answer": Answer}
    handle_type = JobHandle
    _http_type = httpx.Client
    _http: httpx.Client

    def close(self) -> None:
        """Closes the HTTP client, where it was made here."""
        if self._own_http:
            self._http.close()

    def run(self, steps: Steps[T]) -> T:
        """The result of steps."""
        return self._run(steps, None)

    def _run(self, steps: Steps[T], stop: threading.Event | None) -> T:
        """The same; once `stop` is set, the steps are ended by `Stopped`."""
        resume = partial(next, steps)
        while True:
            try:
                step = resume()
            except StopIteration as end:
                return end.value
            try:
                result = self._perform(step, stop)
            except BaseException as error:  # noqa: BLE001 - the steps raise it again, after what they have to tidy up
                resume = partial(steps.throw, error)
            else:
                resume = partial(steps.send, result)

    def _perform(self, step: Step, stop: threading.Event | None) -> Any:
        if isinstance(step, Shielded):
            return self.run(step.steps)
        if stop is not None and stop.is_set():
            raise Stopped
        if isinstance(step, Sleep):
            return time.sleep(step.seconds) if stop is None else stop.wait(step.seconds)
        return step.function() if isinstance(step, Blocking) else self._send(step)

    def _send(self, send: Send) -> httpx.Response | httpx.HTTPError:
        if self._http.is_closed:
            raise closed()
        try:
            outcome: httpx.Response | httpx.HTTPError = self._http.request(**self._arguments(send))
        except httpx.HTTPError as error:
            outcome = error
        return self._received(outcome)

    def events(self, handle: JobHandle[Any], after: int) -> Generator[Event]:
        """The events of a job after a number, through broken connections."""
        cursor = EventCursor(after, self.retries)
        while not cursor.ended:
            try:
                with self._http.stream(**self._stream_arguments(handle.id, cursor)) as response:
                    outcome: httpx.Response | httpx.HTTPError = response
                    if is_event_stream(response):
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
                time.sleep(cursor.pause_after(outcome))

    def jobs(self, filters: Mapping[str, Any]) -> Generator[JobHandle[Any]]:
        """The jobs of this key, page by page."""
        cursor: str | None = None
        while True:
            page = self.run(self.page_of_jobs(filters, cursor))
            yield from (JobHandle(self, job) for job in page.jobs)
            cursor = page.next
            if cursor is None:
                return

    def map(self, batch: Batch) -> Generator[Outcome[Any]]:
        """The outcomes of a batch as they come, then those of before."""
        from cow_service.client.thread_map import outcomes  # noqa: PLC0415 - not needed to call a server once

        with batch:
            for outcome in outcomes(self._run, batch):
                batch.count(outcome)
                yield outcome
            yield from batch.earlier_outcomes()
