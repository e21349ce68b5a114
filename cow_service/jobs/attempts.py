"""Attempts to compute a job, each in a thread, and who takes jobs from the queues.

The table of jobs (`job_table.py`) says who computes which job: where its process ends, another process makes the next
attempt.
"""

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import sqlalchemy as sa

from cow_service.concurrency import BackgroundThread
from cow_service.errors import Canceled, CowError, StorageUnavailable, unforeseen
from cow_service.jobs.active import ActiveJob
from cow_service.jobs.computing import Computer, EngineParts, Outages, Work
from cow_service.jobs.job_table import TakenJob
from cow_service.jobs.notifications import Notification, Notifications
from cow_service.observability import logging as context
from cow_service.observability import tracing
from cow_service.requests import Stage

# Between two looks at the queues, besides whenever it is woken: other processes add jobs, too. While there are none,
# those on PostgreSQL say so when there is one.
POLL_SECONDS, QUIET_POLL_SECONDS, QUIET_POSTGRES_SECONDS = 0.25, 2.0, 20.0
STOP_SECONDS = 5.0  # a thread that waits for a database that is down does not keep the process

log = logging.getLogger("cow_service")


class Runner:
    """Computes the jobs of this process. Safe to use from every thread."""

    def __init__(
        self,
        parts: EngineParts,
        computer: Computer,
        notifications: Notifications,
        on_end: Callable[[TakenJob, bool], None],
    ) -> None:
        """`on_end` is called when an attempt is over, with whether the job has ended by it."""
        self._parts, self._jobs, self._active, self._computer = parts, parts.jobs, parts.active, computer
        self._notifications, self._on_end = notifications, on_end
        self._threads: list[threading.Thread] = []

    def start(self, job: TakenJob) -> None:
        """Starts an attempt to compute a job in a thread."""
        thread = threading.Thread(target=self._run, args=(job,), name=f"job-{job.id}", daemon=True)
        try:
            thread.start()
        except RuntimeError as error:  # the system gives no more threads
            log.warning("job %s could not be started: %s", job.id, error)
            self._on_end(job, False)  # maintenance will find it without a worker and requeue it
        else:
            self._threads = [*(each for each in self._threads if each.is_alive()), thread]

    def wait(self, seconds: float) -> None:
        """Waits until no job is at work, at most so long."""
        until = time.monotonic() + seconds
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))

    def _run(self, job: TakenJob) -> None:
        """Computes a job, and stores its outcome."""
        ended = False
        try:
            with (
                context.bound(request=job.spec.request_id, job=job.id),
                tracing.span(f"job {job.spec.kind}", parent=job.spec.traceparent, job_id=job.id),
                self._active.running(job.id, job.spec.kind, job.run) as running,
            ):
                ended = self._compute(job, running)
        except Exception:
            log.exception("the outcome of job %s could not be stored", job.id)
        finally:
            self._on_end(job, ended)

    def _compute(self, job: TakenJob, running: ActiveJob) -> bool:
        """Whether the result or the error of a job is stored; not where it was canceled."""
        metrics, begun = self._parts.service.metrics, False

        def progress(stage: Stage | None, done: float) -> None:
            nonlocal begun
            self._active.progress(job.id, running, stage, done)
            if stage is None:
                return
            if not begun:
                told = Notification("progress", job.id, stage, done)
                with suppress(StorageUnavailable):  # it is tried again
                    begun = self._jobs.begin(job, lambda connection: self._notifications.send_within(connection, told))
                    if not begun:
                        raise Canceled("The job was canceled.")
                return
            self._notifications.send(Notification("progress", job.id, stage, done))

        def tell(connection: sa.Connection) -> None:
            self._notifications.send_within(connection, Notification("ended", job.id))

        traced = replace(job, spec=job.spec.model_copy(update={"traceparent": context.traceparent()}))
        patient = Outages(math.inf, running.check)  # the work is done: its outcome is not given up
        try:
            try:
                computed = self._computer.compute(Work(traced, progress, running.check, metrics.stage_cache))
            except Canceled:
                raise
            except Exception as error:
                if isinstance(error, CowError):
                    log.info("job %s failed: %s", job.id, error.code)  # its detail may hold what was asked
                    failure = error
                else:
                    log.exception("job %s failed", job.id)
                    failure = unforeseen()
                status, stored = "failed", patient.wait_through(lambda: self._jobs.fail(job, failure, tell))
            else:
                for stage, seconds in computed.timings.items():
                    metrics.stage_seconds.labels(stage).observe(seconds)
                given = job, computed.result, computed.trajectory_key, computed.stages, computed.answer, tell
                status, stored = "succeeded", patient.wait_through(lambda: self._jobs.succeed(*given))
            if not stored:
                raise Canceled("Another process has the job, or a stored stage of it is missing.")
        except Canceled:
            with suppress(StorageUnavailable):  # else when this process has ended, or maintenance notices
                if self._jobs.release(job.id, job.run):  # it was interrupted; one that was canceled stays so
                    self._notifications.send(Notification("queued"))
            return False
        metrics.jobs.labels(job.spec.kind, status).inc()
        return True


