"""How `AsyncClient` waits: on the event loop. `sync_io.py` has the same names for `Client`, which waits in threads."""

import asyncio
import math
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager
from typing import Any, TypeVar

import httpx
from httpx_sse import EventSource, ServerSentEvent

from cow_service.adaptive import AdaptiveLimit
from cow_service.client.protocol import is_event_stream

Q = TypeVar("Q")
R = TypeVar("R")


async def run(coroutine: Coroutine[Any, Any, R]) -> R:
    """Awaits a coroutine of `Connection`."""
    return await coroutine


def iterate(values: AsyncGenerator[R]) -> AsyncGenerator[R]:
    """What a generator of `Connection` yields."""
    return values


def picture_bytes(files: Any, sha256: str) -> bytes | None:
    """An artifact for a notebook, if it has been downloaded: a notebook cannot await while it shows a result."""
    return files.held.get(sha256)


class AsyncIO:
    """An HTTP client, closed with this where it was made here, and the tasks that wait for it."""

    def __init__(self, http: httpx.AsyncClient | None) -> None:
        self._own_http = http is None
        self.http = httpx.AsyncClient(limits=httpx.Limits(max_connections=None)) if http is None else http
        self._shielded: set[asyncio.Task[None]] = set()

    async def close(self) -> None:
        """Closes the HTTP client once the server knows which callers have left."""
        await asyncio.gather(*self._shielded, return_exceptions=True)
        if self._own_http:
            await self.http.aclose()

    async def request(self, method: str, url: str, **arguments: Any) -> httpx.Response:
        """The response to a request."""
        return await self.http.request(method, url, **arguments)

    @asynccontextmanager
    async def stream(
        self, url: str, **arguments: Any
    ) -> AsyncGenerator[tuple[httpx.Response, AsyncIterator[ServerSentEvent]]]:
        """The response at a URL, with its body where it is no stream of events, and the events."""
        async with self.http.stream("GET", url, **arguments) as response:
            if not is_event_stream(response):
                await response.aread()
            yield response, EventSource(response).aiter_sse()

    async def sleep(self, seconds: float) -> None:
        """Waits."""
        await asyncio.sleep(seconds)

    async def call_blocking(self, function: Callable[[], R]) -> R:
        """Calls a function that blocks, in a thread."""
        return await asyncio.to_thread(function)

    async def shield(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Does work in a separate task: a canceled caller may be canceled again before the work is done."""
        task = asyncio.create_task(work())
        self._shielded.add(task)
        task.add_done_callback(self._shielded.discard)
        await asyncio.shield(task)

    async def map_concurrently(
        self, ask: Callable[[Q, float], Coroutine[Any, Any, R]], questions: Iterator[Q], pace: AdaptiveLimit
    ) -> AsyncGenerator[R]:
        """Asks as many questions at the same time as `pace` allows, and yields each result as it comes.

        `ask` is given a question and the time that `pace.begin` returned, and calls `pace.end`.
        """
        tasks: set[asyncio.Task[R]] = set()
        try:
            question = next(questions, None)
            while tasks or question is not None:
                seconds = math.inf  # until another one may be asked
                while question is not None and (seconds := pace.seconds_to_wait()) == 0:
                    tasks.add(asyncio.create_task(ask(question, pace.begin())))
                    question, seconds = next(questions, None), math.inf
                if not tasks:
                    await asyncio.sleep(seconds)
                    continue
                timeout = seconds if seconds < math.inf else None
                done, tasks = await asyncio.wait(tasks, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    yield task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
