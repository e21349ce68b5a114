"""The job engine: accepts job specs, has DBOS run them durably, and reports their state.

One process has one engine, because DBOS is one per process. A job is a DBOS workflow. Where this process can run
it, the workflow starts at once; else it waits in the DBOS queue of its generator, from which any process on the same
database may take it. Either way it is in the database before its submission is acknowledged.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from http import HTTPStatus
from typing import Any, cast

from dbos import DBOS, WorkflowHandle
from dbos import error as dbos_error
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import (
    ArtifactNotFound,
    CowError,
    IdempotencyKeyReused,
    JobNotFound,
    QueueFull,
    ShuttingDown,
)
from cow_service.jobs import state, workflows
from cow_service.jobs.computing import Computer
from cow_service.jobs.database import database_errors
from cow_service.jobs.dispatch import Dispatch, result_of
from cow_service.jobs.in_process import InProcess
from cow_service.jobs.launching import launch
from cow_service.jobs.leases import lease_of
from cow_service.jobs.maintenance import Maintenance
from cow_service.jobs.news import JobNews, news_of
from cow_service.jobs.open_jobs import OpenJobs
from cow_service.jobs.processes import Processes
from cow_service.jobs.queues import QueuePolls, queue_of
from cow_service.jobs.retries import without_retries
from cow_service.jobs.spec import JobSpec
from cow_service.jobs.state import JobFilters, JobState, OpenJob
from cow_service.jobs.storage_check import StorageCheck
from cow_service.jobs.webhooks import Webhooks
from cow_service.jobs.worker import JobAborted, Worker
from cow_service.jobs.workflow_table import move_back
from cow_service.media.images import DecodedImage
from cow_service.records import TERMINAL, AcceptedRequest, JobPage, ProcessRole
from cow_service.requests import Stage
from cow_service.service import Service

HANDOVER_SECONDS = 3.0  # for interrupted jobs to end, after the grace period

log = logging.getLogger("cow_service")


class JobEngine:
    """Runs the jobs of one service, from `start` to `close`. Its methods block: not for an event loop."""

    def __init__(self, service: Service, computer: Computer | None = None, role: ProcessRole | None = None) -> None:
        """`computer`: who computes the jobs; by default this process. `role`: by default that of the settings."""
        self.open_jobs = OpenJobs(service)
        self._computer = computer or InProcess(self.open_jobs)
        self.active, self.database = self.open_jobs.active, self.open_jobs.database
        self.webhooks = Webhooks(service.settings, service.metrics)
        self._lease = lease_of(self.database, service.settings.data_dir / "executors")
        self._polls = QueuePolls(self._computer.capacity, self._followed_of)
        self._news = news_of(self.database, self.active.awaited_elsewhere, state.ended_of)
        self._maintenance = Maintenance(self.open_jobs, self._lease, self._news)
        self.processes = Processes(self.open_jobs, self._computer, role)
        self._stopping = False
        self._grace: threading.Timer | None = None  # until running jobs are interrupted
        self._dispatch = Dispatch()
        self._followed: dict[str, str] = {}  # the queues of jobs started at once, whose end a thread waits for
        self._submit_lock, self._cancel_lock = threading.Lock(), threading.Lock()
        self._threads: ThreadPoolExecutor | None = None
        self.storage = StorageCheck(lambda: self.service.artifacts)

    @property
    def service(self) -> Service:
        """The service that does the work."""
        return self.open_jobs.service

    def use(self, service: Service) -> None:
        """Runs the jobs of another service from now on, on the same database. Only tests do this."""
        self.open_jobs.service = service
        self.webhooks.use(service.settings, service.metrics)

    @property
    def is_running(self) -> bool:
        """Whether it was started and not closed."""
        return self._threads is not None

    def start(self) -> None:
        """Opens the database and recovers the jobs that were interrupted. Raises `StorageUnavailable`."""
        self.service.artifacts.check()
        workflows.set_runner(Worker(self.open_jobs, self.webhooks, self._computer, self._news, self.work_ended))
        try:
            launch(self.database, self.service.settings, self.service.artifacts.address, self._lease.acquire())
        except BaseException:
            self._lease.release()
            raise
        self._stopping = False
        self._computer.start()
        self._threads = ThreadPoolExecutor(thread_name_prefix="cow-job", max_workers=1024)
        self.open_jobs.recount()
        self.processes.start()
        self._polls.start()
        self._news.start(self._hear)
        self._maintenance.start()

    def drain(self) -> None:
        """Accepts no more jobs, and answers callers who wait for a job that does not run.

        Running jobs have the grace period of the settings; after it their callers are answered, too.
        """
        if not self._stopping:
            self._stopping = True
            self.processes.drain()
            self._grace = threading.Timer(self.service.settings.shutdown_grace, self._interrupt)
            self._grace.daemon = True
            self._grace.start()
        self._notify_stopping(set(self.active.awaited()) - set(self.active.ids()))

    def close(self) -> None:
        """Waits for running jobs during the grace period, then interrupts them: they continue after the next start."""
        self.drain()
        self._maintenance.stop()
        grace = self.service.settings.shutdown_grace
        self._polls.stop()
        self._news.stop()
        # DBOS takes nothing from the queues from here on, and polls once a second whether the work is done.
        DBOS.destroy(workflow_completion_timeout_sec=int(grace + HANDOVER_SECONDS) if self.active.ids() else 0)
        if self._grace is not None:
            self._grace.cancel()
        self._interrupt()
        if self._threads is not None:
            self._threads.shutdown(wait=True, cancel_futures=True)
            self._threads = None
        self.processes.stop()
        self._computer.close()
        workflows.set_runner(None)
        self.database.close()
        self._lease.release()

    def check(self) -> None:
        """Raises `StorageUnavailable` where the database does not answer, `ShuttingDown` where the engine stops,
        `NotReady` where jobs wait that no process takes."""
        if self._stopping:
            raise ShuttingDown("The server is stopping. Ask another one, or this one again in a while.")
        self.database.check()
        self.processes.overview.check_served()

    def check_capacity(self, owner: str | None) -> None:
        """Raises `QueueFull` where another job would be too many, `ShuttingDown` where none is accepted."""
        limit, own_limit = self.service.settings.queue_limit, self.service.settings.own_queue_limit
        if self._stopping:
            raise ShuttingDown("The server is stopping and takes no more jobs. Send the request again in a while.")
        if len(self.open_jobs) >= limit:
            raise QueueFull(
                f"{len(self.open_jobs)} jobs wait or run, and COW_QUEUE_LIMIT is {limit}. Send the request again later."
            )
        if owner is not None and own_limit < limit and (own := self.open_jobs.count_of(owner)) >= own_limit:
            raise QueueFull(
                f"{own} jobs of your key wait or run, and COW_QUEUE_LIMIT_PER_KEY is {own_limit}. Send the request "
                "again when some of them have ended."
            )

    @without_retries
    def submit(self, job_id: str, spec: JobSpec, owner: str | None, key: str | None, image: DecodedImage) -> bool:
        """Accepts a job; returns whether it is new. It is in the database when this returns.

        `key` is the caller's idempotency key: the same key and spec come to the same job, but for one that was refused
        with 503 (an MLLM or a disk that was away): that is tried again.

        Raises `IdempotencyKeyReused`, `QueueFull`, `ShuttingDown`, `StorageUnavailable`.
        """
        self.database.check_server()
        if key is None:
            self._submit(job_id, spec, owner, image)
            return True
        with self._submit_lock:  # no other request of this process may use the key between the check and the insert
            if self._existing(job_id, spec) is not None:
                if not self._was_refused(job_id):
                    return False
                self.open_jobs.remove([job_id], 0)  # its image stays: it was sent just now
            self._submit(job_id, spec, owner, image)
            stored = self._existing(job_id, spec)  # that of another process which was faster with the same key?
            return stored is not None and stored.created_at == spec.created_at

    def _submit(self, job_id: str, spec: JobSpec, owner: str | None, image: DecodedImage) -> None:
        with self.open_jobs.lock:  # the count must not change between the check and the record
            self.check_capacity(owner)
            queue = queue_of(spec.reader, spec.generator, self.service.settings)
            starts_now = self.open_jobs.count(queue) < self._computer.capacity(queue) and not self._runs_enough(owner)
            turn = self.open_jobs.take_turn(owner, queue, spec.priority)
            spec = spec.model_copy(update={"turn": turn.number})
            opened = OpenJob(spec.generator, owner, spec.turn, queue, spec.created_at, spec.priority)
            self.open_jobs.record(job_id, opened)
        self.active.expect(job_id)
        try:
            # Before the job exists: its image and masks must not be removed before work on it starts.
            self.database.add_references(job_id, [image.info.sha256, *spec.masks])
            if starts_now:
                self.active.put_image(job_id, image)
                self._start(job_id, spec, owner, queue)
            else:
                if turn.moves_others:
                    move_back(self.database.engine, owner, queue, spec.priority, turn.number, turn.step)
                self._enqueue(job_id, spec, owner, queue)
        except BaseException:
            self.active.drop_image(job_id)
            self.open_jobs.record(job_id, None)
            raise

    def _runs_enough(self, owner: str | None) -> bool:
        """Whether another job of an owner must wait for the end of others of theirs."""
        limit = self.service.settings.running_limit_per_key
        return owner is not None and limit is not None and self.open_jobs.count_of(owner) >= limit

    @without_retries
    def find(self, job_id: str, owner: str | None, *, full: bool = True) -> JobState:
        """The state of a job. Raises `JobNotFound`, also for the job of another owner."""
        self.database.check_server()
        found = self.open_jobs.find(job_id, full=full)
        if found is None or (owner is not None and found.owner != owner):
            raise _no_job(job_id)
        return found

    @without_retries
    def request_of(self, job_id: str, owner: str | None) -> AcceptedRequest:
        """The request that became a job. Raises as `find` does."""
        self.find(job_id, owner, full=False)
        spec = self._spec(job_id)
        if spec is None:
            raise _no_job(job_id)
        return spec.accepted()

    @without_retries
    def page(self, owner: str | None, filters: JobFilters) -> JobPage:
        """Jobs of an owner, newest first."""
        self.database.check_server()
        return state.page(owner, filters, self.active)

    @without_retries
    def cancel(self, job_id: str, owner: str | None) -> JobState:
        """Cancels a job unless it has ended; a worker stops at its next step."""
        with self._cancel_lock:  # one at a time: a job that has ended does not change
            found = self.find(job_id, owner, full=False)
            if found.job.status in TERMINAL:
                return self.find(job_id, owner)
            spec = self._spec(job_id)
            if spec is not None:
                # Before the cancellation, so that no crash comes between: the delivery waits for it.
                self.webhooks.job_ended(job_id, spec.webhook)
            with database_errors():
                DBOS.cancel_workflow(job_id)
        self.active.request_cancel(job_id)
        self._news.tell(JobNews("canceled", job_id))
        self.open_jobs.ended(job_id, None)
        found = self.find(job_id, owner)
        if found.job.status == "canceled":
            self.service.metrics.job(found.job.kind, "canceled")
        return found

    @without_retries
    def delete(self, job_id: str, owner: str | None) -> None:
        """Cancels a job if it has not ended, and removes it with the artifacts that no other job refers to."""
        found = self.find(job_id, owner, full=False)
        if found.job.status not in TERMINAL:
            found = self.cancel(job_id, owner)
        self.open_jobs.remove([job_id], found.ended or 0)

    @without_retries
    def may_read(self, sha256: str, owner: str | None) -> None:
        """Raises `ArtifactNotFound` for an artifact that no job of the owner refers to."""
        if owner is None:
            return
        jobs = self.database.jobs_with(sha256)
        if not jobs or not state.existing(jobs, owner):
            raise ArtifactNotFound(f"No artifact of yours has the SHA-256 {sha256[:64]}.")

    def work_ended(self, job_id: str) -> None:
        """The work on a job is over in this process. Where no thread waits for its end, maintenance announces it."""
        self._polls.wake()
        if job_id not in self._followed and not self._stopping:
            self._maintenance.announce(job_id)

    def _spec(self, job_id: str) -> JobSpec | None:
        with database_errors():
            status: Any = DBOS.get_workflow_status(job_id)
        return None if status is None else JobSpec.model_validate(status.input["args"][0])

    def _existing(self, job_id: str, spec: JobSpec) -> JobSpec | None:
        """The spec of an idempotency key's job, if it exists. Raises `IdempotencyKeyReused` where it differs."""
        known = self._spec(job_id)
        if known is not None and known.digest != spec.digest:
            raise IdempotencyKeyReused(
                "This Idempotency-Key came with another request before. Give every request a key of its own."
            )
        return known

    def _was_refused(self, job_id: str) -> bool:
        """Whether a job failed for a reason that may be over by now."""
        found = state.find(job_id, self.active)
        return found is not None and found.error is not None and found.error.status == HTTPStatus.SERVICE_UNAVAILABLE

    def _start(self, job_id: str, spec: JobSpec, owner: str | None, queue: str) -> None:
        """Starts a job in this process; it is in the database when this returns."""
        assert self._threads is not None
        self._followed[job_id] = queue
        try:
            handle = self._dispatch.start(job_id, spec, owner, queue)
            self._threads.submit(self._follow, job_id, spec.created_at, handle)
        except BaseException:
            self._followed.pop(job_id, None)
            raise

    def _follow(self, job_id: str, created_at: str, handle: WorkflowHandle[str]) -> None:
        """Waits in a thread of its own until the database has the outcome of a job, and announces it."""
        outcome: str | CowError | None = None
        try:
            outcome = result_of(handle)
        except CowError as error:
            outcome = error
        except (dbos_error.DBOSException, SQLAlchemyError) as error:
            log.info("job %s ended otherwise: %s", job_id, type(error).__name__)  # canceled, or deleted meanwhile
        except JobAborted:
            if self._stopping:
                return  # interrupted: it continues after the next start
        finally:
            self._followed.pop(job_id, None)
            self._polls.wake()
        # A job of the same id, of a key that was used again after a deletion, may not have ended.
        if outcome is not None or self._has_ended(job_id):
            self.open_jobs.ended(job_id, outcome, created_at)
            self._news.tell(JobNews("ended", job_id))
        else:
            self.active.forget(job_id)

    def _followed_of(self, queue: str) -> int:
        """How many jobs of a queue were started without waiting in it, and are at work."""
        return list(self._followed.values()).count(queue)

    def _has_ended(self, job_id: str) -> bool:
        try:
            found = state.find(job_id, self.active, full=False)
        except CowError:
            return False  # `recount` corrects the count, and waiters poll
        return found is None or found.ended is not None

    def _enqueue(self, job_id: str, spec: JobSpec, owner: str | None, queue: str) -> None:
        """Puts a job into a queue."""
        self._dispatch.enqueue(job_id, spec, owner, queue)
        self._polls.wake()
        self._news.tell(JobNews("queued", job_id))

    def _hear(self, news: JobNews) -> None:
        """What a process on the database told of a job."""
        match news.what:
            case "queued":
                self._polls.wake()
            case "progress":
                self.active.heard(news.job_id, cast(Stage | None, news.stage), news.done)
            case "canceled":
                self.active.request_cancel(news.job_id)
            case "ended" if self.active.get(news.job_id) is None:
                self.open_jobs.ended(news.job_id, None)
            case _:
                pass  # one that this process ran: it is said here with its outcome

    def _interrupt(self) -> None:
        """Has running jobs end without an outcome: they continue after the next start."""
        for job_id in self.active.ids():
            self.active.request_cancel(job_id)
        self._notify_stopping(self.active.awaited())

    def _notify_stopping(self, jobs: Iterable[str]) -> None:
        for job_id in jobs:
            error = ShuttingDown(
                f"The server is stopping. The job {job_id} goes on when it is back: GET /jobs/{job_id}.",
                headers={"Location": f"/jobs/{job_id}"},
            )
            self.active.notify_ended(job_id, error)


def new_job_id(owner: str | None, key: str | None) -> str:
    """The id of a job: with an idempotency key always the same for its owner, else a new one."""
    if key is None:
        return str(uuid.uuid4())
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"cow:{owner or ''}:{key}"))


def _no_job(job_id: str) -> JobNotFound:
    return JobNotFound(f"There is no job {job_id[:64]!r}: it was deleted, or never was one of yours.")
