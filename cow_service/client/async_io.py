"""How `AsyncClient` waits: on the event loop. `sync_io.py` has the same names for `Client`, which waits in threads."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Coroutine, Iterator
from typing import Any, TypeVar

Q = TypeVar("Q")
R = TypeVar("R")


async def sleep(seconds: float) -> None:
    """Waits."""
    await asyncio.sleep(seconds)


async def call_blocking(function: Callable[[], R]) -> R:
    """Calls a function that blocks, in a thread."""
    return await asyncio.to_thread(function)


def raise_if_stopped() -> None:
    """Does nothing: tasks are canceled from outside."""


def picture_bytes(files: Any, sha256: str) -> bytes | None:
    """An artifact for a notebook, where it has been downloaded: nobody can await while a notebook shows a result."""
    return files.held.get(sha256)


class Shield:
    """Work that goes on when its caller is canceled."""

    def __init__(self) -> None:
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Does the work in a task of its own: whoever is canceled may be canceled again before it is done."""
        task = asyncio.create_task(work())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        await asyncio.shield(task)

    async def wait(self) -> None:
        """Waits for all of it."""
        await asyncio.gather(*self._tasks, return_exceptions=True)


async def map_concurrently(
    ask: Callable[[Q], Coroutine[Any, Any, R]], questions: Iterator[Q], concurrency: int
) -> AsyncGenerator[R]:
    """Asks so many questions at the same time, and yields each result as it comes."""
    tasks: set[asyncio.Task[R]] = set()
    try:
        while True:
            while len(tasks) < concurrency and (question := next(questions, None)) is not None:
                tasks.add(asyncio.create_task(ask(question)))
            if not tasks:
                return
            done, tasks = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                yield task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
