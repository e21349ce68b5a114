"""Notifies callers' servers that a job has ended (Standard Webhooks): signed, with retries.

Each attempt is a workflow of DBOS of its own, so that retries survive this process; one that waits occupies no thread.
"""

import base64
import hashlib
import hmac
import json
import logging
import math
import random
import time
from collections.abc import Callable, Generator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from functools import partial
from urllib.parse import urlsplit
from uuid import uuid4

import sqlalchemy as sa
from dbos import DBOS, DBOSClient, DBOSConfig, DBOSPortableJSONSerializer, EnqueueOptions
from dbos import error as dbos_error
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import StorageUnavailable, WebhookNotAllowed
from cow_service.jobs.calls import Calls
from cow_service.jobs.computing import Outages
from cow_service.jobs.database import Database, database_errors
from cow_service.jobs.job_table import VERSION, JobTable
from cow_service.net import Egress, NotAllowed, Unreachable
from cow_service.observability.metrics import Metrics
from cow_service.records import Job
from cow_service.settings import Settings

APPLICATION = "cow"  # as DBOS knows it
QUEUE = "cow-webhook-receivers"  # shared equally by the receivers
WORKFLOW = "webhook"  # the name of an attempt's workflow
MAX_CONCURRENT_DELIVERIES = 100
MAX_CONCURRENT_DELIVERIES_TO_ONE = 2  # receiver: one that is silent holds up its own calls alone
POLL_SECONDS = 1.0
RETRY_SECONDS = (5, 30, 120, 600, 3600, 6 * 3600)  # before each further attempt, plus or minus JITTER
JITTER = 0.2  # share
SUCCESS = range(200, 300)
MAX_REMOVED = 200  # records of calls, at a time
GONE = 410  # the receiver wants no more calls

log = logging.getLogger("cow_service")


class Interrupted(BaseException):
    """The engine ends in the middle of a workflow. No `Exception`: DBOS must not record it as an outcome."""


class Webhooks(Calls):
    """Signs and sends; DBOS keeps the attempts that are to be made. One at a time: DBOS is one per process."""

    def __init__(self, settings: Settings, metrics: Metrics, database: Database) -> None:
        assert settings.webhook_secret is not None, "else there are no calls"
        self._secret, self._metrics = settings.webhook_secret, metrics
        self.egress = Egress(None)  # decides which addresses may be called
        self._database, self._jobs = database, JobTable(database, self.enqueue)
        # Unlike DBOS itself, its client can be told to raise where the database is away.
        self.client = DBOSClient(
            system_database_engine=database.engine,
            serializer=DBOSPortableJSONSerializer(),
            application_name=APPLICATION,
            retry_connection_errors=False,
            lazy=True,
        )

    def check(self, url: str) -> None:
        """As the base class says."""
        try:
            self.egress.check(url)
        except NotAllowed as error:
            raise WebhookNotAllowed(f"`webhook`: {error}") from error

    def start(self, jobs: JobTable, executor: str, *, migrate: bool) -> None:
        """As the base class says."""
        global _webhooks  # noqa: PLW0603
        self._jobs = jobs
        launch(self._database, executor, migrate=migrate)
        with database_errors():  # the queue in which attempts wait
            self.client.register_queue(
                QUEUE,
                worker_concurrency=MAX_CONCURRENT_DELIVERIES,
                partition_worker_concurrency=MAX_CONCURRENT_DELIVERIES_TO_ONE,
                polling_interval_sec=POLL_SECONDS,
            )
        _webhooks = self

    def stop(self) -> None:
        """As the base class says."""
        global _webhooks  # noqa: PLW0603
        DBOS.destroy()
        _webhooks = None

    def enqueue(
        self, connection: sa.Connection, job_id: str, url: str, attempt: int = 1, delay: float | None = None
    ) -> None:
        """As the base class says."""
        receiver = urlsplit(url).netloc.rpartition("@")[2].lower()  # host and port
        options: EnqueueOptions = {
            "workflow_name": WORKFLOW,
            "queue_name": QUEUE,
            "workflow_id": attempt_ids(job_id)[attempt - 1],
            "app_version": VERSION,
            "queue_partition_key": hashlib.sha256(receiver.encode()).hexdigest()[:32],  # of bounded length
        }
        if delay is not None:
            options["delay_seconds"] = delay
        try:
            self.client.enqueue_in_transaction(connection, options, job_id, url, attempt)
        except dbos_error.DBOSException as error:
            raise StorageUnavailable(f"A webhook could not be scheduled ({type(error).__name__}).") from error

    def call(self, job_id: str, url: str, attempt: int) -> None:
        """Makes an attempt to call a webhook, and schedules another one if it failed."""

        def check() -> None:
            if _webhooks is not self:
                raise Interrupted

        def call() -> float | None:
            found = patient.wait_through(lambda: self._jobs.find(job_id, None))
            return None if found is None else self.send(found.job, url, attempt)

        def enqueue() -> None:
            with self._database.transaction() as connection:
                self.enqueue(connection, job_id, url, attempt + 1, wait)

        patient = Outages(math.inf, check)
        wait = DBOS.run_step({"name": "call"}, call)  # its outcome is kept: a crash after it does not repeat it
        if wait is not None:
            patient.wait_through(enqueue)

    def busy_executors(self) -> set[str]:
        """As the base class says."""
        with _dbos_errors():
            pending = self.client.list_workflows(status="PENDING", load_input=False, load_output=False)
        return {workflow.executor_id for workflow in pending if workflow.executor_id is not None}

    def recover(self, ended: list[str]) -> None:
        """As the base class says. An earlier version kept attempts to compute jobs, too: those are deleted."""
        with _dbos_errors():
            pending = self.client.list_workflows(
                executor_id=ended, status="PENDING", load_input=False, load_output=False
            )
            for workflow in pending:
                if workflow.name == WORKFLOW:
                    self.client.resume_workflow(workflow.workflow_id, queue_name=QUEUE)
            over = [workflow.workflow_id for workflow in pending if workflow.name != WORKFLOW]
            self.client.delete_workflows(over)

    def forget(self, jobs: list[str]) -> None:
        """As the base class says."""
        with _dbos_errors():
            self.client.delete_workflows([attempt for job_id in jobs for attempt in attempt_ids(job_id)])

    def clean_up(self, before: float, stop: Callable[[], bool]) -> None:
        """As the base class says."""
        moment = datetime.fromtimestamp(before, UTC).isoformat()
        ended = partial(self.client.list_workflows, completed_before=moment, limit=MAX_REMOVED)
        with _dbos_errors():
            while not stop() and (records := ended(load_input=False, load_output=False)):
                self.client.delete_workflows([record.workflow_id for record in records])

    def send(self, job: Job, url: str, attempt: int) -> float | None:
        """Makes one attempt; returns the seconds until the next one, or None if none follows."""
        event = {"type": f"job.{job.status}", "timestamp": job.finished_at, "data": job.model_dump(mode="json")}
        body = json.dumps(event, separators=(",", ":")).encode()
        message, moment, secrets = f"msg_{job.id}", str(int(time.time())), self._secret.get_secret_value().split(" ")
        headers = {
            "Content-Type": "application/json",
            "webhook-id": message,
            "webhook-timestamp": moment,
            "webhook-signature": " ".join(sign(each, message, moment, body) for each in secrets),
        }
        try:
            status = self.egress.post(url, body, headers)
        except NotAllowed as error:
            log.warning("webhook of job %s: %s", job.id, error)
            self._metrics.webhooks.labels("not-allowed").inc()
            return None  # a retry would not be allowed either
        except Unreachable as error:
            log.info("webhook of job %s, attempt %d: %s", job.id, attempt, error)
            status = None
        if status in SUCCESS or status == GONE:
            self._metrics.webhooks.labels("delivered" if status in SUCCESS else "gone").inc()
            return None
        self._metrics.webhooks.labels("unreachable" if status is None else "refused").inc()
        if attempt > len(RETRY_SECONDS):
            log.warning(
                "webhook of job %s: given up after %d attempts, the last answer was %s", job.id, attempt, status
            )
            self._metrics.webhooks_given_up.inc()
            return None
        return RETRY_SECONDS[attempt - 1] * random.uniform(1 - JITTER, 1 + JITTER)  # so that retries spread


