"""One reader of the database per job that somebody follows, however many do."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Generic, TypeVar
from weakref import WeakKeyDictionary

from cow_service.jobs.active import ActiveJobs, Waiter

News = TypeVar("News")


@dataclass(eq=False)
class Watch(Generic[News]):
    """What is known of a job. Its followers are on one event loop."""

    read: Callable[[], News]  # blocks
    is_last: Callable[[News], bool]
    poll_seconds: float  # another process may run the job
    followers: int = 0
    over: bool = False  # nothing more is read: who comes now needs a watch of their own
    _news: News | None = None
    _error: Exception | None = None
    _number: int = 0  # of the news
    _told: asyncio.Event = field(default_factory=asyncio.Event)
    _reading: asyncio.Task[None] | None = None

    async def after(self, number: int) -> tuple[News, int]:
        """The news behind those of a number, once there are any, and their number. Raises what reading them raises."""
        while self._number <= number:
            if self._error is not None:
                raise self._error
            await self._told.wait()
        assert self._news is not None
        return self._news, self._number

    def start(self, active: ActiveJobs, job_id: str) -> None:
        """Begins to read."""
        self._reading = asyncio.create_task(self._read_on(active, job_id))

    def stop(self) -> None:
        """Ends reading: nobody follows any more."""
        if self._reading is not None:
            self._reading.cancel()

    async def _read_on(self, active: ActiveJobs, job_id: str) -> None:
        with active.waiting(job_id) as waiter:
            while True:
                waiter.changed.clear()
                try:
                    news = await asyncio.to_thread(self.read)
                except Exception as error:  # noqa: BLE001 # whoever follows raises it
                    self._error, self.over = error, True
                    self._tell()
                    return
                self.over = self.is_last(news)
                if news != self._news:
                    self._news, self._number = news, self._number + 1
                    self._tell()
                if self.over:
                    return
                await _changed(waiter, self.poll_seconds)

    def _tell(self) -> None:
        self._told.set()
        self._told = asyncio.Event()


class Watches(Generic[News]):
    """The watches of all jobs that are followed, on each event loop."""

    def __init__(self, poll_seconds: float) -> None:
        self._poll_seconds = poll_seconds
        loops: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[str, Watch[News]]] = WeakKeyDictionary()
        self._of_loop = loops

    @contextmanager
    def following(
        self, active: ActiveJobs, job_id: str, read: Callable[[], News], is_last: Callable[[News], bool]
    ) -> Generator[Watch[News]]:
        """Around following a job. The first follower's `read` serves all of them."""
        watches = self._of_loop.setdefault(asyncio.get_running_loop(), {})
        watch = watches.get(job_id)
        if watch is None or watch.over:
            watch = watches[job_id] = Watch(read, is_last, self._poll_seconds)
            watch.start(active, job_id)
        watch.followers += 1
        try:
            yield watch
        finally:
            watch.followers -= 1
            if watch.followers == 0:
                watch.stop()
                if watches.get(job_id) is watch:
                    del watches[job_id]


async def _changed(waiter: Waiter, seconds: float) -> None:
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(waiter.changed.wait(), seconds)