class Dispatcher(BackgroundThread):
    """The places of this process, and the thread that fills them. Safe to use from every thread."""

    def __init__(
        self,
        parts: EngineParts,
        capacity: Callable[[str], int],
        start: Callable[[TakenJob], None],
        tell_others: Callable[[], None],
    ) -> None:
        """`capacity`: of a queue by its name; `start` begins the work on a taken job, and `tell_others` tells
        other processes that there are jobs for which this one has no place.
        """
        super().__init__("cow-dispatcher", STOP_SECONDS)
        self._parts, self._capacity, self._start, self._tell_others = parts, capacity, start, tell_others
        self._quiet_seconds = QUIET_POSTGRES_SECONDS if parts.database.file is None else QUIET_POLL_SECONDS
        self._places = threading.Lock()
        self._held: Counter[str] = Counter()  # the places of each queue that are held; only the thread takes more
        self._woken = threading.Event()
        self._look = True  # at all queues: there may be jobs that wait
        self._due: Counter[str] = Counter()  # how many jobs are new in each queue

    def drain(self) -> None:
        """Takes no more jobs."""
        self._stop.set()
        self._woken.set()

    def stop(self) -> None:
        """Ends the thread."""
        self.drain()
        super().stop()

    def wake(self, queue: str | None = None) -> None:
        """Has a queue filled now, as there is a new job; or all of them looked at, as there may be, or is a place."""
        with self._places:
            if queue is None:
                self._look = True
            else:
                self._due[queue] += 1
        self._woken.set()

    def free_places(self, queue: str) -> int:
        """How many jobs of a queue could be taken now."""
        return 0 if self._stop.is_set() else self._capacity(queue) - self._held[queue]

    def give_place_back(self, queue: str) -> None:
        """The holder of a place no longer needs it."""
        with self._places:
            self._held[queue] -= 1
        self.wake()

    def run(self) -> None:
        """Starts what waits in the queues."""
        while not self._stop.is_set():
            self._woken.clear()
            with self._places:
                (look, self._look), (due, self._due) = (self._look, False), (self._due, Counter())
            failed = True
            try:
                for queue in self._parts.jobs.waiting_queues() if look else due:
                    self._fill(queue, due[queue])
                failed = False
            except CowError as error:
                log.warning("no jobs are taken: %s", error.detail)
            except Exception:
                log.exception("no jobs were taken")
            is_quiet = self._parts.active.is_quiet and not failed
            if not self._woken.wait(self._quiet_seconds if is_quiet else POLL_SECONDS):
                self._look = True

    def _fill(self, queue: str, new: int) -> None:
        places, limit = self.free_places(queue), self._parts.service.settings.running_limit_per_key
        taken = self._parts.jobs.take(queue, self._parts.executor, places, limit) if places > 0 else []
        if len(taken) < new:
            self._tell_others()
        with self._places:
            self._held[queue] += len(taken)
        for job in taken:
            self._start(job)
