"""What is done by the clock: leases, jobs of processes that have ended, progress, webhooks, and cleaning up."""

import logging
import threading
import time
from collections.abc import Callable

from sqlalchemy.exc import SQLAlchemyError

from cow_service.concurrency import BackgroundThread
from cow_service.errors import CowError
from cow_service.jobs.cleaning import CLEAN_UP_SECONDS, clean_up
from cow_service.jobs.computing import EngineParts
from cow_service.jobs.loop import JobLoop
from cow_service.jobs.processes import Processes
from cow_service.jobs.webhooks import Webhooks
from cow_service.records.stages import At

TICK_SECONDS, QUIET_TICK_SECONDS = 1.0, 5.0  # between two rounds, and while there are no jobs
TELL_SECONDS = 2.0  # between two signs of life
CHECK_SECONDS = 5.0  # between two comparisons of the jobs that this process has with those that it works on
STOP_SECONDS = 5.0  # a thread that waits for a database that is down does not keep the process

log = logging.getLogger("cow_service")


class Ticker(BackgroundThread):
    """The thread of it. What may take minutes has one of its own."""

    def __init__(self, parts: EngineParts, loop: JobLoop, processes: Processes, webhooks: Webhooks) -> None:
        super().__init__("cow-ticker", STOP_SECONDS)
        self._parts, self._loop = parts, loop
        self._idle: set[str] = set()  # jobs of this process that no thread worked on at the last check
        self._told: dict[str, At] = {}  # how far jobs were when others were last told
        self._was_quiet = False
        self._cleaning: threading.Thread | None = None
        # What it does, and the seconds between two times.
        keep, tell = parts.database.keep, processes.tell
        of_many = {keep: 0.0, self.recover: 0.0, self._tell_progress: 0.0, tell: TELL_SECONDS}
        of_all = {self.check_jobs: CHECK_SECONDS, webhooks.send_due: 0.0, self._close_idle_connections: 0.0}
        of_all[self._clean_up] = CLEAN_UP_SECONDS
        self._duties = (of_many if parts.database.is_shared else {}) | of_all

    def run(self) -> None:
        """Does each duty when it is due. Errors are logged only: this goes on whatever happens."""
        # Recovered jobs refer to their artifacts before any are removed.
        begun = {duty: time.monotonic() if duty == self._clean_up else 0.0 for duty in self._duties}
        while not self._stop.is_set():
            for duty, seconds in self._duties.items():
                if (now := time.monotonic()) - begun[duty] >= seconds:
                    begun[duty] = now
                    _attempt(duty)
            active = self._parts.active
            active.stirred.clear()
            if active.is_quiet and not self._stop.is_set():
                active.stirred.wait(QUIET_TICK_SECONDS)
            else:
                self._stop.wait(TICK_SECONDS)

    def stop(self) -> None:
        """Ends the thread."""
        self._stop.set()
        self._parts.active.stirred.set()
        super().stop()

    def recover(self) -> None:
        """Has the jobs of processes that have ended done by others."""
        if others := self._parts.jobs.executors() - {self._parts.executor}:
            self._parts.active.stir()  # while others have jobs, it is looked often whether they have ended
            with self._parts.database.ended(others) as ended:
                if ended and self._parts.jobs.recover(ended):
                    self._loop.wake()

    def check_jobs(self) -> None:
        """Ends work on jobs that this process no longer has, and gives back those that it does not work on.

        Another process may have canceled or deleted a job, or taken it while this one was frozen; a thread could not be
        started, or the answer that the job is taken was lost.
        """
        active, jobs = self._parts.active, self._parts.jobs
        running = active.runs()  # first: what is taken meanwhile is not at work by then
        taken = jobs.taken_by(self._parts.executor)
        for job_id, run in running.items():
            if taken.get(job_id) != run:
                active.request_cancel(job_id)
        idle = taken.keys() - running.keys()
        for job_id in idle & self._idle:  # at the last check, too: it is not just being started
            jobs.release(job_id, taken[job_id], "nothing works on it")
            self._loop.wake()
        self._idle = idle

    def _tell_progress(self) -> None:
        at = {job: at for job in self._parts.active.runs() if (at := self._parts.active.at(job)) is not None}
        if news := {job: one for job, one in at.items() if one != self._told.get(job) and one[0] is not None}:
            self._parts.jobs.tell_progress(news)
        self._told = at

    def _close_idle_connections(self) -> None:
        """Once there are no jobs for a while."""
        was_quiet, self._was_quiet = self._was_quiet, self._parts.active.is_quiet
        if self._was_quiet and not was_quiet:
            self._parts.database.close_idle()

    def _clean_up(self) -> None:
        if self._cleaning is None or not self._cleaning.is_alive():
            work = (lambda: clean_up(self._parts, self._stop.is_set),)
            self._cleaning = threading.Thread(target=_attempt, args=work, name="cow-clean-up", daemon=True)
            self._cleaning.start()


def _attempt(duty: Callable[[], None]) -> None:
    try:
        duty()
    except (CowError, SQLAlchemyError) as error:
        log.warning("%s", getattr(error, "detail", type(error).__name__))
    except Exception:
        log.exception("what is due by the clock failed")
