"""The job engine: accepts jobs, has them computed durably, and reports their state.

A job is a row of the job database, in the database before its submission is acknowledged. It waits in the queue of its
generator, from which any process on the same database may take it.
"""

import logging
import threading
import uuid
from collections.abc import Callable, Iterable
from functools import partial
from http import HTTPStatus

from cow_service import errors
from cow_service.errors import CowError
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.cleaning import remove
from cow_service.jobs.computing import Computer, EngineParts, InProcess
from cow_service.jobs.database import Notification
from cow_service.jobs.job_table import JobFilters, JobSpec, JobState, JobTable
from cow_service.jobs.loop import JobLoop
from cow_service.jobs.opening import open_database
from cow_service.jobs.processes import Processes
from cow_service.jobs.queues import queue_of, step_of
from cow_service.jobs.readiness import StorageCheck
from cow_service.jobs.ticker import Ticker
from cow_service.jobs.webhooks import Webhooks
from cow_service.records import TERMINAL, AcceptedRequest, JobPage, ProcessRole
from cow_service.service import Service
from cow_service.settings import SettingsError

FIRST_WAIT, LONGEST_WAIT = 1.0, 5.0  # seconds between two tries to start
HANDOVER_SECONDS = 3.0  # for interrupted jobs to end, after the grace period

log = logging.getLogger("cow_service")


