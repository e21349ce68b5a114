"""Notifies callers' servers that a job has ended (Standard Webhooks): signed, with retries.

A call is a row from the transaction that ends the job until its receiver has heard of it. Whoever makes an attempt
moves the row's time first: where the process ends in the middle, another one tries again then.
"""

import base64
import hashlib
import hmac
import json
import logging
import random
import threading
import time
from collections import Counter
from typing import Any

import sqlalchemy as sa

from cow_service.errors import WebhookNotAllowed
from cow_service.jobs.computing import EngineParts
from cow_service.jobs.schema import CALLS
from cow_service.net import Egress, NotAllowed, Unreachable
from cow_service.records import Job

MAX_CONCURRENT_CALLS = 100
MAX_CONCURRENT_CALLS_TO_ONE = 2  # receiver: one that is silent holds up its own calls alone
ATTEMPT_SECONDS = 120.0  # after which an attempt that says nothing has ended with its process
RETRY_SECONDS = (5, 30, 120, 600, 3600, 6 * 3600)  # before each further attempt, plus or minus JITTER
JITTER = 0.2  # share
SUCCESS = range(200, 300)
GONE = 410  # the receiver wants no more calls

log = logging.getLogger("cow_service")


class Webhooks:
    """Signs and sends. A server without COW_WEBHOOK_SECRET makes no calls."""

    def __init__(self, parts: EngineParts) -> None:
        self._parts, self._secret = parts, parts.service.settings.webhook_secret
        self.egress = Egress(None)  # decides which addresses may be called
        self._lock = threading.Lock()
        self._calling: Counter[str] = Counter()  # attempts that are being made, by receiver

    def check(self, url: str) -> None:
        """Raises `WebhookNotAllowed` for a URL that would not be called."""
        if self._secret is None:
            told = "This server calls no webhooks: COW_WEBHOOK_SECRET is not set. Poll the job instead."
            raise WebhookNotAllowed(told)
        try:
            self.egress.check(url)
        except NotAllowed as error:
            raise WebhookNotAllowed(f"`webhook`: {error}") from error

    def send_due(self) -> None:
        """Begins the attempts that are due, each in a thread. Raises `StorageUnavailable`."""
        if self._secret is None:
            return
        database = self._parts.database
        place = sa.func.row_number().over(partition_by=CALLS.c.receiver, order_by=CALLS.c.due).label("place")
        due = sa.select(CALLS, place).where(CALLS.c.due <= database.now).subquery()
        first = sa.select(due).where(due.c.place <= MAX_CONCURRENT_CALLS_TO_ONE).order_by(due.c.due)
        for row in database.read(first.limit(MAX_CONCURRENT_CALLS)):
            with self._lock:
                has_room = self._calling.total() < MAX_CONCURRENT_CALLS
                if not has_room or self._calling[row.receiver] >= MAX_CONCURRENT_CALLS_TO_ONE:
                    continue
                self._calling[row.receiver] += 1
            number, begun = row.attempts + 1, False
            try:
                if self.change(row.job_id, row.attempts, {"attempts": number, "due": database.now + ATTEMPT_SECONDS}):
                    call = row.job_id, row.url, number, row.receiver
                    threading.Thread(target=self._call, args=call, name="cow-webhook", daemon=True).start()
                    begun = True
            finally:
                if not begun:  # another process makes it, or it is tried again
                    self._give_place_back(row.receiver)

    def _call(self, job_id: str, url: str, attempt: int, receiver: str) -> None:
        """Makes an attempt to call a webhook, and schedules another one if it failed."""
        database = self._parts.database
        try:
            found = self._parts.jobs.find(job_id, None, full=False)
            wait = None if found is None else self.send(found.job, url, attempt)
            if wait is not None:
                self.change(job_id, attempt, {"due": database.now + wait})
            else:
                row = CALLS.c.job_id == job_id, CALLS.c.attempts == attempt
                with database.transaction() as connection:
                    connection.execute(sa.delete(CALLS).where(*row))
        except Exception:
            log.exception("webhook of job %s, attempt %d: it is made again", job_id, attempt)
        finally:
            self._give_place_back(receiver)

    def change(self, job_id: str, attempts: int, values: dict[str, Any]) -> bool:
        """False where another process has begun an attempt since."""
        row = CALLS.c.job_id == job_id, CALLS.c.attempts == attempts
        with self._parts.database.transaction() as connection:
            return connection.execute(sa.update(CALLS).where(*row).values(values)).rowcount > 0

    def _give_place_back(self, receiver: str) -> None:
        with self._lock:
            self._calling[receiver] -= 1

    def send(self, job: Job, url: str, attempt: int) -> float | None:
        """Makes one attempt; returns the seconds until the next one, or None if none follows."""
        assert self._secret is not None, "else there are no calls"
        metrics = self._parts.service.metrics
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
            metrics.webhooks.labels("not-allowed").inc()
            return None  # a retry would not be allowed either
        except Unreachable as error:
            log.info("webhook of job %s, attempt %d: %s", job.id, attempt, error)
            status = None
        if status in SUCCESS or status == GONE:
            metrics.webhooks.labels("delivered" if status in SUCCESS else "gone").inc()
            return None
        metrics.webhooks.labels("unreachable" if status is None else "refused").inc()
        if attempt > len(RETRY_SECONDS):
            log.warning(
                "webhook of job %s: given up after %d attempts, the last answer was %s", job.id, attempt, status
            )
            metrics.webhooks_given_up.inc()
            return None
        return RETRY_SECONDS[attempt - 1] * random.uniform(1 - JITTER, 1 + JITTER)  # so that retries spread


def sign(secret: str, message: str, moment: str, body: bytes) -> str:
    """The signature of a message (Standard Webhooks, symmetric): HMAC-SHA256 of id, time and body, base64."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signed = hmac.new(key, f"{message}.{moment}.".encode() + body, hashlib.sha256).digest()
    return "v1," + base64.b64encode(signed).decode()
