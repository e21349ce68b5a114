"""What processes use of PostgreSQL besides tables: leases held by sessions, and LISTEN and NOTIFY.

Both need a session of their own: behind pgbouncer in transaction mode, one that does not go through it.
"""

import hashlib
import json
import logging
import threading
import time
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import asdict
from typing import Any, LiteralString
from uuid import uuid4

import psycopg
import sqlalchemy as sa

from cow_service.concurrency import BackgroundThread
from cow_service.errors import CowError
from cow_service.jobs.computing import EngineParts
from cow_service.jobs.database import Database, database_errors
from cow_service.jobs.notifications import Notification, Notifications, Receive

BEAT_SECONDS = 5.0  # between two signs of life
SILENCE_SECONDS = 16.0  # after which PostgreSQL ends the session of a lease
CONFIRM_SECONDS = 2.5  # that a lease must be free: after a restart of the server everybody's is for a moment
CHANNEL = "cow_jobs"
RECONNECT_SECONDS = 1.0  # after a session was lost
LISTEN_SECONDS = 1.0  # of one wait, after which it is looked whether to stop
PROGRESS_SECONDS = 0.5  # between two messages on the progress of a job


log = logging.getLogger("cow_service")


class SessionLease(BackgroundThread):
    """The lease of a process on PostgreSQL: an advisory lock of a session, which ends after a silence.

    So also a process that is frozen, or whose machine is gone, loses it.
    """

    def __init__(self, database: Database) -> None:
        super().__init__("cow-lease")
        self._database = database
        self._executor = ""
        self._session: psycopg.Connection[Any] | None = None
        self._guard = threading.Lock()
        self._free_since: dict[str, float] = {}

    def acquire(self) -> str:
        """As `Lease` says."""
        self._executor = uuid4().hex
        with database_errors():
            self._open()
        self.start()
        return self._executor

    @contextmanager
    def ended(self, executors: Iterable[str]) -> Generator[list[str]]:
        """As `Lease` says. One counts as ended when its lease was free before, too."""
        with self._guard:
            session = self._session
            if session is None:  # an outage: live and ended processes cannot be told apart
                yield []
                return
            free = set[str]()
            try:
                with database_errors():
                    for one in set(executors) - {self._executor}:
                        free |= {one} if self._ask(session, "SELECT pg_try_advisory_lock(%s)", _key(one)) else set()
                now = time.monotonic()
                self._free_since = {one: self._free_since.get(one, now) for one in free}
                yield [one for one, since in self._free_since.items() if now - since >= CONFIRM_SECONDS]
            finally:
                with suppress(psycopg.Error):  # with the session its locks end, too
                    for one in free:
                        self._ask(session, "SELECT pg_advisory_unlock(%s)", _key(one))

    def release(self) -> None:
        """As `Lease` says."""
        self.stop()
        self._close()

    def run(self) -> None:
        """Keeps the session alive, and takes the lease again after an outage."""
        while not self._stop.wait(BEAT_SECONDS):
            with self._guard:
                try:
                    if self._session is None:
                        self._open()
                    else:
                        self._ask(self._session, "SELECT 1")
                except psycopg.Error:
                    log.warning("this process lost its lease and takes it again when the database is back")
                    self._close()
                    self._free_since = {}

    def _open(self) -> None:
        session = self._database.session()
        self._ask(session, "SELECT set_config('idle_session_timeout', %s, false)", f"{SILENCE_SECONDS:g}s")
        self._ask(session, "SELECT pg_advisory_lock(%s)", _key(self._executor))  # held briefly by whoever checks it
        self._session = session

    def _close(self) -> None:
        session, self._session = self._session, None
        with suppress(psycopg.Error):
            if session is not None:
                session.close()

    def _ask(self, session: psycopg.Connection[Any], statement: LiteralString, *values: object) -> object:
        """The value that a statement returns. Raises `psycopg.Error`, also where no answer comes."""
        with self._database.limited(session):
            row = session.execute(statement, values).fetchone()
        return None if row is None else row[0]


def _key(executor: str) -> int:
    return int.from_bytes(hashlib.sha256(executor.encode()).digest()[:8], signed=True)


class PostgresNotifications(Notifications):
    """By LISTEN and NOTIFY."""

    def __init__(self, parts: EngineParts, receive: Receive) -> None:
        super().__init__(parts, receive)
        self._sent: dict[str, float] = {}  # when the progress of a job was last sent

    def send(self, notification: Notification) -> None:
        """As the base class says."""
        if self._is_due(notification):
            with suppress(CowError):
                self._parts.database.read(self._statement(notification))

    def send_within(self, connection: sa.Connection, notification: Notification) -> None:
        """As the base class says."""
        if self._is_due(notification):
            connection.execute(self._statement(notification))

    def _is_due(self, notification: Notification) -> bool:
        """Whether it is time to tell of it: not of every step of progress."""
        now = time.monotonic()
        if notification.what != "progress":
            self._sent.pop(notification.job_id, None)
        elif now - self._sent.get(notification.job_id, -PROGRESS_SECONDS) < PROGRESS_SECONDS:
            return False
        else:
            self._sent[notification.job_id] = now
        return True

    def _statement(self, notification: Notification) -> sa.Select[Any]:
        payload = json.dumps([self._parts.executor, asdict(notification)])
        return sa.select(sa.func.pg_notify(CHANNEL, payload))

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
