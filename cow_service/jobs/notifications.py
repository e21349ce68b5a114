"""What the processes on one job database tell each other of jobs: queued, progress, ended, canceled.

All of it only makes things quick: what counts is in the database.
"""

import json
import time
from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Literal

import psycopg
import sqlalchemy as sa

from cow_service.concurrency import BackgroundThread
from cow_service.errors import CowError
from cow_service.jobs.computing import EngineParts
from cow_service.requests import Stage

CHANNEL = "cow_jobs"
RECONNECT_SECONDS = 1.0  # after a session was lost
LISTEN_SECONDS = 1.0  # of one wait, after which it is looked whether to stop
POLL_SECONDS = 0.05  # between two looks at SQLite, where somebody waits
POLL_SHARE = 20  # and so many times as long as one took
PROGRESS_SECONDS = 0.2  # between two messages on the progress of a job


@dataclass(frozen=True)
class Notification:
    """What happened to a job. `stage` and `done` are those of its progress."""

    what: Literal["queued", "progress", "ended", "canceled"]
    job_id: str
    stage: Stage | None = None
    done: float = 0.0


Receive = Callable[[Notification], None]


class Notifications(BackgroundThread):
    """Sends to the other processes, and receives from them in a thread of its own."""

    def __init__(self, parts: EngineParts, receive: Receive) -> None:
        """`receive` is called with what other processes send."""
        super().__init__("cow-notifications")
        self._parts, self._receive = parts, receive

    @abstractmethod
    def send(self, notification: Notification) -> None:
        """Tells all processes. What cannot be told is found in the database later."""


class PostgresNotifications(Notifications):
    """By LISTEN and NOTIFY."""

    def __init__(self, parts: EngineParts, receive: Receive) -> None:
        super().__init__(parts, receive)
        self._sent: dict[str, float] = {}  # when the progress of a job was last sent

    def send(self, notification: Notification) -> None:
        """As the base class says."""
        now = time.monotonic()
        if notification.what != "progress":
            self._sent.pop(notification.job_id, None)
        elif now - self._sent.get(notification.job_id, 0.0) < PROGRESS_SECONDS:
            return
        else:
            self._sent[notification.job_id] = now
        with suppress(CowError):
            payload = json.dumps([self._parts.executor, asdict(notification)])
            self._parts.database.read(sa.select(sa.func.pg_notify(CHANNEL, payload)))

    def run(self) -> None:
        """Receives, and opens another session where one is lost."""
        while not self._stop.is_set():
            try:
                with self._parts.database.session() as session:
                    with self._parts.database.limited(session):
                        session.execute(f"LISTEN {CHANNEL}")
                    while not self._stop.is_set():
                        for message in session.notifies(timeout=LISTEN_SECONDS):
                            with suppress(ValueError, TypeError):  # of another version
                                sender, values = json.loads(message.payload)
                                if sender != self._parts.executor:
                                    self._receive(Notification(**values))
            except psycopg.Error:
                self._stop.wait(RECONNECT_SECONDS)


class PolledNotifications(Notifications):
    """On SQLite, whose processes are on one machine: asks for the end of jobs that somebody waits for."""

    def send(self, notification: Notification) -> None:
        """Does nothing."""

    def run(self) -> None:
        """Looks the more rarely, the longer a look takes."""
        took = 0.0
        while not self._stop.wait(max(POLL_SECONDS, POLL_SHARE * took)):
            began = time.monotonic()
            if awaited := self._parts.active.awaited_elsewhere():
                with suppress(CowError):
                    for job_id in self._parts.jobs.ended_of(awaited):
                        self._receive(Notification("ended", job_id))
            took = time.monotonic() - began
