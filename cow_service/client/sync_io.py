"""How `Client` waits: it blocks, in threads of its own where it asks many questions. The twin of `async_io.py`.

What is `async` here never waits for an event loop.
"""

import threading
import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Coroutine, Generator, Iterable, Iterator
from contextlib import asynccontextmanager
from itertools import islice
from queue import SimpleQueue
from typing import Any, TypeVar

import httpx
from httpx_sse import EventSource, ServerSentEvent

from cow_service.adaptive import AdaptiveLimit
from cow_service.client.protocol import is_event_stream
from cow_service.errors import CowError

Q = TypeVar("Q")
R = TypeVar("R")
MAX_WAIT_SECONDS = 1.0  # before a thread that waits for a place looks again
END_SECONDS = 0.5  # that threads are given to end before their connections are closed


class _Thread(threading.local):
    stop: threading.Event | None = None  # ends what a thread of `map_concurrently` does


_thread = _Thread()


class Stopped(BaseException):
    """The batch that this thread works for has ended."""


def run(coroutine: Coroutine[Any, Any, R]) -> R:
    """Runs a coroutine of `Connection` to its end; with a `BlockingIO` it never waits for an event loop."""
    try:
        coroutine.send(None)
    except StopIteration as done:
        return done.value
    raise AssertionError("a coroutine of the blocking client has waited for an event loop")


def iterate(values: AsyncGenerator[R]) -> Generator[R]:
    """What a generator of `Connection` yields."""
    try:
        while True:
            try:
                value = run(anext(values))
            except StopAsyncIteration:
                return
            yield value
    finally:
        run(values.aclose())


def picture_bytes(files: Any, sha256: str) -> bytes | None:
    """An artifact for a notebook, which is downloaded where it is missing.

    None after a download has failed, so that a notebook does not hang.
    """
    if not files.download_failed:
        try:
            return run(files.fetch(sha256))
        except (CowError, ValueError):
            files.download_failed = True
    return files.held.get(sha256)


class BlockingIO:
    """An HTTP client, closed with this where it was made here, and the threads that wait for it."""

    def __init__(self, http: httpx.Client | None) -> None:
        self._own_http = http is None
        self.http = httpx.Client(limits=httpx.Limits(max_connections=None)) if http is None else http

    async def close(self) -> None:
        """Closes the HTTP client."""
        if self._own_http:
            self.http.close()

    async def request(self, method: str, url: str, **arguments: Any) -> httpx.Response:
        """The response to a request. Raises `Stopped` in a thread whose batch has ended."""
        if _thread.stop is not None and _thread.stop.is_set():
            raise Stopped
        return self.http.request(method, url, **arguments)

    @asynccontextmanager
    async def stream(
        self, url: str, **arguments: Any
    ) -> AsyncGenerator[tuple[httpx.Response, AsyncIterator[ServerSentEvent]]]:
        """The response at a URL, with its body where it is no stream of events, and the events."""

        async def each(events: Iterator[ServerSentEvent]) -> AsyncGenerator[ServerSentEvent]:
            for event in events:
                yield event

        with self.http.stream("GET", url, **arguments) as response:
            if not is_event_stream(response):
                response.read()
            yield response, each(EventSource(response).iter_sse())

    async def sleep(self, seconds: float) -> None:
        """Waits. Raises `Stopped`."""
        if _thread.stop is None:
            time.sleep(seconds)
        elif _thread.stop.wait(seconds):
            raise Stopped

    async def call_blocking(self, function: Callable[[], R]) -> R:
        """Calls a function that blocks."""
        return function()

    async def shield(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Does work to its end even in a thread that was stopped."""
        stop, _thread.stop = _thread.stop, None
        try:
            await work()
        finally:
            _thread.stop = stop

    async def map_concurrently(
        self, ask: Callable[[Q, float], Coroutine[Any, Any, R]], questions: Iterator[Q], pace: AdaptiveLimit
    ) -> AsyncGenerator[R]:
        """Asks as many questions at the same time as `pace` allows, and yields results as they come.

        It does so in threads that end with the process. `ask` is as in `AsyncIO.map_concurrently`, and what it raises
        is raised. Whoever stops in between leaves jobs on the server which a batch with a journal finds again; without
        one they are canceled.
        """
        todo: SimpleQueue[Q | None] = SimpleQueue()
        done: SimpleQueue[tuple[R] | BaseException] = SimpleQueue()
        stop, ended, turn = threading.Event(), threading.Event(), threading.Lock()

        def begin() -> float:
            """Waits for a place, in turn. Raises `Stopped`."""
            with turn:
                while not stop.is_set():
                    ended.clear()  # first: whatever ends from here on is heard
                    if (seconds := pace.seconds_to_wait()) == 0:
                        break
                    ended.wait(min(seconds, MAX_WAIT_SECONDS))
                if stop.is_set():
                    raise Stopped
                return pace.begin()

        def work() -> None:
            """One thread: question after question, until there is none or the batch has ended."""
            _thread.stop = stop
            try:
                while (question := todo.get()) is not None and not stop.is_set():
                    done.put((run(ask(question, begin())),))
                    ended.set()
            except Stopped:
                pass
            except BaseException as error:  # noqa: BLE001 - it is raised again in the caller's thread
                done.put(error)

        def hand_out(some: Iterable[Q]) -> int:
            handed_out = list(some)
            for question in handed_out:
                todo.put(question)
            return len(handed_out)

        # Daemons: an interrupt must not wait for jobs that take minutes.
        threads = [threading.Thread(target=work, daemon=True) for _ in range(pace.most)]
        for thread in threads:
            thread.start()
        try:
            # Questions are taken here, in the thread of the caller's iterator, and as few as keep the threads busy.
            unfinished = hand_out(islice(questions, 2 * pace.most))
            while unfinished:
                result = done.get()
                if isinstance(result, BaseException):
                    raise result
                unfinished += hand_out(islice(questions, 1)) - 1
                yield result[0]
        finally:
            stop.set()
            ended.set()
            for _ in threads:
                todo.put(None)
            until = time.monotonic() + END_SECONDS
            for thread in threads:
                thread.join(max(0.0, until - time.monotonic()))
