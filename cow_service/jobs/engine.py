"""The job engine: takes orders, has DBOS run them durably, and tells how they go.

One process has one engine, because DBOS is one per process. An order becomes a workflow. Where this process has room
for it, the workflow starts at once; else it waits in DBOS' queue of its generator, from which any process on the same
database may take it. Either way it is in the database before anybody is told of it.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable, Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from dbos import (
    DBOS,
    DBOSConfig,
    DBOSContextSetAuth,
    SetWorkflowAttributes,
    SetWorkflowID,
    WorkflowHandle,
    WorkflowStatus,
)
from dbos import error as dbos_error
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import (
    ArtifactNotFound,
    CowError,
    IdempotencyKeyReused,
    JobNotFound,
    QueueFull,
    ShuttingDown,
    StorageUnavailable,
)
from cow_service.jobs import reports, workflows
from cow_service.jobs.database import database_errors
from cow_service.jobs.executors import Executors
from cow_service.jobs.ledger import Ledger
from cow_service.jobs.maintenance import Upkeep
from cow_service.jobs.orders import Order
from cow_service.jobs.reports import CREATED, GENERATOR, Filters, Found
from cow_service.jobs.serializer import JsonSerializer
from cow_service.jobs.webhooks import Webhooks
from cow_service.jobs.worker import Left, Worker
from cow_service.media.images import DecodedImage
from cow_service.records import TERMINAL, JobPage
from cow_service.service import Service

POLL = 0.25  # seconds between looks into a queue; jobs are taken ahead, so that nobody waits for one
LEFT_OVER = 3.0  # seconds for what was handed back to be let go

log = logging.getLogger("cow_service")


class Engine:
    """Runs the jobs of one service, from `start` to `close`. Its methods block: not for an event loop."""

    def __init__(self, service: Service) -> None:
        self.ledger = Ledger(service)
        self.live, self.database = self.ledger.live, self.ledger.database
        self._executors = Executors(service.settings.data_dir / "executors")
        self._stopping = False
        self._queues: set[str] = set()
        self._followed: set[str] = set()  # jobs whose end a thread waits for
        self._keyed, self._canceling = threading.Lock(), threading.Lock()
        self._grace: threading.Timer | None = None  # until running jobs are handed back
        self.webhooks = Webhooks(service.settings)
        self._upkeep = Upkeep(self.ledger)
        self._threads: ThreadPoolExecutor | None = None

    @property
    def service(self) -> Service:
        """Whose jobs it runs."""
        return self.ledger.service

    def use(self, service: Service) -> None:
        """Runs the jobs of another service from now on, on the same database."""
        self.ledger.service = service
        self.webhooks.use(service.settings)

    @property
    def room(self) -> int:
        """Jobs of one generator in the hands of this process: those that compute, and those that wait for others."""
        settings = self.service.settings
        return settings.concurrency + settings.mllm_concurrency

    @property
    def runs(self) -> bool:
        """Whether it was started and not closed."""
        return self._threads is not None

    def start(self) -> None:
        """Opens the database and picks up what was under way. Raises `StorageUnavailable`."""
        self.service.artifacts.check()
        executor = self._executors.take()
        config = DBOSConfig(
            name="cow",
            system_database_url=self.database.url,
            system_database_engine=self.database.engine,
            application_version=workflows.VERSION,
            executor_id=executor,
            serializer=JsonSerializer(),
            use_listen_notify=False,
            log_level="WARNING",
        )
        workflows.set_runner(Worker(self.ledger, self.webhooks, self.left))
        try:
            self.database.create_tables()
            DBOS(config=config)
            DBOS.launch()
        except (SQLAlchemyError, dbos_error.DBOSException) as error:
            DBOS.destroy()
            self._executors.leave()
            raise StorageUnavailable(
                f"The job database cannot be used ({type(error).__name__}): see COW_DATABASE_URL."
            ) from error
        except CowError:
            self._executors.leave()
            raise
        self._stopping = False
        self._threads = ThreadPoolExecutor(thread_name_prefix="cow-job", max_workers=1024)
        self.ledger.recount()
        self.service.metrics.queue_depth = self.ledger.depth
        self._upkeep.start(self._executors)

    def drain(self) -> None:
        """Takes no more orders, and tells whoever waits for a job that nobody works on.

        From now on running jobs have the time that the settings say: then those who wait for them are told as well.
        """
        if not self._stopping:
            self._stopping = True
            self._grace = threading.Timer(self.service.settings.shutdown_grace, self._hand_back)
            self._grace.daemon = True
            self._grace.start()
        running = set(self.live.jobs())
        for job_id in self.live.waited_for():
            if job_id not in running:
                self.live.settled(job_id, _stopping(job_id))

    def close(self) -> None:
        """Gives running jobs the time that the settings say, then lets go of all: what is not done goes on later."""
        self.drain()
        self._upkeep.stop()
        grace = self.service.settings.shutdown_grace
        # Nothing is taken from the queues from here on; it looks once a second whether the work is done.
        DBOS.destroy(workflow_completion_timeout_sec=int(grace + LEFT_OVER) if self.live.jobs() else 0)
        if self._grace is not None:
            self._grace.cancel()
        self._hand_back()
        if self._threads is not None:
            self._threads.shutdown(wait=True, cancel_futures=True)
            self._threads = None
        workflows.set_runner(None)
        self.database.close()
        self._executors.leave()

    def check(self) -> None:
        """Raises `StorageUnavailable` where the database does not answer, `ShuttingDown` where the engine stops."""
        if self._stopping:
            raise ShuttingDown("The server is stopping. Ask another one, or this one again in a while.")
        self.database.check()

    def check_room(self) -> None:
        """Raises `QueueFull` where another order would be too many, `ShuttingDown` where none is taken."""
        limit = self.service.settings.queue_limit
        if self._stopping:
            raise ShuttingDown("The server is stopping and takes no more jobs. Send the request again in a while.")
        if len(self.ledger) >= limit:
            raise QueueFull(
                f"{len(self.ledger)} jobs wait or run, and COW_QUEUE_LIMIT is {limit}. Send the request again later."
            )

    def submit(
        self, order: Order, generator: str, owner: str | None, key: str | None, image: DecodedImage, job_id: str
    ) -> bool:
        """Takes an order as the job `job_id`; says whether the job is new. It is in the database when this returns.

        `key` is the caller's idempotency key: the same key and order come to the same job. Raises
        `IdempotencyKeyReused`, `QueueFull`, `ShuttingDown`, `StorageUnavailable`.
        """
        self.database.check_far()
        if key is None:
            self._submit(order, generator, owner, image, job_id)
            return True
        with self._keyed:  # one at a time: what is checked is still true when the job is in
            if self._known(job_id, order):
                return False
            self._submit(order, generator, owner, image, job_id)
            return self._known(job_id, order)  # another process may have been faster with the same key

    def _submit(self, order: Order, generator: str, owner: str | None, image: DecodedImage, job_id: str) -> None:
        with self.ledger.guard:  # as above
            self.check_room()
            at_once = self.ledger.of(generator) < self.room
            self.ledger.count(job_id, generator)
        try:
            # Before the job: its image must not go while nobody has begun with it.
            self.database.hold(job_id, [image.info.sha256])
            if at_once:
                self.live.lend(job_id, image)
                self._start(job_id, order, owner, generator)
            else:
                self._enqueue(job_id, order, owner, generator)
        except BaseException:
            self.live.image(job_id)
            self.ledger.count(job_id, None)
            raise

    def find(self, job_id: str, owner: str | None, *, full: bool = True) -> Found:
        """A job of an owner. Raises `JobNotFound`, also for a job of somebody else."""
        self.database.check_far()
        found = reports.find(job_id, self.live, full=full)
        if found is None or (owner is not None and found.owner != owner):
            raise JobNotFound(f"There is no job {job_id[:64]!r}: it was deleted, or never was one of yours.")
        return found

    def page(self, owner: str | None, filters: Filters) -> JobPage:
        """Jobs of an owner, newest first."""
        self.database.check_far()
        return reports.page(owner, filters, self.live)

    def cancel(self, job_id: str, owner: str | None) -> Found:
        """Ends a job unless it has ended; whoever works on it stops at the next step."""
        with self._canceling:  # one at a time: an end does not change
            found = self.find(job_id, owner, full=False)
            if found.job.status in TERMINAL:
                return self.find(job_id, owner)
            order = self._order(job_id)
            if order is not None:
                # Before its end, so that no crash comes between: it waits for the end.
                self.webhooks.job_ended(job_id, order.webhook)
            with database_errors():
                DBOS.cancel_workflow(job_id)
        self.live.end(job_id)
        self.ledger.ended(job_id, None)
        found = self.find(job_id, owner)
        if found.job.status == "canceled":
            self.service.metrics.job(found.job.kind, "canceled")
        return found

    def delete(self, job_id: str, owner: str | None) -> None:
        """Ends a job, and removes it and what only it holds."""
        found = self.find(job_id, owner, full=False)
        if found.job.status not in TERMINAL:
            found = self.cancel(job_id, owner)
        self.ledger.remove([job_id], found.ended or 0)

    def may_read(self, sha256: str, owner: str | None) -> None:
        """Raises `ArtifactNotFound` where an artifact is of nobody's job but others'."""
        if owner is None:
            return
        holders = self.database.holders(sha256)
        if not holders or not reports.existing(holders, owner):
            raise ArtifactNotFound(f"No artifact of yours has the SHA-256 {sha256[:64]}.")

    def left(self, job_id: str) -> None:
        """The work on a job is over in this process, and nobody else sees to it that its end is told."""
        if job_id not in self._followed and not self._stopping:
            self._upkeep.settle(job_id)

    def _order(self, job_id: str) -> Order | None:
        with database_errors():
            known = DBOS.get_workflow_status(job_id)
        return None if known is None else _order_of(known)

    def _known(self, job_id: str, order: Order) -> bool:
        """Whether the job of an idempotency key is there. Raises `IdempotencyKeyReused` for another order."""
        known = self._order(job_id)
        if known is None:
            return False
        if known.digest != order.digest:
            raise IdempotencyKeyReused(
                "This Idempotency-Key came with another request before. Give every request a key of its own."
            )
        return True

    def _start(self, job_id: str, order: Order, owner: str | None, generator: str) -> None:
        """Starts a job in this process; the database has it when this returns."""
        assert self._threads is not None
        self._followed.add(job_id)
        try:
            with self._told(job_id, order, owner, generator), taking_errors():
                handle = DBOS.start_workflow(_workflow(order), order.model_dump())
            self._threads.submit(self._follow, job_id, handle)
        except BaseException:
            self._followed.discard(job_id)
            raise

    def _follow(self, job_id: str, handle: WorkflowHandle[str]) -> None:
        """Waits in a thread of its own until the database says that a job has ended."""
        outcome: str | CowError | None = None
        try:
            outcome = handle.get_result()
        except CowError as error:
            outcome = error
        except (dbos_error.DBOSException, SQLAlchemyError) as error:
            log.info("job %s ended otherwise: %s", job_id, type(error).__name__)  # canceled, or deleted meanwhile
        except Left:
            if self._stopping:
                return  # handed back: it goes on after the next start
        finally:
            self._followed.discard(job_id)
        # After a deletion the same key may have come to the same id again: that job has not ended.
        if outcome is not None or self._has_ended(job_id):
            self.ledger.ended(job_id, outcome)
        else:
            self.live.forget(job_id)

    def _has_ended(self, job_id: str) -> bool:
        try:
            found = reports.find(job_id, self.live, full=False)
        except CowError:
            return False  # the count is set right later, and whoever waits looks for themselves
        return found is None or found.ended is not None

    def _enqueue(self, job_id: str, order: Order, owner: str | None, generator: str) -> None:
        """Puts a job into the queue of its generator."""
        name = f"cow-{generator}"
        with taking_errors():
            if name not in self._queues:
                DBOS.register_queue(
                    name, worker_concurrency=self.room, polling_interval_sec=POLL, on_conflict="always_update"
                )
                self._queues.add(name)
            with self._told(job_id, order, owner, generator):
                DBOS.enqueue_workflow(name, _workflow(order), order.model_dump())

    @contextmanager
    def _told(self, job_id: str, order: Order, owner: str | None, generator: str) -> Generator[None]:
        """What DBOS keeps beside a workflow."""
        # Times in SQLite are whole seconds: the order knows better when it came.
        attributes = SetWorkflowAttributes({GENERATOR: generator, CREATED: order.created_at})
        with SetWorkflowID(job_id), DBOSContextSetAuth(owner, None), attributes:
            yield

    def _hand_back(self) -> None:
        """Has running jobs end without an outcome: the next start goes on with them."""
        for job_id in self.live.jobs():
            self.live.end(job_id)
        for job_id in self.live.waited_for():
            self.live.settled(job_id, _stopping(job_id))


@contextmanager
def taking_errors() -> Generator[None]:
    """What DBOS raises when it takes a job, as `StorageUnavailable`."""
    try:
        with database_errors():
            yield
    except dbos_error.DBOSException as error:
        raise StorageUnavailable(f"The job database did not take the job ({type(error).__name__}).") from error


def _order_of(status: WorkflowStatus) -> Order:
    given: Any = status.input
    return Order.model_validate(given["args"][0])


def _workflow(order: Order) -> Callable[[dict[str, Any]], str]:
    return workflows.answer if order.kind == "answer" else workflows.simulate


def new_job_id(owner: str | None, key: str | None) -> str:
    """The id of a job: with an idempotency key always the same for its owner, else a new one."""
    if key is None:
        return str(uuid.uuid4())
    return str(uuid.uuid5(uuid.NAMESPACE_URL, f"cow:{owner or ''}:{key}"))


def _stopping(job_id: str) -> ShuttingDown:
    return ShuttingDown(
        f"The server is stopping. The job {job_id} goes on when it is back: GET /jobs/{job_id}.",
        headers={"Location": f"/jobs/{job_id}"},
    )
