"""The life of a job as a stream of events, each with a number that is the same however often it is read.

Numbers follow from what the database keeps: 1 queued, 2 running, then one for each stage that is done, 100 for the end.
Progress in between has no number: it is not repeated to a client that reconnects. The database is read once for all
who follow a job.
"""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from weakref import WeakKeyDictionary

from cow_service.errors import JobNotFound
from cow_service.jobs.active import ActiveJobs, share_done
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.job_table import JobState
from cow_service.records import TERMINAL, Job

NUMBERED_STAGES = ("gating", "grounding", "generation", "answering")  # motion and trajectory take milliseconds
QUEUED, RUNNING, FIRST_STAGE, END = 1, 2, 3, 100
POLL_SECONDS = 1.0  # another process may run the job


@dataclass(frozen=True)
class JobEvent:
    """One thing that happened to a job; `number` is None for progress."""

    name: str  # queued, running, stage, progress, succeeded, failed, canceled, deleted
    number: int | None
    job: Job | None

    @cached_property
    def data(self) -> str:
        """The job as JSON, written once for all who follow it."""
        return "{}" if self.job is None else self.job.model_dump_json()


@dataclass(frozen=True)
class JobView:
    """A job as it is, and its numbered events so far."""

    found: JobState | None  # None: it was deleted
    events: tuple[JobEvent, ...] = ()
    progress: JobEvent | None = None

    @property
    def is_last(self) -> bool:
        """Whether nothing more will happen to the job."""
        return self.found is None or self.found.job.status in TERMINAL


class Subscription:
    """A job that is followed: the database is read once for all who do. They are on one event loop."""

    def __init__(self, active: ActiveJobs, job_id: str, read: Callable[[], JobView]) -> None:
        """`read` blocks."""
        self.followers = 0
        self.is_over = False  # reading has ended: new followers need another subscription
        self._read = read
        self._view: JobView | None = None
        self._number = 0  # of the view
        self._error: Exception | None = None
        self._changed = asyncio.Event()
        self._reading = asyncio.create_task(self._read_on(active, job_id))

    async def after(self, number: int) -> tuple[JobView, int]:
        """The latest view, once it is not that of a number any more, and its number. Raises what reading raises."""
        while self._view is None or self._number <= number:
            if self._error is not None:
                raise self._error
            await self._changed.wait()
        return self._view, self._number

    def stop(self) -> None:
        """Stops reading: there are no followers left."""
        self._reading.cancel()

    async def _read_on(self, active: ActiveJobs, job_id: str) -> None:
        with active.waiting(job_id) as waiter:
            while not self.is_over:
                waiter.changed.clear()
                try:
                    view = await asyncio.to_thread(self._read)
                except Exception as error:  # noqa: BLE001 # the followers raise it
                    self._error, self.is_over = error, True
                    self._wake()
                    return
                self.is_over = view.is_last
                if view != self._view:
                    self._view, self._number = view, self._number + 1
                    self._wake()
                if not self.is_over:
                    with contextlib.suppress(TimeoutError):
                        await asyncio.wait_for(waiter.changed.wait(), POLL_SECONDS)

    def _wake(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()


_subscriptions: WeakKeyDictionary[asyncio.AbstractEventLoop, dict[str, Subscription]] = WeakKeyDictionary()


@contextmanager
def subscribed(active: ActiveJobs, job_id: str, read: Callable[[], JobView]) -> Generator[Subscription]:
    """Around following a job. The first follower's `read` serves all of them."""
    of_loop = _subscriptions.setdefault(asyncio.get_running_loop(), {})
    subscription = of_loop.get(job_id)
    if subscription is None or subscription.is_over:
        subscription = of_loop[job_id] = Subscription(active, job_id, read)
    subscription.followers += 1
    try:
        yield subscription
    finally:
        subscription.followers -= 1
        if subscription.followers == 0:
            subscription.stop()
            if of_loop.get(job_id) is subscription:
                del of_loop[job_id]


async def follow(engine: JobEngine, job_id: str, after: int) -> AsyncGenerator[JobEvent]:
    """The events of a job after a number, until its end; `deleted` where there is none, or none any more.

    Whether the caller may hear of it was found out before: here is no way left to refuse it.
    """
    sent, reported, number = after, (None, 0.0), 0
    with subscribed(engine.active, job_id, partial(view_of, engine, job_id)) as subscription:
        while True:
            view, number = await subscription.after(number)
            if view.found is None:
                yield JobEvent("deleted", END, None)
                return
            for event in view.events:
                if event.number is not None and event.number > sent:
                    sent = event.number
                    yield event
            if view.is_last:
                return
            job = view.found.job
            now = (job.stage, job.progress)
            if now != reported and job.status == "running" and view.progress is not None:
                reported = now
                yield view.progress


def view_of(engine: JobEngine, job_id: str) -> JobView:
    """A job as the database has it."""
    try:
        found = engine.find(job_id, None, full=False)
    except JobNotFound:
        return JobView(None)
    job = found.job
    begun = job.model_copy(
        update={"status": "running", "progress": 0.0, "stage": None, "problem": None, "finished_at": None}
    )
    events = [JobEvent("queued", QUEUED, begun.model_copy(update={"status": "queued"}))]
    finished = engine.database.finished_stages(job.id)
    stages = [stage for stage in NUMBERED_STAGES if stage in finished]
    if job.status == "running" or stages or job.status in ("succeeded", "failed"):
        events.append(JobEvent("running", RUNNING, begun))
    for place, stage in enumerate(stages):
        done = begun.model_copy(update={"stage": stage, "progress": share_done(job.kind, stage, 1.0)})
        events.append(JobEvent("stage", FIRST_STAGE + place, done))
    if job.status in TERMINAL:
        events.append(JobEvent(job.status, END, job))
    return JobView(found, tuple(events), JobEvent("progress", None, job))
