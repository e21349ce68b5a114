"""What this process knows of jobs that nobody else can know yet: how far they are, who waits, who wants them ended."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

from cow_service.errors import Canceled, CowError
from cow_service.media.images import DecodedImage
from cow_service.requests import Stage

STAGES: tuple[Stage, ...] = ("grounding", "motion", "trajectory", "generation", "answering")
SHARES = (0.1, 0.05, 0.05, 0.7, 0.1)  # of the whole work; of a simulation the last is left out


@dataclass
class Running:
    """One job in the hands of this process."""

    stage: Stage | None = None
    done: float = 0.0  # of the stage
    ended: threading.Event = field(default_factory=threading.Event)  # somebody wants it to end
    over: bool = False  # the work is over, though the database may not have its end yet

    def check(self) -> None:
        """Raises `Canceled` where somebody wants it to end."""
        if self.ended.is_set():
            raise Canceled("The job was canceled.")


@dataclass
class Waiting:
    """Somebody on an event loop who wants to hear of a job. `settled` resolves once it has ended."""

    loop: asyncio.AbstractEventLoop
    changed: asyncio.Event
    settled: asyncio.Future[str | CowError | None]  # the result as JSON where this process has it at hand


class Live:
    """The jobs that this process runs or waits for. Safe to use from every thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: dict[str, Running] = {}
        self._waiting: dict[str, list[Waiting]] = {}
        self._images: dict[str, DecodedImage] = {}

    def lend(self, job: str, image: DecodedImage) -> None:
        """Puts by the pixels of a job that starts at once, so that they are not decoded again."""
        with self._lock:
            self._images[job] = image

    def image(self, job: str) -> DecodedImage | None:
        """The pixels that were put by, once."""
        with self._lock:
            return self._images.pop(job, None)

    @contextmanager
    def running(self, job: str) -> Generator[Running]:
        """Around the work on a job."""
        one = Running()
        with self._lock:
            self._running[job] = one
        try:
            yield one
        finally:
            with self._lock:
                self._images.pop(job, None)
                one.over = True

    def progress(self, job: str, one: Running, stage: Stage | None, done: float) -> None:
        """The work on a job got so far. Raises `Canceled` where somebody wants it to end."""
        one.check()
        if stage is not None and (stage != one.stage or done > one.done):
            one.stage, one.done = stage, done
            self._wake(job)

    def look(self, job: str) -> Running | None:
        """How far a job is, where this process runs it."""
        with self._lock:
            return self._running.get(job)

    def jobs(self) -> list[str]:
        """The jobs that this process runs."""
        with self._lock:
            return [job for job, one in self._running.items() if not one.over]

    def forget(self, job: str) -> None:
        """Nothing is known here any more of a job whose work is over."""
        with self._lock:
            one = self._running.get(job)
            if one is not None and one.over:
                del self._running[job]

    def end(self, job: str) -> None:
        """Has the work on a job end at its next step."""
        one = self.look(job)
        if one is not None:
            one.ended.set()

    @contextmanager
    def waiting(self, job: str) -> Generator[Waiting]:
        """Around a wait for a job, on the running event loop."""
        loop = asyncio.get_running_loop()
        one = Waiting(loop, asyncio.Event(), loop.create_future())
        with self._lock:
            self._waiting.setdefault(job, []).append(one)
        try:
            yield one
        finally:
            with self._lock:
                left = [other for other in self._waiting.get(job, []) if other is not one]
                self._waiting.pop(job, None)
                if left:
                    self._waiting[job] = left
            one.settled.cancel()

    def waited_for(self) -> list[str]:
        """The jobs that somebody waits for here."""
        with self._lock:
            return list(self._waiting)

    def settled(self, job: str, outcome: str | CowError | None) -> None:
        """A job has ended, and the database says so. `outcome` is its result or error where it is at hand."""
        self.forget(job)
        for one in self._listeners(job):
            one.loop.call_soon_threadsafe(_settle, one, outcome)

    def _wake(self, job: str) -> None:
        for one in self._listeners(job):
            one.loop.call_soon_threadsafe(one.changed.set)

    def _listeners(self, job: str) -> list[Waiting]:
        with self._lock:
            return [one for one in self._waiting.get(job, []) if not one.loop.is_closed()]


def share_done(kind: str, stage: str | None, done: float) -> float:
    """Share of all work, 0 to 1, when a stage is so far."""
    shares = SHARES if kind == "answer" else SHARES[:-1]
    if stage not in STAGES[: len(shares)]:
        return 0.0
    place = STAGES.index(stage)
    return round(min(1.0, (sum(shares[:place]) + shares[place] * done) / sum(shares)), 4)


def _settle(one: Waiting, outcome: str | CowError | None) -> None:
    if not one.settled.done():
        one.settled.set_result(outcome)
    one.changed.set()