_webhooks: Webhooks | None = None  # that DBOS, which calls functions, works for


@DBOS.workflow(name=WORKFLOW)
def call_webhook(job_id: str, url: str, attempt: int) -> None:
    """An attempt to notify a webhook that a job has ended."""
    assert _webhooks is not None, "workflows run only while an engine does"
    _webhooks.call(job_id, url, attempt)


def launch(database: Database, executor: str, *, migrate: bool, queues: tuple[str, ...] = (QUEUE,)) -> None:
    """Starts DBOS on a database, and creates its tables or checks that they exist.

    `queues`: those from which this process takes work. Raises `StorageUnavailable`.
    """
    config = DBOSConfig(
        name=APPLICATION,
        system_database_url=database.url,
        system_database_engine=database.engine,
        application_version=VERSION,
        executor_id=executor,
        serializer=DBOSPortableJSONSerializer(),  # no pickles: reading the database runs no code
        use_listen_notify=False,  # what processes tell each other is ours
        run_migrations=migrate,
        log_level="WARNING",
    )
    try:
        DBOS(config=config)
        DBOS.listen_queues(queues)
        DBOS.launch()
    except (SQLAlchemyError, dbos_error.DBOSException) as error:
        DBOS.destroy()
        remedy = "see COW_DATABASE_URL" if migrate else "run `cow migrate` first, and check COW_DATABASE_URL"
        raise StorageUnavailable(f"The job database cannot be used ({type(error).__name__}): {remedy}.") from error


def migrate(settings: Settings) -> None:
    """Creates the tables of the job database that are missing, and updates those of an older version, DBOS' included.

    Raises `StorageUnavailable`.
    """
    with closing(Database(settings)) as database:
        database.prepare(migrate=True)
        launch(database, f"migrate-{uuid4().hex}", migrate=True, queues=())
        DBOS.destroy()


@contextmanager
def _dbos_errors() -> Generator[None]:
    try:
        with database_errors():
            yield
    except dbos_error.DBOSException as error:
        raise StorageUnavailable(f"Calls of webhooks cannot be managed ({type(error).__name__}).") from error


def attempt_ids(job_id: str) -> list[str]:
    """The ids of the workflows of all attempts for a job."""
    return [f"{job_id}.webhook.{attempt}" for attempt in range(1, len(RETRY_SECONDS) + 2)]


def sign(secret: str, message: str, moment: str, body: bytes) -> str:
    """The signature of a message (Standard Webhooks, symmetric): HMAC-SHA256 of id, time and body, base64."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signed = hmac.new(key, f"{message}.{moment}.".encode() + body, hashlib.sha256).digest()
    return "v1," + base64.b64encode(signed).decode()
