"""Tells callers' servers that a job has ended, as Standard Webhooks says: signed, and tried again until it is heard.

Each attempt is a workflow of its own, so that attempts outlive this process; one that waits for its time holds nothing.
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

from dbos import DBOS, SetEnqueueOptions, SetWorkflowID

from cow_service.errors import WebhookNotAllowed
from cow_service.jobs import workflows
from cow_service.jobs.database import database_errors
from cow_service.records import Job
from cow_service.settings import Settings

if TYPE_CHECKING:
    from cow_service.net.egress import Egress

QUEUE = "cow-webhooks"
AT_ONCE = 8
POLL = 1.0  # seconds
WAITS = (5, 30, 120, 600, 3600, 6 * 3600)  # seconds before each further attempt, give or take JITTER
JITTER = 0.2
GOOD = range(200, 300)
_GONE = 410  # the receiver wants no more

log = logging.getLogger("cow_service")


class Webhooks:
    """Signs and sends. `egress` stands in for the way out in tests."""

    def __init__(self, settings: Settings, egress: Egress | None = None) -> None:
        self._secret = settings.webhook_secret
        self._given = egress
        self._registered = False

    @cached_property
    def _egress(self) -> Egress:
        from cow_service.net.egress import Egress  # noqa: PLC0415 # an HTTP client is costly to import

        return Egress(None) if self._given is None else self._given

    def use(self, settings: Settings) -> None:
        """Takes the secret of other settings."""
        self._secret = settings.webhook_secret

    def check(self, url: str) -> None:
        """Raises `WebhookNotAllowed` for a URL that would not be called."""
        from cow_service.net.egress import NotAllowed  # noqa: PLC0415

        if self._secret is None:
            raise WebhookNotAllowed("This server calls no webhooks: COW_WEBHOOK_SECRET is not set. Ask for the job.")
        try:
            self._egress.check(url)
        except NotAllowed as error:
            raise WebhookNotAllowed(f"`webhook`: {error}") from error

    def job_ended(self, job_id: str, url: str | None) -> None:
        """Sees to it that the URL is told, once the database says that the job has ended."""
        if url is not None and self._secret is not None:
            self.attempt(job_id, url, 1, delay=None)

    def send(self, job: Job, url: str, attempt: int) -> float | None:
        """One attempt; where nobody took it, seconds until another one is to follow."""
        from cow_service.net.egress import NotAllowed, Unreachable  # noqa: PLC0415

        told = {"type": f"job.{job.status}", "timestamp": job.finished_at, "data": job.model_dump(mode="json")}
        body = json.dumps(told, separators=(",", ":")).encode()
        message = f"msg_{job.id}"
        try:
            status = self._egress.post(url, body, self._headers(message, body))
        except NotAllowed as error:
            log.warning("webhook of job %s: %s", job.id, error)
            return None  # nor will it be later
        except Unreachable as error:
            log.info("webhook of job %s, attempt %d: %s", job.id, attempt, error)
            status = None
        if status in GOOD or status == _GONE:
            return None
        return self.wait_after(job.id, attempt, f"the last answer was {status}")

    def wait_after(self, job_id: str, attempt: int, reason: str) -> float | None:
        """Seconds until the attempt after this one, None after the last."""
        if attempt > len(WAITS):
            log.warning("webhook of job %s: given up after %d attempts, %s", job_id, attempt, reason)
            return None
        return WAITS[attempt - 1] * random.uniform(1 - JITTER, 1 + JITTER)  # so that many do not come back at once

    def attempt(self, job_id: str, url: str, attempt: int, delay: float | None) -> None:
        """Has an attempt made, after some seconds where they are given."""
        with database_errors():
            if not self._registered:
                DBOS.register_queue(QUEUE, worker_concurrency=AT_ONCE, polling_interval_sec=POLL)
                self._registered = True
            with SetWorkflowID(attempts_of(job_id)[attempt - 1]), SetEnqueueOptions(delay_seconds=delay):
                DBOS.enqueue_workflow(QUEUE, workflows.webhook, job_id, url, attempt)

    def _headers(self, message: str, body: bytes) -> dict[str, str]:
        assert self._secret is not None
        moment = str(int(time.time()))
        return {
            "Content-Type": "application/json",
            "webhook-id": message,
            "webhook-timestamp": moment,
            "webhook-signature": sign(self._secret.get_secret_value(), message, moment, body),
        }


def attempts_of(job_id: str) -> list[str]:
    """The ids of all workflows that may tell of a job's end."""
    return [f"{job_id}.webhook.{attempt}" for attempt in range(1, len(WAITS) + 2)]


def sign(secret: str, message: str, moment: str, body: bytes) -> str:
    """The signature of a message (Standard Webhooks, symmetric): HMAC-SHA256 of id, time and body, base64."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signed = hmac.new(key, f"{message}.{moment}.".encode() + body, hashlib.sha256).digest()
    return "v1," + base64.b64encode(signed).decode()