class JobEngine:
    """Runs the jobs of one service, from `start` to `close`. Its methods block: not for an event loop.

    Those for callers raise `StorageUnavailable` where the database is away; jobs wait for it.
    """

    def __init__(self, service: Service, computer: Computer | None = None, role: ProcessRole | None = None) -> None:
        """`computer`: computes the jobs; by default in this process. `role`: by default that of the settings."""
        self.service, self.database, self.active = service, open_database(service.settings), ActiveJobs()
        self.jobs = JobTable(self.database)
        self._parts = EngineParts(service, self.database, self.jobs, self.active)
        self._computer = computer or InProcess(self._parts)
        self._loop = JobLoop(self._parts, self._computer)
        self.processes, self.webhooks = Processes(self._parts, self._computer, role), Webhooks(self._parts)
        self._ticker = Ticker(self._parts, self._loop, self.processes, self.webhooks)
        self.storage = StorageCheck(service.artifacts)
        self.is_running = False
        self._stopping = False
        self._waits_for = ""  # what keeps it from starting
        self._grace: threading.Timer | None = None  # until running jobs are interrupted
        self._submitting = threading.Lock()
        if not self.database.is_shared and (role or service.settings.role) != "all":
            raise SettingsError(
                "Bad settings: a server that computes nothing (COW_ROLE=api), and `cow worker`, need a job database on "
                "PostgreSQL (COW_DATABASE_URL): with a file one server does all."
            )

    def start_when_possible(self, stop: threading.Event) -> None:
        """Starts, and waits while storage is away, until `stop` is set. Raises `SettingsError`."""
        pause = FIRST_WAIT
        while not stop.is_set():
            try:
                self.start()
            except errors.StorageUnavailable as error:
                self._waits_for = error.detail
                cause = str(getattr(error.__cause__, "orig", error.__cause__) or "").partition("\n")[0]
                told = f"{error.detail} ({cause})" if cause else error.detail  # the operator may see addresses
                log.warning("%s Next try in %g s.", told, pause)
                stop.wait(pause)
                pause = min(2 * pause, LONGEST_WAIT)
            else:
                return

    def start(self) -> None:
        """Opens the database and recovers the jobs that were interrupted.

        Raises `StorageUnavailable`, and `SettingsError` where waiting would not help.
        """
        settings = self.service.settings
        self.service.artifacts.check()
        try:
            self._parts.executor = self.database.acquire()
            self.database.prepare(migrate=settings.migrate)
            self.database.claim(self.service.artifacts.address)  # it writes, as jobs do
            self._ticker.recover()
        except BaseException:
            self.database.release()
            raise
        self.database.watch(self._receive)
        self._stopping = False
        for part in (self._computer, self._loop, self.processes, self._ticker):
            part.start()
        self.is_running = True

    def drain(self) -> None:
        """Stops accepting jobs, and answers callers who wait for a job that does not run.

        Running jobs have the grace period of the settings; after it their callers are answered, too.
        """
        if not self._stopping:
            self._stopping = True
            self._loop.drain()
            self.processes.drain()
            self._grace = threading.Timer(self.service.settings.shutdown_grace, self._interrupt)
            self._grace.daemon = True
            self._grace.start()
        self._notify_stopping(self.active.awaited(elsewhere=True))

    def close(self) -> None:
        """Waits for running jobs during the grace period, then interrupts them: they continue after the next start."""
        self.drain()
        self._loop.stop()
        self._loop.wait(self.service.settings.shutdown_grace + HANDOVER_SECONDS)
        self._ticker.stop()
        if self._grace is not None:
            self._grace.cancel()
        self._interrupt()
        self.processes.stop()
        self._computer.close()
        self.database.release()
        self.database.close()
        self.is_running = False

    def check(self) -> None:
        """Raises `StorageUnavailable` if the database does not answer, `ShuttingDown` where the engine stops,
        `NotReady` where jobs wait that no process takes."""
        if self._stopping:
            raise errors.ShuttingDown("The server is stopping. Ask another one, or ask again later.")
        if not self.is_running:
            raise self.not_started()
        self.database.check()
        self.processes.check_served()

    def not_started(self) -> CowError:
        """Why nothing can be asked yet."""
        if self._waits_for:
            return errors.StorageUnavailable(f"{self._waits_for} The server starts when it can be used.")
        return errors.NotReady("The server is starting. Ask again later.")

    def check_capacity(self, owner: str | None) -> None:
        """Raises `QueueFull` if another job would be too many, `ShuttingDown` where none is accepted."""
        if self._stopping:
            raise errors.ShuttingDown("The server is stopping and takes no more jobs. Send the request again later.")
        self._check_open(owner, *self.jobs.count_open(owner))

    def _check_open(self, owner: str | None, jobs: int, own: int) -> None:
        """Raises `QueueFull` if so many open jobs, and so many of the owner, leave no room for another one."""
        limit, own_limit = self.service.settings.queue_limit, self.service.settings.own_queue_limit
        if jobs >= limit:
            raise errors.QueueFull(
                f"{jobs} jobs wait or run, and COW_QUEUE_LIMIT is {limit}. Send the request again later."
            )
        if owner is not None and own_limit < limit and own >= own_limit:
            raise errors.QueueFull(
                f"{own} jobs of your key wait or run, and COW_QUEUE_LIMIT_PER_KEY is {own_limit}. Send the request "
                "again when some of them have ended."
            )

    def submit(self, job_id: str, spec: JobSpec, owner: str | None, key: str | None, keep: Callable[[], None]) -> bool:
        """Accepts a job; returns whether it is new. It is in the database when this returns.

        `keep` stores what the job needs. It is called before the job is inserted, where nothing speaks against that.
        `key` is the caller's idempotency key: the same key and spec come to the same job, but for one that was refused
        with 503 (an MLLM or a disk that was away): that is tried again.

        Raises `IdempotencyKeyReused`, `QueueFull`, `ShuttingDown`, `StorageUnavailable`.
        """
        if key is None:
            return self._submit(job_id, spec, owner, keep)
        while True:
            known = self.jobs.spec(job_id)
            if known is None:
                self.check_capacity(owner)  # without a key this was done before the body came
                if self._submit(job_id, spec, owner, keep):
                    return True
                continue  # another request with the same key was faster
            if known.digest != spec.digest:
                raise errors.IdempotencyKeyReused(
                    "This Idempotency-Key was used for another request before. Give every request its own key."
                )
            found = self.jobs.find(job_id, None, full=False)
            if found is None:
                continue  # it was deleted just now
            if found.error is None or found.error.status != HTTPStatus.SERVICE_UNAVAILABLE:
                return False
            remove(self._parts, [job_id], 0)

    def _submit(self, job_id: str, spec: JobSpec, owner: str | None, keep: Callable[[], None]) -> bool:
        keep()
        settings = self.service.settings
        queue = queue_of(spec.reader, spec.generator, settings)
        step = step_of(settings.key_weights.get(owner or "", 1.0))
        if self._stopping:
            self.check_capacity(owner)
        with self._submitting:  # the number of jobs must not change between the check and the insertion
            is_new = self.jobs.add(job_id, spec, owner, queue, step, partial(self._check_open, owner))
        if is_new:
            self._loop.wake()
        return is_new

    def find(self, job_id: str, owner: str | None, *, full: bool = True) -> JobState:
        """The state of a job. Raises `JobNotFound`, also for the job of another owner."""
        found = self.jobs.find(job_id, self.active.at(job_id), full=full)
        if found is None or (owner is not None and found.owner != owner):
            raise _no_job(job_id)
        return found

    def request_of(self, job_id: str, owner: str | None) -> AcceptedRequest:
        """The request that became a job. Raises as `find` does."""
        self.find(job_id, owner, full=False)
        spec = self.jobs.spec(job_id)
        if spec is None:
            raise _no_job(job_id)
        return spec.accepted()

    def page(self, owner: str | None, filters: JobFilters) -> JobPage:
        """Jobs of an owner, newest first."""
        return self.jobs.page(owner, filters, self.active.all_at())

    def cancel(self, job_id: str, owner: str | None) -> JobState:
        """Cancels a job unless it has ended; a worker stops at its next step."""
        kind = self.find(job_id, owner, full=False).job.kind
        if self.jobs.cancel(job_id):
            self.active.request_cancel(job_id)
            self.active.notify_ended(job_id)
            self._loop.wake()
            self.service.metrics.jobs.labels(kind, "canceled").inc()
        return self.find(job_id, owner)

    def delete(self, job_id: str, owner: str | None) -> None:
        """Cancels a job if it has not ended, and removes it with the artifacts that no other job refers to."""
        found = self.find(job_id, owner, full=False)
        if found.job.status not in TERMINAL:
            found = self.cancel(job_id, owner)
        remove(self._parts, [job_id], found.ended or 0)

    def may_read(self, sha256: str, owner: str | None) -> None:
        """Raises `ArtifactNotFound` for an artifact that no job of the owner refers to."""
        if owner is not None and not self.jobs.may_read(sha256, owner):
            raise errors.ArtifactNotFound(f"No artifact of yours has the SHA-256 {sha256[:64]}.")

    def _receive(self, notification: Notification) -> None:
        """Handles a message of another process about a job."""
        match notification:
            case Notification("queued"):
                self._loop.wake()
            case Notification("progress", job_id, stage, done):
                self.active.set_progress_elsewhere(job_id, stage, done)
            case Notification("canceled", job_id):
                self.active.request_cancel(job_id)
                self.active.notify_ended(job_id)
            case Notification(job_id=job_id):
                self.active.notify_ended(job_id)
                self._loop.wake()  # its key may have another one

    def _interrupt(self) -> None:
        """Has running jobs end without an outcome: they continue after the next start."""
        for job_id in self.active.runs():
            self.active.request_cancel(job_id)
        self._notify_stopping(self.active.awaited())

    def _notify_stopping(self, jobs: Iterable[str]) -> None:
        for job_id in jobs:
            error = errors.ShuttingDown(
                f"The server is stopping. The job {job_id} continues when it is back: GET /jobs/{job_id}.",
                headers={"Location": f"/jobs/{job_id}"},
            )
            self.active.notify_ended(job_id, error)


def new_job_id(owner: str | None, key: str | None) -> str:
    """The id of a job: with an idempotency key always the same for its owner, else a new one."""
    if key is None:
        return str(uuid.uuid4())
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"cow:{owner or ''}:{key}"))


def _no_job(job_id: str) -> errors.JobNotFound:
    return errors.JobNotFound(f"There is no job {job_id[:64]!r}: it was deleted, or is not one of yours.")
