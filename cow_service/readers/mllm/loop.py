"""An event loop in a thread of its own: connections stay open from one request to the next, whichever thread asks."""

from __future__ import annotations

import asyncio
import concurrent.futures
from collections.abc import Coroutine
from threading import Thread
from typing import Any, TypeVar

from pydantic_ai.models import Model

PATIENCE = 5.0  # seconds that closing waits for connections

T = TypeVar("T")


class Loop:
    """Runs coroutines that ask one model. Ends with the process, or earlier by `close`."""

    def __init__(self, model: Model) -> None:
        self._model = model
        self._loop = asyncio.new_event_loop()
        self._thread = Thread(target=self._loop.run_forever, name="mllm", daemon=True)
        self._closing = False
        self._thread.start()
        self.submit(self._model.__aenter__()).result()

    @property
    def is_closed(self) -> bool:
        """Whether nothing can be submitted any more."""
        return self._closing

    def submit(self, work: Coroutine[Any, Any, T]) -> concurrent.futures.Future[T]:
        """Starts a coroutine; its future may be cancelled."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def close(self) -> None:
        """Gives up what is running, closes the connections and ends the thread. Once is enough, twice does no harm."""
        if self._closing:
            return
        self._closing = True
        concurrent.futures.wait([self.submit(self._end())], PATIENCE)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(PATIENCE)
        if not self._thread.is_alive():
            self._loop.close()

    async def _end(self) -> None:
        running = asyncio.all_tasks() - {asyncio.current_task()}
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        await self._model.__aexit__(None, None, None)
