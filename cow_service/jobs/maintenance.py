"""Background work of a job engine: announces ends, polls for cancellations, recovers jobs, collects garbage."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from dbos import DBOS
from dbos import error as dbos_error
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import CowError
from cow_service.jobs import state
from cow_service.jobs.garbage import collect_artifacts
from cow_service.jobs.leases import Lease
from cow_service.jobs.news import JobNews, News
from cow_service.jobs.open_jobs import OpenJobs
from cow_service.jobs.queues import PREFIX
from cow_service.jobs.recovery import recover
from cow_service.jobs.tidying import give_turn_back, takes_turn, without_job

OUTCOME_POLL_SECONDS = 0.005  # while the database has not got the outcome of finished work
OUTCOME_TIMEOUT_SECONDS = 30.0  # after which waiters are left to their own polling
CANCEL_POLL_SECONDS = 1.0  # for jobs that run here and were canceled by another process, and for processes that ended
STALLED_SECONDS = 10.0  # between checks for stalled jobs
GARBAGE_SECONDS = 600.0  # between garbage collections
TURN_SECONDS = 0.9 * GARBAGE_SECONDS  # since the last one of any process, which may have begun late
# The same where artifacts are listed, which costs seconds for hundreds of thousands. It must be done sooner only where
# they have a budget: without a reference they are kept for an hour anyway.
LISTING_SECONDS = 0.9 * 3600.0
SUBMIT_SECONDS = 5.0  # within which a job is in the database after the reference to its image
MAX_REMOVED_JOBS = 200  # at a time
JOIN_TIMEOUT_SECONDS = 5.0

log = logging.getLogger("cow_service")


class Maintenance:
    """Two threads beside an engine's own."""

    def __init__(self, open_jobs: OpenJobs, lease: Lease, news: News) -> None:
        self._open_jobs = open_jobs
        self._news = news
        self._lease = lease
        self._finished: dict[str, float] = {}  # jobs whose outcome is awaited, and until when
        self._has_finished = threading.Event()
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._idle: set[str] = set()  # jobs of this process that no thread worked on at the last check

    def start(self) -> None:
        """Starts the threads."""
        self._stop.clear()
        for target, name in ((self._announce_ends, "cow-outcomes"), (self._maintain, "cow-maintenance")):
            thread = threading.Thread(target=target, name=name, daemon=True)
            thread.start()
            self._threads.append(thread)

    def stop(self) -> None:
        """Ends the threads; one that waits for a database that is down does not keep the process."""
        self._stop.set()
        self._has_finished.set()
        for thread in self._threads:
            thread.join(JOIN_TIMEOUT_SECONDS)
        self._threads.clear()

    def announce(self, job_id: str) -> None:
        """Has the end of a job announced as soon as the database has its outcome."""
        self._finished[job_id] = time.monotonic() + OUTCOME_TIMEOUT_SECONDS
        self._has_finished.set()

    def collect_garbage(self) -> None:
        """Removes jobs past their retention, and artifacts without references."""
        self._collect_jobs()
        self._collect_artifacts()

    def _collect_jobs(self) -> None:
        open_jobs = self._open_jobs
        before = datetime.now(UTC) - timedelta(hours=open_jobs.service.settings.job_retention_hours)
        while not self._stop.is_set() and (jobs := state.ended_before(before, MAX_REMOVED_JOBS)):
            open_jobs.remove(jobs, before.timestamp())
        # What jobs left that were deleted while they ran. One that is being submitted refers to its image a moment
        # before it is in the database: it is looked for twice.
        missing = without_job(open_jobs.database)
        if missing and not self._stop.wait(SUBMIT_SECONDS):
            open_jobs.database.remove_jobs(sorted(set(missing) & set(without_job(open_jobs.database))))
        if not self._stop.is_set():
            open_jobs.database.give_room_back(self._stop.is_set)

    def _collect_artifacts(self) -> None:
        if not self._stop.is_set():
            collect_artifacts(self._open_jobs.service, self._open_jobs.database, self._stop.is_set)

    def _announce_ends(self) -> None:
        while self._has_finished.wait() and not self._stop.is_set():
            self._has_finished.clear()
            while self._finished and not self._stop.wait(OUTCOME_POLL_SECONDS):
                if not self._logged(self._check_finished):
                    self._stop.wait(CANCEL_POLL_SECONDS)

    def _check_finished(self) -> None:
        now = time.monotonic()
        for job_id, until in list(self._finished.items()):
            if now > until:
                del self._finished[job_id]
                self._open_jobs.active.forget(job_id)
                continue
            found = state.find(job_id, self._open_jobs.active, full=False)
            if found is None or found.ended is not None:
                self._open_jobs.ended(job_id, None)
                self._news.tell(JobNews("ended", job_id))
                del self._finished[job_id]

    def _maintain(self) -> None:
        looked = collected = time.monotonic()  # recovered jobs refer to their artifacts before anything is removed
        while not self._stop.is_set():
            self._logged(self._recover)
            self._logged(self._poll_cancellations)
            now = time.monotonic()
            if now - looked > STALLED_SECONDS:
                looked = now
                self._logged(self._resume_stalled)
                self._logged(self._open_jobs.recount)
            if now - collected > GARBAGE_SECONDS:
                collected = now
                self._logged(self._tidy)
            self._stop.wait(CANCEL_POLL_SECONDS)

    def _tidy(self) -> None:
        database, settings = self._open_jobs.database, self._open_jobs.service.settings
        if takes_turn(database, "jobs", TURN_SECONDS):
            self._collect_jobs()
        seconds = LISTING_SECONDS if settings.artifacts_max_gb is None else TURN_SECONDS
        if self._stop.is_set() or not takes_turn(database, "artifacts", seconds):
            return
        try:
            self._collect_artifacts()
        except BaseException:
            give_turn_back(database, "artifacts")  # an hour is long
            raise

    def _poll_cancellations(self) -> None:
        """Another process may have canceled or deleted a job that runs here, or taken it while this one was frozen."""
        running = self._open_jobs.active.ids()
        if not running:
            return
        ours = {
            one.workflow_id
            for one in state.workflows_of_jobs(workflow_ids=running)
            if one.status != "CANCELLED" and one.executor_id == DBOS.executor_id
        }
        for job_id in set(running) - ours:
            self._open_jobs.active.request_cancel(job_id)

    def _recover(self) -> None:
        """Returns the jobs of processes that have ended to their queues, from which any live process takes them."""
        executors = state.executors_at_work() - {DBOS.executor_id}
        if not executors:
            return
        with self._lease.ended(executors) as ended:
            for job_id in recover(ended):
                log.info("recovering %s", job_id)

    def _resume_stalled(self) -> None:
        """Resumes jobs of this process that no thread works on: their outcome could not be written, for example."""
        pending = state.workflows_of_jobs(status="PENDING", executor_id=DBOS.executor_id)
        idle = {one.workflow_id for one in pending} - set(self._open_jobs.active.ids())
        for one in pending:
            if one.workflow_id in idle & self._idle:  # idle at the last check, too: it is not just being started
                log.warning("job %s was stalled, and is resumed", one.workflow_id)
                DBOS.resume_workflow(one.workflow_id, queue_name=PREFIX + state.queue_of(one))
        self._idle = idle

    def _logged(self, work: Callable[[], None]) -> bool:
        """Whether work succeeded. Errors are logged only: maintenance continues whatever happens."""
        try:
            work()
        except (CowError, dbos_error.DBOSException, SQLAlchemyError) as error:
            log.warning("maintenance: %s", getattr(error, "detail", type(error).__name__))
            return False
        except Exception:
            log.exception("maintenance failed")
            return False
        return True
