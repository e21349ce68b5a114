"""The job database as a file: of one server, whose worker processes write to it as well."""

from __future__ import annotations

import fcntl
import os
import sqlite3
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import StorageUnavailable
from cow_service.jobs.database import Database, database_errors
from cow_service.media.artifacts import PRIVATE, disk_errors, make_private
from cow_service.settings import SettingsError

BUSY_TIMEOUT_MS = 30_000  # how long a writer waits for another one
MAX_LOG_BYTES = 16_000_000  # of the write-ahead log; beyond, it is truncated when it restarts
INCREMENTAL = 2  # SQLite's number of that mode
VACUUM_PAGES, KEPT_FREE_PAGES = 500, 500  # of 4 kB: given back at a time, and kept for what is written next


class FolderHeld(SettingsError):
    """Another server works on the job database in the folder."""


class Sqlite(Database):
    """A file. Whoever holds its folder is the only process that takes jobs: those that others had are nobody's."""

    is_shared = False
    now = (sa.func.julianday("now") - 2440587.5) * 86400.0

    def __init__(self, file: Path) -> None:
        self.file = file
        self._held: int | None = None  # the descriptor of the folder
        self._executor = ""
        super().__init__(sa.create_engine(f"sqlite:///{file}", pool_size=16, max_overflow=32, hide_parameters=True))
        event.listen(self.engine, "connect", _prepare)

    def acquire(self) -> str:
        """As the base class says. The system gives the folder back however the process ends."""
        try:
            make_private(self.file.parent)
            self._held = os.open(self.file.parent, os.O_RDONLY)
        except OSError as error:
            raise SettingsError(f"Cannot use {self.file.parent} for the job database: {error.strerror}.") from error
        try:
            fcntl.flock(self._held, fcntl.LOCK_EX | fcntl.LOCK_NB)  # on the folder: a file could be deleted
        except BlockingIOError as error:
            self.release()
            raise FolderHeld(
                f"Another server works on the jobs in {self.file.parent}. Use that one, give this one another folder "
                "(COW_DATA_DIR, or COW_DATABASE_URL), or share jobs by PostgreSQL."
            ) from error
        self._executor = uuid4().hex
        return self._executor

    def create_tables(self) -> None:
        """As the base class says. Makes the file and its folder."""
        with disk_errors():
            make_private(self.file.parent)
            self.file.touch(PRIVATE)  # SQLite gives its other files the same mode
        super().create_tables()

    @contextmanager
    def ended(self, executors: Iterable[str]) -> Generator[list[str]]:
        """All others: this process holds the folder."""
        yield [one for one in executors if one != self._executor]

    def release(self) -> None:
        """As the base class says."""
        if self._held is not None:
            os.close(self._held)
            self._held = None

    @contextmanager
    def transaction(self, *, durable: bool = False) -> Generator[sa.Connection]:
        """As the base class says."""
        with database_errors(), self.engine.connect() as connection:
            if durable:  # not within a transaction
                connection.connection.execute("PRAGMA synchronous=FULL")
            try:
                with connection.begin():
                    yield connection
            finally:
                if durable:
                    connection.connection.execute("PRAGMA synchronous=NORMAL")

    def flush(self) -> None:
        """As the base class says."""
        try:
            with self.file.with_name(self.file.name + "-wal").open("r+b") as journal:
                os.fsync(journal)
        except FileNotFoundError:
            pass  # all of it is in the file, which is synced before the journal goes
        except OSError as error:
            raise StorageUnavailable("The job database cannot be written to the disk.") from error

    def lock(self, connection: sa.Connection, number: int) -> None:
        """Of everything: there is one writer at a time."""
        connection.execute(sa.text("BEGIN IMMEDIATE"))

    def give_room_back(self, stop: Callable[[], bool]) -> None:
        """As the base class says."""
        with database_errors(), self._reading.connect() as connection:
            cursor = connection.connection.cursor()

            def pragma(text: str) -> int:
                cursor.execute(f"PRAGMA {text}")
                rows = cursor.fetchall()  # all of them: SQLite gives a page back for each
                return rows[0][0] if rows and rows[0] else 0

            if pragma("auto_vacuum") != INCREMENTAL:  # the file of an earlier version: it is rewritten once
                if pragma("freelist_count") > pragma("page_count") / 2:
                    pragma("auto_vacuum=INCREMENTAL")
                    cursor.execute("VACUUM")
            else:
                while (free := pragma("freelist_count") - KEPT_FREE_PAGES) > 0 and not stop():
                    pragma(f"incremental_vacuum({min(free, VACUUM_PAGES)})")
            pragma("wal_checkpoint(PASSIVE)")  # the file is cut by it

    @contextmanager
    def _cursor(self, *, writes: bool = False) -> Generator[Any]:
        """As the base class says."""
        with database_errors():
            connection = self.engine.raw_connection()
            try:
                yield connection.cursor()
                connection.commit()
            except BaseException:
                # SQLite closes a connection only when its last statement is gone, and the traceback may hold that: the
                # transaction, and with it the lock that every writer needs, would stay open as long.
                with suppress(SQLAlchemyError, sqlite3.Error):
                    connection.rollback()
                connection.invalidate()  # it may be in a state that the next user does not expect
                raise
            finally:
                connection.close()

    def _plain(self, statement: str) -> str:
        return statement


def _prepare(connection: Any, _: object) -> None:
    # The first one works only in a file without tables, and before the mode of its journal is set.
    for pragma in (
        "auto_vacuum=INCREMENTAL",
        "journal_mode=WAL",
        f"journal_size_limit={MAX_LOG_BYTES}",
        "synchronous=NORMAL",
        f"busy_timeout={BUSY_TIMEOUT_MS}",
        "foreign_keys=ON",
    ):
        connection.execute(f"PRAGMA {pragma}")
