"""Notifies callers' servers that a job has ended (Standard Webhooks): signed, with retries.

Each attempt is a workflow of its own, so that retries survive this process; one that waits occupies no thread.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import logging
import random
import time
from functools import cached_property
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from dbos import DBOS, SetEnqueueOptions, SetWorkflowID

from cow_service.errors import WebhookNotAllowed
from cow_service.jobs import workflows
from cow_service.jobs.database import database_errors
from cow_service.jobs.queues import WEBHOOKS
from cow_service.observability.metrics import Metrics
from cow_service.records import Job
from cow_service.settings import Settings

if TYPE_CHECKING:
    from cow_service.net import Egress

MAX_CONCURRENT_DELIVERIES = 100
MAX_CONCURRENT_DELIVERIES_TO_ONE = 2  # receiver: one that is silent holds up its own calls alone
POLL_SECONDS = 1.0
RETRY_SECONDS = (5, 30, 120, 600, 3600, 6 * 3600)  # before each further attempt, plus or minus JITTER
JITTER = 0.2  # share
SUCCESS = range(200, 300)
GONE = 410  # the receiver wants no more

log = logging.getLogger("cow_service")


class Webhooks:
    """Signs and sends. Tests give an `egress` of their own."""

    def __init__(self, settings: Settings, metrics: Metrics, egress: Egress | None = None) -> None:
        self._secret, self._metrics = settings.webhook_secret, metrics
        self._given = egress
        self._registered = False

    @cached_property
    def _egress(self) -> Egress:
        from cow_service.net import Egress  # noqa: PLC0415 # an HTTP client is costly to import

        return Egress(None) if self._given is None else self._given

    def use(self, settings: Settings, metrics: Metrics) -> None:
        """Takes the secret from other settings, and counts elsewhere. Only tests do this."""
        self._secret, self._metrics = settings.webhook_secret, metrics

    def check(self, url: str) -> None:
        """Raises `WebhookNotAllowed` for a URL that would not be called."""
        from cow_service.net import NotAllowed  # noqa: PLC0415

        if self._secret is None:
            raise WebhookNotAllowed("This server calls no webhooks: COW_WEBHOOK_SECRET is not set. Ask for the job.")
        try:
            self._egress.check(url)
        except NotAllowed as error:
            raise WebhookNotAllowed(f"`webhook`: {error}") from error

    def job_ended(self, job_id: str, url: str | None) -> None:
        """Enqueues the first attempt, which waits until the database has the end of the job."""
        if url is not None and self._secret is not None:
            self.enqueue(job_id, url, 1, delay=None)

    def send(self, job: Job, url: str, attempt: int) -> float | None:
        """Makes one attempt; returns the seconds until the next one, or None where none follows."""
        from cow_service.net import NotAllowed, Unreachable  # noqa: PLC0415

        event = {"type": f"job.{job.status}", "timestamp": job.finished_at, "data": job.model_dump(mode="json")}
        body = json.dumps(event, separators=(",", ":")).encode()
        message = f"msg_{job.id}"
        try:
            status = self._egress.post(url, body, self._headers(message, body))
        except NotAllowed as error:
            log.warning("webhook of job %s: %s", job.id, error)
            self._metrics.webhook("not-allowed")
            return None  # a retry would not be allowed either
        except Unreachable as error:
            log.info("webhook of job %s, attempt %d: %s", job.id, attempt, error)
            status = None
        if status in SUCCESS or status == GONE:
            self._metrics.webhook("delivered" if status in SUCCESS else "gone")
            return None
        self._metrics.webhook("unreachable" if status is None else "refused")
        return self.wait_after(job.id, attempt, f"the last answer was {status}")

    def wait_after(self, job_id: str, attempt: int, reason: str) -> float | None:
        """Seconds until the attempt after this one; None after the last."""
        if attempt > len(RETRY_SECONDS):
            log.warning("webhook of job %s: given up after %d attempts, %s", job_id, attempt, reason)
            self._metrics.webhook_given_up()
            return None
        return RETRY_SECONDS[attempt - 1] * random.uniform(1 - JITTER, 1 + JITTER)  # so that retries spread

    def enqueue(self, job_id: str, url: str, attempt: int, delay: float | None) -> None:
        """Enqueues an attempt, to be made after `delay` seconds."""
        with database_errors():
            if not self._registered:
                DBOS.register_queue(
                    WEBHOOKS,
                    worker_concurrency=MAX_CONCURRENT_DELIVERIES,
                    partition_worker_concurrency=MAX_CONCURRENT_DELIVERIES_TO_ONE,
                    polling_interval_sec=POLL_SECONDS,
                )
                self._registered = True
            options = SetEnqueueOptions(delay_seconds=delay, queue_partition_key=_receiver(url))
            with SetWorkflowID(attempt_ids(job_id)[attempt - 1]), options:
                DBOS.enqueue_workflow(WEBHOOKS, workflows.webhook, job_id, url, attempt)

    def _headers(self, message: str, body: bytes) -> dict[str, str]:
        assert self._secret is not None
        secrets, moment = self._secret.get_secret_value().split(" "), str(int(time.time()))
        return {
            "Content-Type": "application/json",
            "webhook-id": message,
            "webhook-timestamp": moment,
            "webhook-signature": " ".join(sign(each, message, moment, body) for each in secrets),
        }


def _receiver(url: str) -> str:
    """Who is called by a URL: its host and port, as a key of bounded length."""
    return hashlib.sha256(urlsplit(url).netloc.rpartition("@")[2].lower().encode()).hexdigest()[:32]


def attempt_ids(job_id: str) -> list[str]:
    """The ids of the workflows of all attempts for a job."""
    return [f"{job_id}.webhook.{attempt}" for attempt in range(1, len(RETRY_SECONDS) + 2)]


def sign(secret: str, message: str, moment: str, body: bytes) -> str:
    """The signature of a message (Standard Webhooks, symmetric): HMAC-SHA256 of id, time and body, base64."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signed = hmac.new(key, f"{message}.{moment}.".encode() + body, hashlib.sha256).digest()
    return "v1," + base64.b64encode(signed).decode()
