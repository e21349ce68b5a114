"""Notifies callers' servers that a job has ended (Standard Webhooks): signed, with retries.

Each attempt is a workflow of its own, so that retries survive this process; one that waits occupies no thread.
"""

import base64
import hashlib
import hmac
import json
import logging
import random
import time
from urllib.parse import urlsplit

import sqlalchemy as sa
from dbos import DBOSClient, DBOSPortableJSONSerializer, EnqueueOptions
from dbos import error as dbos_error

from cow_service.errors import StorageUnavailable, WebhookNotAllowed
from cow_service.jobs.database import Database, database_errors
from cow_service.jobs.job_table import VERSION
from cow_service.net import Egress, NotAllowed, Unreachable
from cow_service.observability.metrics import Metrics
from cow_service.records import Job
from cow_service.settings import Settings

APPLICATION = "cow"  # as DBOS knows it
QUEUE = "cow-webhook-receivers"  # in which every receiver has a share of its own
WORKFLOW = "webhook"  # the name of an attempt's workflow
MAX_CONCURRENT_DELIVERIES = 100
MAX_CONCURRENT_DELIVERIES_TO_ONE = 2  # receiver: one that is silent holds up its own calls alone
POLL_SECONDS = 1.0
RETRY_SECONDS = (5, 30, 120, 600, 3600, 6 * 3600)  # before each further attempt, plus or minus JITTER
JITTER = 0.2  # share
SUCCESS = range(200, 300)
GONE = 410  # the receiver wants no more

log = logging.getLogger("cow_service")


class Webhooks:
    """Signs and sends; DBOS keeps the attempts that are to be made."""

    def __init__(self, settings: Settings, metrics: Metrics, database: Database) -> None:
        self._secret, self._metrics, self._egress = settings.webhook_secret, metrics, Egress(None)
        # Unlike DBOS itself, its client can be told to raise where the database is away.
        self.client = DBOSClient(
            system_database_engine=database.engine,
            serializer=DBOSPortableJSONSerializer(),
            application_name=APPLICATION,
            retry_connection_errors=False,
            lazy=True,
        )

    def check(self, url: str) -> None:
        """Raises `WebhookNotAllowed` for a URL that would not be called."""
        if self._secret is None:
            raise WebhookNotAllowed("This server calls no webhooks: COW_WEBHOOK_SECRET is not set. Ask for the job.")
        try:
            self._egress.check(url)
        except NotAllowed as error:
            raise WebhookNotAllowed(f"`webhook`: {error}") from error

    def register_queue(self) -> None:
        """Makes the queue in which attempts wait. The tables of DBOS are there already."""
        with database_errors():
            self.client.register_queue(
                QUEUE,
                worker_concurrency=MAX_CONCURRENT_DELIVERIES,
                partition_worker_concurrency=MAX_CONCURRENT_DELIVERIES_TO_ONE,
                polling_interval_sec=POLL_SECONDS,
            )

    def enqueue(
        self, connection: sa.Connection, job_id: str, url: str, attempt: int = 1, delay: float | None = None
    ) -> None:
        """Adds an attempt, to be made `delay` seconds after the transaction of the connection."""
        if self._secret is None:
            return
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
            raise StorageUnavailable(f"A webhook was not taken ({type(error).__name__}).") from error

    def send(self, job: Job, url: str, attempt: int) -> float | None:
        """Makes one attempt; returns the seconds until the next one, or None where none follows."""
        assert self._secret is not None
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
            status = self._egress.post(url, body, headers)
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


def attempt_ids(job_id: str) -> list[str]:
    """The ids of the workflows of all attempts for a job."""
    return [f"{job_id}.webhook.{attempt}" for attempt in range(1, len(RETRY_SECONDS) + 2)]


def sign(secret: str, message: str, moment: str, body: bytes) -> str:
    """The signature of a message (Standard Webhooks, symmetric): HMAC-SHA256 of id, time and body, base64."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signed = hmac.new(key, f"{message}.{moment}.".encode() + body, hashlib.sha256).digest()
    return "v1," + base64.b64encode(signed).decode()
