"""How `AsyncClient` performs steps: it awaits."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Mapping
from contextlib import aclosing
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import httpx
from httpx_sse import EventSource

from cow_service.client.events import Event, EventCursor, is_event_stream
from cow_service.client.handles import AsyncJobHandle
from cow_service.client.operations import Operations, closed
from cow_service.client.results import AsyncAnswer, AsyncSimulation
from cow_service.client.steps import Blocking, Send, Shielded, Sleep, Step, Steps
from cow_service.records import JobKind

if TYPE_CHECKING:
    from cow_service.client.batches import Batch, Outcome

T = TypeVar("T")


class AsyncConnection(Operations):
    """A server and the way to it, for calls that are awaited."""

    result_types: ClassVar[Mapping[JobKind, type[Any]]] = {"simulate": AsyncSimulation, "answer": AsyncAnswer}
    handle_type = AsyncJobHandle
    _http_type = httpx.AsyncClient
    _http: httpx.AsyncClient

    @cached_property
    def _shielded(self) -> set[asyncio.Task[None]]:
        """Tasks that outlive their callers."""
        return set()

    async def close(self) -> None:
        """Closes the HTTP client, where it was made here, once the server knows which callers have left."""
        await asyncio.gather(*self._shielded, return_exceptions=True)
        if self._own_http:
            await self._http.aclose()

    async def run(self, steps: Steps[T]) -> T:
        """The result of steps."""
        resume = partial(next, steps)
        while True:
            try:
                step = resume()
            except StopIteration as end:
                return end.value
            try:
                result = await self._perform(step)
            except (asyncio.CancelledError, Exception) as error:  # noqa: BLE001 - the steps raise it again, see `Client`
                resume = partial(steps.throw, error)
            else:
                resume = partial(steps.send, result)

    async def _perform(self, step: Step) -> Any:
        if isinstance(step, Shielded):
            # A task of its own: whoever is canceled may be canceled again before the server knows of it.
            task = asyncio.create_task(self.run(step.steps))
            self._shielded.add(task)
            task.add_done_callback(self._shielded.discard)
            return await asyncio.shield(task)
        if isinstance(step, Sleep):
            return await asyncio.sleep(step.seconds)
        return await (asyncio.to_thread(step.function) if isinstance(step, Blocking) else self._send(step))

    async def _send(self, send: Send) -> httpx.Response | httpx.HTTPError:
        if self._http.is_closed:
            raise closed()
        try:
            outcome: httpx.Response | httpx.HTTPError = await self._http.request(**self._arguments(send))
        except httpx.HTTPError as error:
            outcome = error
        return self._received(outcome)

    async def events(self, handle: AsyncJobHandle[Any], after: int) -> AsyncGenerator[Event]:
        """The events of a job after a number, through broken connections."""
        cursor = EventCursor(after, self.retries)
        while not cursor.ended:
            try:
                async with self._http.stream(**self._stream_arguments(handle.id, cursor)) as response:
                    outcome: httpx.Response | httpx.HTTPError = response
                    if is_event_stream(response):
                        async for sent in EventSource(response).aiter_sse():
                            if (event := cursor.take(sent)) is not None:
                                handle.job = event.job or handle.job
                                yield event
                            if cursor.ended:
                                break
                    else:
                        await response.aread()
            except httpx.HTTPError as error:
                outcome = error
            if not cursor.ended:
                await asyncio.sleep(cursor.pause_after(outcome))

    async def jobs(self, filters: Mapping[str, Any]) -> AsyncGenerator[AsyncJobHandle[Any]]:
        """The jobs of this key, page by page."""
        cursor: str | None = None
        while True:
            page = await self.run(self.page_of_jobs(filters, cursor))
            for job in page.jobs:
                yield AsyncJobHandle(self, job)
            cursor = page.next
            if cursor is None:
                return

    async def map(self, batch: Batch) -> AsyncGenerator[Outcome[Any]]:
        """The outcomes of a batch as they come, then those of before."""
        with batch:
            async with aclosing(self._outcomes(batch)) as outcomes:
                async for outcome in outcomes:
                    batch.count(outcome)
                    yield outcome
            for outcome in batch.earlier_outcomes():
                yield outcome

    async def _outcomes(self, batch: Batch) -> AsyncGenerator[Outcome[Any]]:
        """The outcomes, as they come; each is written down before it is yielded."""
        pending = batch.pending()
        tasks: set[asyncio.Task[Outcome[Any]]] = set()
        try:
            while True:
                while len(tasks) < batch.concurrency and (question := next(pending, None)) is not None:
                    tasks.add(asyncio.create_task(self.run(batch.ask(question))))
                if not tasks:
                    return
                done, tasks = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    yield task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
