"""The loop of the jobs: it takes them from the queues while there are places, and computes each in a thread.

The table of jobs (`job_table.py`) says who computes which job: where its process ends, another process makes the next
attempt.
"""

import logging
import math
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import replace

from cow_service.concurrency import BackgroundThread
from cow_service.errors import Canceled, CowError, StorageUnavailable, unforeseen
from cow_service.jobs.active import ActiveJob
from cow_service.jobs.computing import Computer, EngineParts, Outages, Work
from cow_service.jobs.job_table import TakenJob
from cow_service.observability import logging as context
from cow_service.observability import tracing
from cow_service.records import Stage

LOOK_SECONDS, WAITING_SECONDS = 20.0, 2.0  # between two looks besides whenever it is woken, and while jobs wait
RETRY_SECONDS = 0.5  # after a look that failed
STOP_SECONDS = 5.0  # a thread that waits for a database that is down does not keep the process

log = logging.getLogger("cow_service")


class JobLoop(BackgroundThread):
    """Computes the jobs of this process. Safe to use from every thread."""

    def __init__(self, parts: EngineParts, computer: Computer) -> None:
        super().__init__("cow-jobs", STOP_SECONDS)
        self._parts, self._jobs, self._active, self._computer = parts, parts.jobs, parts.active, computer
        self._lock = threading.Lock()
        self._held: Counter[str] = Counter()  # the places of each queue that jobs have
        self._threads: list[threading.Thread] = []
        self._woken = threading.Event()
        self._some_wait = True  # jobs may wait for a place

    def wake(self) -> None:
        """Has it look at the queues now: there may be a job, or is a place."""
        self._woken.set()

    def drain(self) -> None:
        """Takes no more jobs."""
        self._stop.set()
        self._woken.set()

    def stop(self) -> None:
        """Ends the thread. Those of jobs go on."""
        self.drain()
        super().stop()

    def wait(self, seconds: float) -> None:
        """Waits until no job is at work, at most so long."""
        until = time.monotonic() + seconds
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))

    def run(self) -> None:
        """Starts what waits in the queues."""
        while not self._stop.is_set():
            self._woken.clear()
            self._some_wait, pause = True, RETRY_SECONDS
            try:
                self._some_wait = sum(self._fill(queue) for queue in self._jobs.waiting_queues()) > 0
                pause = WAITING_SECONDS if self._some_wait else LOOK_SECONDS  # a Ray cluster may grow
            except CowError as error:
                log.warning("no jobs are taken: %s", error.detail)
            except Exception:
                log.exception("no jobs were taken")
            self._woken.wait(pause)

    def _fill(self, queue: str) -> bool:
        """Whether some of the queue may wait still."""
        places = self._computer.capacity(queue) - self._held[queue]
        if places <= 0 or self._stop.is_set():
            return True
        limit = self._parts.service.settings.running_limit_per_key
        taken = self._jobs.take(queue, self._parts.executor, places, limit)
        for job in taken:
            with self._lock:
                self._held[queue] += 1
            running = self._active.begin(job.id, job.spec.kind, job.run)
            thread = threading.Thread(target=self._run, args=(job, running), name=f"job-{job.id}", daemon=True)
            self._threads = [*(each for each in self._threads if each.is_alive()), thread]
            try:
                thread.start()
            except RuntimeError as error:  # the system gives no more threads; the ticker gives the job back
                log.warning("job %s could not be started: %s", job.id, error)
                self._threads.remove(thread)
                self._finish(job, running)
        return len(taken) == places or limit is not None

    def _run(self, job: TakenJob, running: ActiveJob) -> None:
        """Computes a job, stores its outcome, and notifies who waits for it."""
        ended = False
        try:
            with (
                context.bound(request=job.spec.request_id, job=job.id),
                tracing.span(f"job {job.spec.kind}", parent=job.spec.traceparent, job_id=job.id),
            ):
                ended = self._compute(job, running)
        except Exception:
            log.exception("the outcome of job %s could not be stored", job.id)
        finally:
            self._finish(job, running)
            if ended:
                self._active.notify_ended(job.id)
            else:
                self.wake()  # it may be in its queue again

    def _finish(self, job: TakenJob, running: ActiveJob) -> None:
        self._active.end(job.id, running)
        with self._lock:
            self._held[job.queue] -= 1
        if self._some_wait:
            self.wake()

    def _compute(self, job: TakenJob, running: ActiveJob) -> bool:
        """Whether the result or the error of a job is stored; not where it was canceled."""
        metrics, begun = self._parts.service.metrics, False

        def progress(stage: Stage | None, done: float) -> None:
            nonlocal begun
            self._active.progress(job.id, running, stage, done)
            if stage is not None and not begun:
                with suppress(StorageUnavailable):  # it is tried again
                    begun = self._jobs.begin(job, stage, done)
                    if not begun:
                        raise Canceled("The job was canceled.")

        traced = replace(job, spec=job.spec.model_copy(update={"traceparent": context.traceparent()}))
        patient = Outages(math.inf, running.check)  # the work is done: its outcome is not given up
        try:
            try:
                computed = self._computer.compute(Work(traced, progress, running.check, metrics.stage_cache))
                for stage, seconds in computed.timings.items():
                    metrics.stage_seconds.labels(stage).observe(seconds)
                given = job, computed.result, computed.trajectory_key, computed.stages, computed.answer
                status, stored = "succeeded", patient.wait_through(lambda: self._jobs.succeed(*given))
            except Canceled:
                raise
            except Exception as error:
                if isinstance(error, CowError):
                    log.info("job %s failed: %s", job.id, error.code)  # its detail may hold what was asked
                    failure = error
                else:
                    log.exception("job %s failed", job.id)
                    failure = unforeseen()
                status, stored = "failed", patient.wait_through(lambda: self._jobs.fail(job, failure))
            if not stored:
                raise Canceled("Another process has the job, or a stored stage of it is missing.")
        except Canceled as why:
            with suppress(StorageUnavailable):  # else when this process has ended, or the ticker notices
                told = "this process stops" if self._stop.is_set() else why.detail
                self._jobs.release(job.id, job.run, told)  # it was interrupted; one that was canceled stays so
            return False
        metrics.jobs.labels(job.spec.kind, status).inc()
        return True
