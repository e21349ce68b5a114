"""An event loop in a thread of its own: connections stay open from one request to the next, whichever thread asks."""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Coroutine
from threading import Thread
from typing import Any, TypeVar

from pydantic_ai.models import Model

CLOSE_SECONDS = 5.0  # that closing waits for connections

T = TypeVar("T")


class EventLoopThread:
    """Runs the coroutines that call one model. Ends with the process, or earlier by `close`."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._loop = asyncio.new_event_loop()
        # A daemon, so that a reader that nobody closed does not keep the process alive.
        self._thread = Thread(target=self._loop.run_forever, name="mllm", daemon=True)
        self.closed = False
        self._thread.start()
        self.submit(model.__aenter__()).result()

    def submit(self, work: Coroutine[Any, Any, T]) -> concurrent.futures.Future[T]:
        """Starts a coroutine; its future may be canceled."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def close(self) -> None:
        """Cancels what is running, closes the connections and ends the thread. May be called twice."""
        if self.closed:
            return
        self.closed = True
        concurrent.futures.wait([self.submit(self._end())], CLOSE_SECONDS)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(CLOSE_SECONDS)
        if not self._thread.is_alive():
            self._loop.close()

    async def _end(self) -> None:
        running = asyncio.all_tasks() - {asyncio.current_task()}
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        await self._model.__aexit__(None, None, None)
