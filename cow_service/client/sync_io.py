"""How `Client` waits: it blocks, in threads of its own where it asks many questions. The twin of `async_io.py`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from itertools import islice
from queue import SimpleQueue
from typing import Any, TypeVar

from cow_service.errors import CowError

Q = TypeVar("Q")
R = TypeVar("R")
END_SECONDS = 0.5  # that threads are given to end before their connections are closed
_thread = threading.local()  # `stop`: the event that ends what a thread of `map_concurrently` does


class Stopped(BaseException):
    """The batch that this thread works for has ended."""


def sleep(seconds: float) -> None:
    """Waits. Raises `Stopped`."""
    stop: threading.Event | None = getattr(_thread, "stop", None)
    if stop is None:
        time.sleep(seconds)
    else:
        stop.wait(seconds)
        raise_if_stopped()


def call_blocking(function: Callable[[], R]) -> R:
    """Calls a function that blocks."""
    return function()


def raise_if_stopped() -> None:
    """Raises `Stopped` in a thread whose batch has ended."""
    stop: threading.Event | None = getattr(_thread, "stop", None)
    if stop is not None and stop.is_set():
        raise Stopped


def picture_bytes(files: Any, sha256: str) -> bytes | None:
    """An artifact for a notebook, which is downloaded where it is missing.

    None after a download has failed, so that a notebook does not hang.
    """
    if not files.download_failed:
        try:
            return files.fetch(sha256)
        except (CowError, ValueError):
            files.download_failed = True
    return files.held.get(sha256)


class Shield:
    """Work that is done to its end even in a thread that was stopped."""

    def run(self, work: Callable[[], None]) -> None:
        """Does the work."""
        stop, _thread.stop = getattr(_thread, "stop", None), None
        try:
            work()
        finally:
            _thread.stop = stop

    def wait(self) -> None:
        """Does nothing: `run` has waited."""


def map_concurrently(ask: Callable[[Q], R], questions: Iterator[Q], concurrency: int) -> Generator[R]:
    """Asks so many questions at the same time, in threads that end with the process; yields each result as it comes.

    Raises what `ask` raises. Whoever stops in between leaves jobs on the server which a batch with a journal finds
    again; without one they are canceled.
    """
    todo: SimpleQueue[Q | None] = SimpleQueue()
    done: SimpleQueue[tuple[R] | BaseException] = SimpleQueue()
    stop = threading.Event()

    def work() -> None:
        """One thread: question after question, until there is none or the batch has ended."""
        _thread.stop = stop
        try:
            while (question := todo.get()) is not None and not stop.is_set():
                done.put((ask(question),))
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
    threads = [threading.Thread(target=work, daemon=True) for _ in range(concurrency)]
    for thread in threads:
        thread.start()
    try:
        # Questions are taken here, in the thread of the caller's iterator, and as few as keep the threads busy.
        unfinished = hand_out(islice(questions, 2 * concurrency))
        while unfinished:
            result = done.get()
            if isinstance(result, BaseException):
                raise result
            unfinished += hand_out(islice(questions, 1)) - 1
            yield result[0]
    finally:
        stop.set()
        for _ in threads:
            todo.put(None)
        until = time.monotonic() + END_SECONDS
        for thread in threads:
            thread.join(max(0.0, until - time.monotonic()))
