"""The jobs that this process runs or waits for: progress, cancellation requests, decoded images, waiting callers."""

import asyncio
import threading
import time
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass, field

from cow_service.errors import Canceled, CowError
from cow_service.records import JobKind, WorkerJob
from cow_service.records.stages import At, Stage, is_ahead, share_done

QUIET_SECONDS = 30.0  # without a job that anybody runs or waits for, after which a process looks for some more rarely
MAX_ELSEWHERE = 10_000  # jobs whose progress in other processes is remembered


@dataclass(eq=False)
class ActiveJob:
    """One job that this process works on."""

    kind: JobKind
    run: str = ""  # the attempt
    at: At = (None, 0.0)  # one value, read at once
    cancel_requested: threading.Event = field(default_factory=threading.Event)
    begun: float | None = None  # when its first stage began (`time.monotonic`)

    def check(self) -> None:
        """Raises `Canceled` if its end was requested."""
        if self.cancel_requested.is_set():
            raise Canceled("The job was canceled.")


@dataclass(eq=False)
class Waiter:
    """A caller on an event loop who wants to hear of a job."""

    loop: asyncio.AbstractEventLoop
    changed: asyncio.Event = field(default_factory=asyncio.Event)  # progress, or the end
    ended: asyncio.Event = field(default_factory=asyncio.Event)  # the database has the answer
    refusal: CowError | None = None  # why callers may not wait here any longer

    def notify(self, refusal: CowError | None) -> None:
        """The job has ended, or is not waited for any more."""
        self.refusal = refusal or self.refusal
        self.ended.set()
        self.changed.set()


class ActiveJobs:
    """The jobs that this process runs or waits for. Safe to use from every thread.

    An idempotency key that is used again after its job was deleted gives the same id: a message about an id may be
    about the earlier job. What became of a job is therefore read from the database alone.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: dict[str, ActiveJob] = {}
        self._elsewhere: dict[str, At] = {}  # how far jobs are that other processes run
        self._waiters: dict[str, list[Waiter]] = {}
        self.stirred = threading.Event()  # set by each sign of a job
        self._busy_at = time.monotonic()  # when there was last one

    @property
    def is_quiet(self) -> bool:
        """Whether there was no sign of a job for a while."""
        return not (self._running or self._waiters) and time.monotonic() - self._busy_at > QUIET_SECONDS

    def stir(self) -> None:
        """There is a sign of a job."""
        self._busy_at = time.monotonic()
        self.stirred.set()

    def begin(self, job: str, kind: JobKind, run: str) -> ActiveJob:
        """An attempt to compute a job begins."""
        active = ActiveJob(kind, run)
        self.stir()
        with self._lock:
            self._running[job] = active
        return active

    def end(self, job: str, active: ActiveJob) -> None:
        """The attempt is over."""
        with self._lock:
            if self._running.get(job) is active:  # else another job of the same id runs by now
                del self._running[job]
        self._busy_at = time.monotonic()

    def progress(self, job: str, active: ActiveJob, stage: Stage | None, done: float) -> None:
        """Notes how far a job is, never less than before, and wakes its waiters. Raises `Canceled` on request."""
        active.check()
        if is_ahead((stage, done), active.at):
            active.begun = active.begun or time.monotonic()
            active.at = stage, done
            self._wake(job)

    def get(self, job: str) -> ActiveJob | None:
        """The state of a job that this process runs."""
        with self._lock:
            return self._running.get(job)

    def describe(self, jobs: Iterable[str]) -> tuple[WorkerJob, ...]:
        """Those of some jobs that this process runs and whose first stage has begun."""
        found: list[WorkerJob] = []
        for job_id in jobs:
            active = self.get(job_id)
            if active is not None and active.begun is not None:
                stage, done = active.at
                progress, seconds = share_done(active.kind, stage, done), round(time.monotonic() - active.begun, 1)
                found.append(WorkerJob(id=job_id, kind=active.kind, stage=stage, progress=progress, seconds=seconds))
        return tuple(found)

    def at(self, job: str) -> At | None:
        """The stage of a job in any process, and the share of that stage that is done; None if that is not known."""
        active = self.get(job)
        return self._elsewhere.get(job) if active is None else active.at

    def all_at(self) -> dict[str, At]:
        """As `at`, for all known jobs.

        To be asked before the database is: a job may end in between, and would seem not to have begun.
        """
        with self._lock:
            return self._elsewhere | {job: active.at for job, active in self._running.items()}

    def set_progress_elsewhere(self, job: str, stage: Stage | None, done: float) -> None:
        """Notes how far a job is that another process computes, and wakes its waiters."""
        self.stir()
        if self.get(job) is None:
            self._elsewhere[job] = stage, done
            if len(self._elsewhere) > MAX_ELSEWHERE:  # of some the end was not heard
                del self._elsewhere[next(iter(self._elsewhere))]
            self._wake(job)

    def awaited(self, *, elsewhere: bool = False) -> list[str]:
        """The jobs that callers of this process wait for, or those of them that it does not run."""
        with self._lock:
            return [job for job in self._waiters if not (elsewhere and job in self._running)]

    def runs(self) -> dict[str, str]:
        """The jobs that this process works on, and its attempts."""
        with self._lock:
            return {job: active.run for job, active in self._running.items()}

    def request_cancel(self, job: str) -> None:
        """Has the work on a job end at its next step, where this process does it."""
        if (active := self.get(job)) is not None:
            active.cancel_requested.set()

    @contextmanager
    def waiting(self, job: str) -> Generator[Waiter]:
        """Around a wait for a job, on the running event loop."""
        waiter = Waiter(asyncio.get_running_loop())
        self.stir()
        with self._lock:
            self._waiters.setdefault(job, []).append(waiter)
        try:
            yield waiter
        finally:
            with self._lock:
                self._waiters[job].remove(waiter)
                if not self._waiters[job]:
                    del self._waiters[job]

    def notify_ended(self, job: str, refusal: CowError | None = None) -> None:
        """Tells waiters that a job has ended, or why they may not wait for it here any longer."""
        self._elsewhere.pop(job, None)
        for waiter in self._waiters_of(job):
            waiter.loop.call_soon_threadsafe(waiter.notify, refusal)

    def _wake(self, job: str) -> None:
        for waiter in self._waiters_of(job):
            waiter.loop.call_soon_threadsafe(waiter.changed.set)

    def _waiters_of(self, job: str) -> list[Waiter]:
        with self._lock:
            return [waiter for waiter in self._waiters.get(job, []) if not waiter.loop.is_closed()]
