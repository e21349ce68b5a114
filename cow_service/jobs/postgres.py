"""The job database on PostgreSQL: of several servers, each with a lease that a session of its own holds.

What they notify each other of comes by LISTEN and NOTIFY.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import asdict
from typing import Any, LiteralString
from uuid import uuid4

import psycopg
import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import DisconnectionError

from cow_service.concurrency import BackgroundThread
from cow_service.jobs.database import Database, Notification, Receive, database_errors, unavailable
from cow_service.settings import SettingsError

CONNECT_SECONDS = 4  # for a connection
STALLED_SECONDS = 5.0  # longest use of a connection; a transaction needs milliseconds
IDLE_SECONDS = 1.0  # after which it is asked for a sign of life before it is used again
SILENCE_SECONDS = 16.0  # after which PostgreSQL ends the session of a lease
CONFIRM_SECONDS = 2.5  # that a lease must be free: after a restart of the server everybody's is for a moment
CHANNEL = "cow_jobs"
RECONNECT_SECONDS = 1.0  # after a session was lost
LISTEN_SECONDS = 1.0  # of one wait, after which it is looked whether to stop
POOLED = (
    "COW_DATABASE_URL leads through a pooler that gives a session to others between transactions, as PgBouncer does in "
    "transaction mode: leases and notifications need sessions. Connect directly, or by a pool in session mode."
)

_OPTIONS: dict[str, Any] = {  # of every connection
    "connect_timeout": CONNECT_SECONDS,
    "keepalives_idle": 10,
    "keepalives_interval": 3,
    "keepalives_count": 3,
    "tcp_user_timeout": int(1000 * STALLED_SECONDS),
}

log = logging.getLogger("cow_service")


class Postgres(Database):
    """A server. A lease is an advisory lock of a session, which ends after a silence: also a process that is frozen, or
    whose machine is gone, loses it.
    """

    is_shared = True
    now = sa.cast(sa.extract("epoch", sa.func.clock_timestamp()), sa.Float)

    def __init__(self, url: sa.URL) -> None:
        options = {
            # A commit outlives the end of this process at once, and is on the disk where that matters (`transaction`).
            "options": "-c synchronous_commit=off -c statement_timeout=60s -c lock_timeout=4s",
            **_OPTIONS,
        }
        pool = {"pool_size": 16, "max_overflow": 32, "hide_parameters": True}
        super().__init__(sa.create_engine(url, connect_args=options, **pool))
        self._address = url.set(drivername="postgresql").render_as_string(hide_password=False)
        self._stalled = StalledConnections(self.engine)
        self._executor = ""
        self._lease: psycopg.Connection[Any] | None = None
        self._backend = 0  # PostgreSQL's process that has the session of the lease
        self._free_since: dict[str, float] = {}
        self._listener: Listener | None = None

    def acquire(self) -> str:
        """As the base class says."""
        self._executor = uuid4().hex
        with database_errors():
            self._open_lease()
            assert self._lease is not None
            with self._session() as other, other.transaction():
                # In a pool the session of the lease is free now: the other one gets it, or it is another afterwards.
                shared = self._ask(other, "SELECT pg_backend_pid()") == self._backend
                if shared or not self._holds():
                    self.release()
                    raise SettingsError(POOLED)
        return self._executor

    def keep(self) -> None:
        """As the base class says."""
        try:
            if self._lease is None:
                self._open_lease()
            elif not self._holds():
                raise psycopg.OperationalError  # as where the session has ended
        except psycopg.Error:
            if self._lease is not None:
                log.warning("this process lost its lease and takes it again when the database is back")
            self.release()

    @contextmanager
    def ended(self, executors: Iterable[str]) -> Generator[list[str]]:
        """As the base class says. One counts as ended when its lease was free before, too."""
        session = self._lease
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
        """As the base class says."""
        session, self._lease, self._free_since = self._lease, None, {}
        with suppress(psycopg.Error):
            if session is not None:
                session.close()

    def watch(self, receive: Receive) -> None:
        """As the base class says. No statement waits for ever for an answer either: work on tables may take longer."""
        self._stalled.start()
        self._listener = Listener(self._listen, receive, self._executor)
        self._listener.start()

    def notify(self, connection: sa.Connection, *notifications: Notification) -> None:
        """As the base class says."""
        for one in notifications:
            payload = json.dumps([self._executor, asdict(one)])
            connection.execute(sa.select(sa.func.pg_notify(CHANNEL, payload)))

    @contextmanager
    def transaction(self, *, durable: bool = False) -> Generator[sa.Connection]:
        """As the base class says."""
        with database_errors(), self.engine.begin() as connection:
            if durable:
                connection.execute(sa.text("SET LOCAL synchronous_commit = on"))
            yield connection

    def check(self) -> None:
        """As the base class says: a standby answers, and cannot be used."""
        ((read_only,),) = self.read(sa.text("SELECT current_setting('transaction_read_only')"))
        if read_only == "on":
            raise unavailable("25006")

    def flush(self) -> None:
        """As the base class says."""
        with self.transaction(durable=True) as connection:
            # Only a transaction that wrote something to the log waits for the disk, and then for all before it.
            connection.execute(sa.text("SELECT pg_logical_emit_message(true, 'cow', '')"))

    def lock(self, connection: sa.Connection, number: int) -> None:
        """As the base class says."""
        connection.execute(sa.select(sa.func.pg_advisory_xact_lock(number)))

    def close(self) -> None:
        """As the base class says."""
        if self._listener is not None:
            self._listener.stop()
        self._stalled.stop()
        super().close()

    @contextmanager
    def _cursor(self, *, writes: bool = False) -> Generator[Any]:
        """As the base class says: statements that write are sent together. Others are a transaction each."""
        with database_errors():
            connection: Any = self.engine.raw_connection()
            try:
                connection.dbapi_connection.autocommit = True  # else every statement takes three messages
                if writes:
                    with connection.dbapi_connection.pipeline():
                        yield connection.cursor()
                else:
                    yield connection.cursor()
                connection.dbapi_connection.autocommit = False
            except BaseException:
                connection.invalidate()  # it may be gone, or in a state that the next user does not expect
                raise
            finally:
                connection.close()

    def _plain(self, statement: str) -> str:
        return statement.replace("?", "%s")

    def _session(self) -> psycopg.Connection[Any]:
        """A connection apart from the pool. Raises `psycopg.Error`."""
        return psycopg.connect(self._address, autocommit=True, **_OPTIONS)

    def _open_lease(self) -> None:
        session = self._session()
        self._ask(session, "SELECT set_config('idle_session_timeout', %s, false)", f"{SILENCE_SECONDS:g}s")
        self._ask(session, "SELECT pg_advisory_lock(%s)", _key(self._executor))  # held briefly by whoever checks it
        self._lease, self._backend = session, int(self._ask(session, "SELECT pg_backend_pid()"))

    def _holds(self) -> bool:
        """Whether the session is still the one that took the lock, and has it. Raises `psycopg.Error`."""
        assert self._lease is not None
        held = "SELECT pg_backend_pid() FROM pg_locks WHERE locktype = 'advisory' AND pid = pg_backend_pid() LIMIT 1"
        return self._ask(self._lease, held) == self._backend

    def _ask(self, session: psycopg.Connection[Any], statement: LiteralString, *values: object) -> Any:
        """The value that a statement returns. Raises `psycopg.Error`, also where no answer comes."""
        with self._stalled.limited(session):
            row = session.execute(statement, values).fetchone()
        return None if row is None else row[0]

    def _listen(self) -> psycopg.Connection[Any]:
        session = self._session()
        with self._stalled.limited(session):
            session.execute(f"LISTEN {CHANNEL}")
        return session


class Listener(BackgroundThread):
    """Receives what other processes notify of, and opens another session where one is lost."""

    def __init__(self, listen: Callable[[], psycopg.Connection[Any]], receive: Receive, executor: str) -> None:
        super().__init__("cow-notifications")
        self._listen, self._receive, self._executor = listen, receive, executor

    def run(self) -> None:
        """Receives until it is stopped."""
        while not self._stop.is_set():
            try:
                with self._listen() as session:
                    self._receive(Notification("queued", ""))  # perhaps, while nobody listened
                    while not self._stop.is_set():
                        for message in session.notifies(timeout=LISTEN_SECONDS):
                            try:
                                sender, values = json.loads(message.payload)
                                if sender != self._executor:
                                    self._receive(Notification(**values))
                            except Exception:  # of another version, for example
                                log.exception("a notification was not understood")
            except psycopg.Error:
                self._stop.wait(RECONNECT_SECONDS)


class StalledConnections(BackgroundThread):
    """Ends connections that are in use for too long: a network may lose answers without a sign.

    A caller that waits for such an answer gets an error. A pooled connection that was idle is tried before it is used,
    and one to a server that has become read-only is not kept.
    """

    def __init__(self, engine: sa.Engine) -> None:
        super().__init__("cow-stalled-connections")
        self._guard = threading.Lock()
        self._in_use: dict[psycopg.Connection[Any], float] = {}
        self._is_used = threading.Event()
        event.listen(engine, "checkout", self._take)
        event.listen(engine, "checkin", self._give_back)
        event.listen(engine, "invalidate", self._give_back)
        event.listen(engine, "handle_error", _lose_read_only)

    @contextmanager
    def limited(self, connection: psycopg.Connection[Any]) -> Generator[None]:
        """Limits the time that the block takes with a connection, once the thread runs."""
        self._begin(connection)
        try:
            yield
        finally:
            self._end(connection)

    def stop(self) -> None:
        """Ends the thread."""
        self._stop.set()
        self._is_used.set()
        super().stop()

    def run(self) -> None:
        """Checks the connections in use."""
        while not self._stop.wait(STALLED_SECONDS / 10):
            if not self._in_use:
                self._is_used.clear()
                if not self._in_use and not self._stop.is_set():  # `stop` sets it before this event
                    self._is_used.wait()
            late = time.monotonic() - STALLED_SECONDS
            with self._guard:  # its socket is not closed meanwhile, nor the number of that given to another one
                for connection in [one for one, since in self._in_use.items() if since < late]:
                    del self._in_use[connection]
                    log.warning("a connection to the job database does not answer and is closed")
                    with suppress(OSError, psycopg.Error), socket.socket(fileno=os.dup(connection.fileno())) as stalled:
                        stalled.shutdown(socket.SHUT_RDWR)

    def _begin(self, connection: psycopg.Connection[Any]) -> None:
        with self._guard:
            self._in_use[connection] = time.monotonic()
        self._is_used.set()

    def _end(self, connection: psycopg.Connection[Any] | None) -> None:
        with self._guard:
            self._in_use.pop(connection, None)  # type: ignore[arg-type] # None: it was ended before

    def _take(self, connection: psycopg.Connection[Any], entry: sa.pool.ConnectionPoolEntry, _: object) -> None:
        self._begin(connection)
        if time.monotonic() - entry.info.get("idle_since", math.inf) > IDLE_SECONDS:
            try:
                connection.execute("")
                connection.rollback()
            except psycopg.Error as error:  # the pool makes another one
                raise DisconnectionError from error

    def _give_back(
        self, connection: psycopg.Connection[Any] | None, entry: sa.pool.ConnectionPoolEntry, _: object = None
    ) -> None:
        entry.info["idle_since"] = time.monotonic()
        self._end(connection)


def _lose_read_only(context: sa.engine.ExceptionContext) -> None:
    """After a failover connections may lead to what is a standby now: all of the pool are made anew."""
    if isinstance(context.original_exception, psycopg.errors.ReadOnlySqlTransaction):
        context.is_disconnect = context.invalidate_pool_on_disconnect = True


def _key(executor: str) -> int:
    return int.from_bytes(hashlib.sha256(executor.encode()).digest()[:8], signed=True)
