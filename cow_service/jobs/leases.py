"""Who is alive: each process has an executor id in the job database and a lease on it, which ends with the process.

On SQLite the lease is a lock file of the data folder, which the operating system releases however the process ends. On
PostgreSQL it is an advisory lock of a session that the server ends when nothing was heard for a while: also a process
that is frozen, or whose machine is gone, loses it.
"""

from __future__ import annotations

import hashlib
import logging
import threading
import time
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol
from uuid import uuid4

import psycopg
import sqlalchemy as sa
from filelock import FileLock, Timeout

from cow_service.errors import StorageUnavailable
from cow_service.jobs.database import Database, database_errors

BEAT_SECONDS = 1.5  # between two signs of life
SILENCE_SECONDS = 8.0  # after which PostgreSQL ends the session of a lease
CONFIRM_SECONDS = 2.5  # that a lease must be free: after a restart of the server everybody's is for a moment

log = logging.getLogger("cow_service")


class Lease(Protocol):
    """The lease of this process, and a view of those of others."""

    def acquire(self) -> str:
        """Takes a lease on a new executor id, and returns the id. Raises `StorageUnavailable`."""
        ...

    @contextmanager
    def ended(self, executors: Iterable[str]) -> Generator[list[str]]:
        """Those of some executors whose processes have ended. Nobody else finds them inside the block."""
        ...

    def release(self) -> None:
        """Gives the lease back."""
        ...


class FolderLease:
    """On SQLite: a lock file."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock: FileLock | None = None
        self._executor = ""

    def acquire(self) -> str:
        """As the protocol says."""
        self._executor = uuid4().hex
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._lock = FileLock(self._folder / f"{self._executor}.lock")
            self._lock.acquire(timeout=0)
        except OSError as error:
            raise StorageUnavailable("The data folder cannot be written: no place for this process.") from error
        return self._executor

    @contextmanager
    def ended(self, executors: Iterable[str]) -> Generator[list[str]]:
        """As the protocol says."""
        locks: dict[str, FileLock] = {}
        try:
            for executor in set(executors) - {self._executor}:
                lock = FileLock(self._folder / f"{executor}.lock")
                with suppress(Timeout):
                    lock.acquire(timeout=0)
                    locks[executor] = lock
            yield list(locks)
        finally:
            for lock in locks.values():
                lock.release()
                Path(lock.lock_file).unlink(missing_ok=True)

    def release(self) -> None:
        """As the protocol says."""
        if self._lock is not None:
            self._lock.release()
            Path(self._lock.lock_file).unlink(missing_ok=True)
            self._lock = None


class SessionLease:
    """On PostgreSQL: an advisory lock of a session of its own."""

    def __init__(self, database: Database) -> None:
        self._address = sa.make_url(database.url).set(drivername="postgresql").render_as_string(hide_password=False)
        self._executor = ""
        self._session: psycopg.Connection[Any] | None = None
        self._guard = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._free_since: dict[str, float] = {}

    def acquire(self) -> str:
        """As the protocol says."""
        self._executor = uuid4().hex
        self._stop.clear()
        with database_errors():
            self._open()
        self._thread = threading.Thread(target=self._beat, name="cow-lease", daemon=True)
        self._thread.start()
        return self._executor

    @contextmanager
    def ended(self, executors: Iterable[str]) -> Generator[list[str]]:
        """As the protocol says. One counts as ended when its lease was free before, too."""
        with self._guard:
            session = self._session
            if session is None:  # an outage: nobody can be told from those that have ended
                yield []
                return
            free = set[str]()
            try:
                with database_errors():
                    free |= {one for one in set(executors) - {self._executor} if _try_lock(session, one)}
                now = time.monotonic()
                self._free_since = {one: self._free_since.get(one, now) for one in free}
                yield [one for one, since in self._free_since.items() if now - since >= CONFIRM_SECONDS]
            finally:
                with suppress(psycopg.Error):  # with the session its locks end, too
                    for one in free:
                        session.execute("SELECT pg_advisory_unlock(%s)", (_key(one),))

    def release(self) -> None:
        """As the protocol says."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._session is not None:
            with suppress(psycopg.Error):
                self._session.close()
            self._session = None

    def _beat(self) -> None:
        """Keeps the session alive, and takes the lease again after an outage."""
        while not self._stop.wait(BEAT_SECONDS):
            with self._guard:
                try:
                    if self._session is None:
                        self._open()
                    else:
                        self._session.execute("SELECT 1")
                except psycopg.Error:
                    log.warning("the lease of this process was lost: it is taken again when the database is back")
                    if self._session is not None:
                        with suppress(psycopg.Error):
                            self._session.close()
                    self._session = None
                    self._free_since = {}

    def _open(self) -> None:
        session = psycopg.connect(self._address, autocommit=True, connect_timeout=4)
        session.execute("SELECT set_config('idle_session_timeout', %s, false)", (f"{SILENCE_SECONDS:g}s",))
        session.execute("SELECT pg_advisory_lock(%s)", (_key(self._executor),))  # held by who looks at it, for a moment
        self._session = session


def _try_lock(session: psycopg.Connection[Any], executor: str) -> bool:
    row = session.execute("SELECT pg_try_advisory_lock(%s)", (_key(executor),)).fetchone()
    return row is not None and bool(row[0])


def _key(executor: str) -> int:
    return int.from_bytes(hashlib.sha256(executor.encode()).digest()[:8], signed=True)


def lease_of(database: Database, folder: Path) -> Lease:
    """The lease of a process on a database; `folder` is that of the lock files."""
    return SessionLease(database) if database.file is None else FolderLease(folder)
