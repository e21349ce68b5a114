"""The job database: SQLite in the data folder, or PostgreSQL by COW_DATABASE_URL. DBOS has its tables there, too."""

from __future__ import annotations

import logging
import math
import os
import socket
import sqlite3
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import DisconnectionError, OperationalError, SQLAlchemyError

from cow_service.concurrency import BackgroundThread
from cow_service.errors import Canceled, StorageUnavailable
from cow_service.jobs import schema
from cow_service.jobs.packing import packed, packed_paths, unpacked
from cow_service.jobs.schema import JOBS, MAINTENANCE, REFERENCES, SCHEMA, STAGES, STORES
from cow_service.media.artifacts import PRIVATE, disk_errors, make_private
from cow_service.settings import Settings, SettingsError

if TYPE_CHECKING:
    import psycopg

BUSY_TIMEOUT_MS = 30_000  # how long SQLite waits for another writer
MAX_IDS = 500  # in one statement
CONNECT_SECONDS = 4  # for a connection to PostgreSQL
STALLED_SECONDS = 5.0  # longest use of a connection; a transaction needs milliseconds
IDLE_SECONDS = 1.0  # after which it is asked for a sign of life before it is used again
MAX_LOG_BYTES = 16_000_000  # of SQLite's write-ahead log; beyond, it is truncated when it restarts
TABLES_LOCK = 0x434F5701  # of PostgreSQL, held while tables are created
INCREMENTAL = 2  # SQLite's number of that mode
VACUUM_PAGES, KEPT_FREE_PAGES = 500, 500  # of 4 kB: given back at a time, and kept for what is written next
OPEN = ("queued", "running")  # the statuses of jobs that have not ended

# These run several times in every job: as plain text they take a fifth of the time that expressions do.
_FIND = (
    "SELECT r.job_id, r.result, t.trajectory FROM cow_results r "
    "LEFT JOIN cow_trajectories_of_jobs t ON t.job_id = r.job_id AND t.key = r.key WHERE r.key = ?"
)
# A result that lost its artifacts is computed again, and replaces the one that was there.
_SAVE = (
    "INSERT INTO cow_results (key, job_id, stage, result, created_at) VALUES (?, ?, ?, ?, ?) "
    "ON CONFLICT (key) DO UPDATE SET job_id = excluded.job_id, result = excluded.result, "
    "created_at = excluded.created_at"
)
_SAVE_TRAJECTORY = (
    "INSERT INTO cow_trajectories_of_jobs (job_id, key, trajectory) VALUES (?, ?, ?) "
    "ON CONFLICT (job_id, key) DO UPDATE SET trajectory = excluded.trajectory"
)
_DONE = "INSERT INTO cow_stages_of_jobs (job_id, stage) VALUES (?, ?) ON CONFLICT DO NOTHING"
_ADD_REFERENCES = "INSERT INTO cow_references (sha256, job_id) VALUES {} ON CONFLICT DO NOTHING"

log = logging.getLogger("cow_service")


@dataclass(frozen=True)
class StoredResult:
    """The result of a stage, to be stored."""

    key: str
    stage: str
    result: str  # JSON
    artifacts: tuple[str, ...]
    trajectory: str | None = None  # JSON: its value, where that is stored apart from it


class Database:
    """One engine for DBOS and for our own tables. Every method raises `StorageUnavailable` where it cannot be used."""

    def __init__(self, settings: Settings, *, read_only: bool = False) -> None:
        """`read_only`: a file must exist, and is not changed."""
        self.url, self.file = _address(settings)
        if read_only and self.file is not None:
            self.engine = sa.create_engine(f"sqlite:///file:{quote(str(self.file.resolve()))}?mode=ro&uri=true")
        else:
            self.engine = _engine(self.url, self.file is not None)
        self.stalled = None if self.file is not None else StalledConnections(self.engine)
        self._reading = self.engine.execution_options(isolation_level="AUTOCOMMIT")  # single statements
        # The database's clock, Unix time in s: those of machines differ.
        self.now: sa.ColumnElement[float] = (sa.func.julianday("now") - 2440587.5) * 86400.0
        if self.file is None:
            self.now = sa.cast(sa.extract("epoch", sa.func.clock_timestamp()), sa.Float)

    def prepare(self, *, migrate: bool) -> None:
        """Makes our tables, or looks whether they are there. Raises `StorageUnavailable`."""
        if migrate:
            self.create_tables()
        elif self.schema() < SCHEMA:
            raise StorageUnavailable("The job database lacks tables of this version of COW: run `cow migrate` first.")

    def create_tables(self) -> None:
        """Makes our tables, or adds what those of an earlier version lack, and makes the folder of a file.

        Those of a later version stay as they are. Raises `StorageUnavailable` if this one cannot serve on them, or
        would change them in a way that processes which run do not bear.
        """
        if self.file is not None:
            with disk_errors():
                make_private(self.file.parent)
                self.file.touch(PRIVATE)  # SQLite gives its other files the same mode
        with self.transaction() as connection:
            # Two processes that create the same table at the same time would fail one another.
            lock = f"SELECT pg_advisory_xact_lock({TABLES_LOCK})" if self.file is None else "BEGIN IMMEDIATE"
            connection.execute(sa.text(lock))
            schema.update_tables(connection, self.now)
        with database_errors(), self._reading.connect() as connection:
            schema.add_indexes(connection)

    def schema(self) -> int:
        """That of the tables; 0 where there are none. Raises `StorageUnavailable` if this version cannot use it."""
        with database_errors(), self.engine.connect() as connection:
            return schema.schema_of(connection)

    def claim(self, address: str) -> None:
        """Notes where the artifacts of all jobs are. Raises `StorageUnavailable` if they are elsewhere.

        A server with a store of its own would take jobs whose images it does not have, and fail them.
        """
        with self.transaction() as connection:
            connection.execute(self.insert(STORES).on_conflict_do_nothing(), {"id": 1, "address": address})
            known = connection.execute(sa.select(STORES.c.address)).scalar_one()
        if known != address:
            raise StorageUnavailable(
                f"The jobs of this database have their images in {known}, and this server in {address}. Give all "
                "servers on a database the same COW_ARTIFACTS: an object store, or a folder on a disk that they share, "
                "by default that of COW_DATA_DIR. Or give this one another COW_DATABASE_URL. If that place is lost "
                "for good, delete the row of the table cow_artifact_store."
            )

    def check(self) -> None:
        """Runs a query that always succeeds where the database can be used."""
        self.read(sa.text("SELECT 1"))

    def is_away(self) -> bool:
        """Whether PostgreSQL is unreachable or refuses connections, as at its start. A file never is."""
        if self.file is not None:
            return False
        try:
            with self.engine.connect():
                return False
        except OperationalError:
            return True

    def read(self, query: sa.Executable, values: dict[str, Any] | None = None) -> Sequence[Any]:
        """The rows of a single query, with the values of its parameters."""
        with database_errors(), self._reading.connect() as connection:
            return connection.execute(query, values).all()

    def insert(self, table: sa.Table) -> postgresql.Insert | sqlite.Insert:
        """An insertion that can say what becomes of rows that are there."""
        return (postgresql if self.file is None else sqlite).insert(table)

    @contextmanager
    def transaction(self, *, durable: bool = False) -> Generator[sa.Connection]:
        """A connection whose statements are committed together at the end of the block.

        With `durable` they are on the disk by then, before anybody can read them. Without it they outlive this process,
        but not a crash of PostgreSQL or of the machine within the next second: `flush` waits for them.
        """
        with database_errors(), self.engine.connect() as connection:
            if durable and self.file is not None:  # not within a transaction
                connection.connection.execute("PRAGMA synchronous=FULL")
            try:
                with connection.begin():
                    if durable and self.file is None:
                        connection.execute(sa.text("SET LOCAL synchronous_commit = on"))
                    yield connection
            finally:
                if durable and self.file is not None:
                    connection.connection.execute("PRAGMA synchronous=NORMAL")

    def give_room_back(self, stop: Callable[[], bool]) -> None:
        """Returns the room of removed rows to the disk, in steps between which others write.

        PostgreSQL does it by itself.
        """
        if self.file is None:
            return
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

    def close_idle(self) -> None:
        """Closes the unused connections; they are opened again when needed."""
        self.engine.dispose()

    def close(self) -> None:
        """Closes its connections."""
        if self.stalled is not None:
            self.stalled.stop()
        self.engine.dispose()

    def watch(self) -> None:
        """From now on no statement waits for ever for an answer. Work on the tables themselves may take longer."""
        if self.stalled is not None:
            self.stalled.start()

    def session(self) -> psycopg.Connection[Any]:
        """A connection to PostgreSQL of the caller's own. Raises `psycopg.Error`."""
        import psycopg  # noqa: PLC0415 # costly to import where it is not needed

        address = sa.make_url(self.url).set(drivername="postgresql").render_as_string(hide_password=False)
        return psycopg.connect(address, autocommit=True, connect_timeout=CONNECT_SECONDS)

    def limited(self, session: psycopg.Connection[Any]) -> AbstractContextManager[None]:
        """Limits the time that the block takes with a session, from `watch` on."""
        return self.stalled.limited(session) if self.stalled else nullcontext()

    def flush(self) -> None:
        """Returns once everything that was committed is on the disk, and so outlives a loss of power."""
        if self.file is None:
            with self.transaction() as connection:
                connection.execute(sa.text("SET LOCAL synchronous_commit = on"))
                # Only a transaction that wrote something to the log waits for the disk, and then for all before it.
                connection.execute(sa.text("SELECT pg_logical_emit_message(true, 'cow', '')"))
            return
        log = self.file.with_name(self.file.name + "-wal")
        try:
            descriptor = os.open(log if log.exists() else self.file, os.O_RDWR)
        except OSError as error:
            raise StorageUnavailable("The job database cannot be written to the disk.") from error
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def find_result(self, key: str, job: str = "", store: Sequence[StoredResult] = ()) -> tuple[str, Any] | None:
        """The job that computed a stage's result, and the result as JSON values.

        First it stores results of a job, in the same transaction. Raises as `store_results` does.
        """
        with self._cursor(writes=bool(store)) as cursor:
            self._store(cursor, job, store)
            cursor.execute(self._plain(_FIND), (key,))
            row = cursor.fetchone()
        if row is None:
            return None
        job, result, trajectory = row[0], unpacked(row[1]), row[2]
        if trajectory is not None:
            result["value"] = unpacked(trajectory)
        return job, result

    def store_results(self, job: str, results: Sequence[StoredResult]) -> None:
        """Adds references to the artifacts of a job's stages, and saves their results together.

        Raises `Canceled` if the job was deleted.
        """
        with self._cursor(writes=True) as cursor:
            self._store(cursor, job, results)

    def _store(self, cursor: Any, job: str, results: Sequence[StoredResult]) -> None:
        self._add_references(cursor, job, [sha256 for each in results for sha256 in each.artifacts])
        for each in results:
            if each.trajectory is not None:
                cursor.execute(self._plain(_SAVE_TRAJECTORY), (job, each.key, packed_paths(each.trajectory)))
            cursor.execute(self._plain(_SAVE), (each.key, job, each.stage, packed(each.result), time.time()))
            cursor.execute(self._plain(_DONE), (job, each.stage))

    def reuse_result(self, job: str, stage: str, artifacts: Iterable[str]) -> None:
        """Adds references to the artifacts of a result that another job had computed. Raises as `store_results`."""
        with self._cursor(writes=True) as cursor:
            self._add_references(cursor, job, artifacts)
            cursor.execute(self._plain(_DONE), (job, stage))

    def finished_stages(self, job: str) -> set[str]:
        """The stages of a job that are done."""
        return self._column(sa.select(STAGES.c.stage).where(STAGES.c.job_id == job))

    def referenced(self, artifacts: Iterable[str]) -> set[str]:
        """Those of some artifacts that a job needs."""
        found, all_of_them = set[str](), list(artifacts)
        for start in range(0, len(all_of_them), MAX_IDS):
            some = all_of_them[start : start + MAX_IDS]
            found |= self._column(sa.select(REFERENCES.c.sha256).where(REFERENCES.c.sha256.in_(some)).distinct())
        return found

    def referenced_by_open_jobs(self) -> set[str]:
        """The artifacts that jobs need which have not ended."""
        return self._column(sa.select(REFERENCES.c.sha256).join(JOBS).where(JOBS.c.status.in_(OPEN)))

    def take_turn(self, task: str, seconds: float) -> bool:
        """Whether no process has begun a task of maintenance for so long: it is then the caller's alone."""
        now = time.time()
        due = MAINTENANCE.c.task == task, MAINTENANCE.c.begun <= now - seconds
        with self.transaction() as connection:
            connection.execute(self.insert(MAINTENANCE).on_conflict_do_nothing(), {"task": task, "begun": 0})
            return connection.execute(sa.update(MAINTENANCE).where(*due).values(begun=now)).rowcount > 0

    def give_turn_back(self, task: str) -> None:
        """The task was not done: the next process that asks may take it."""
        with self.transaction() as connection:
            connection.execute(sa.update(MAINTENANCE).where(MAINTENANCE.c.task == task).values(begun=0))

    def _column(self, query: sa.Executable) -> set[str]:
        return {row[0] for row in self.read(query)}

    @contextmanager
    def _cursor(self, *, writes: bool = False) -> Generator[Any]:
        """A cursor of a pooled connection. In PostgreSQL each statement is a transaction, unless all of them write:
        they are then sent together, and are one. In SQLite all together are.
        """
        with database_errors():
            connection: Any = self.engine.raw_connection()
            try:
                if self.file is None:
                    connection.dbapi_connection.autocommit = True  # else every statement takes three messages
                sent_together = writes and self.file is None
                with connection.dbapi_connection.pipeline() if sent_together else nullcontext():
                    yield connection.cursor()
                connection.commit()
                if self.file is None:
                    connection.dbapi_connection.autocommit = False
            except BaseException:
                # SQLite closes a connection only when its last statement is gone, and the traceback may hold that: the
                # transaction, and with it the lock that every writer needs, would stay open as long.
                with suppress(SQLAlchemyError, sqlite3.Error):
                    if self.file is not None:
                        connection.rollback()
                connection.invalidate()  # it may be gone, or in a state that the next user does not expect
                raise
            finally:
                connection.close()

    def _plain(self, statement: str) -> str:
        return statement if self.file is not None else statement.replace("?", "%s")

    def _add_references(self, cursor: Any, job: str, artifacts: Iterable[str]) -> None:
        rows = [value for sha256 in dict.fromkeys(artifacts) for value in (sha256, job)]
        if rows:
            cursor.execute(self._plain(_ADD_REFERENCES.format(", ".join(["(?, ?)"] * (len(rows) // 2)))), rows)


class StalledConnections(BackgroundThread):
    """Ends connections to PostgreSQL that are in use for too long: a network may lose answers without a sign.

    A caller that waits for such an answer gets an error. A pooled connection that was idle is tried before it is used.
    """

    def __init__(self, engine: sa.Engine) -> None:
        import psycopg  # noqa: PLC0415 # costly to import where it is not needed

        super().__init__("cow-stalled-connections")
        self._driver_error = psycopg.Error
        self._guard = threading.Lock()
        self._in_use: dict[psycopg.Connection[Any], float] = {}
        self._is_used = threading.Event()
        event.listen(engine, "checkout", self._take)
        event.listen(engine, "checkin", self._give_back)
        event.listen(engine, "invalidate", self._give_back)

    @contextmanager
    def limited(self, connection: psycopg.Connection[Any]) -> Generator[None]:
        """Limits the time that the block takes with a connection."""
        self._begin(connection)
        try:
            yield
        finally:
            self._end(connection)

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
            except self._driver_error as error:  # the pool makes another one
                raise DisconnectionError from error

    def _give_back(
        self, connection: psycopg.Connection[Any] | None, entry: sa.pool.ConnectionPoolEntry, _: object = None
    ) -> None:
        entry.info["idle_since"] = time.monotonic()
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
                    with (
                        suppress(OSError, self._driver_error),
                        socket.socket(fileno=os.dup(connection.fileno())) as stalled,
                    ):
                        stalled.shutdown(socket.SHUT_RDWR)


@contextmanager
def database_errors() -> Generator[None]:
    """Translates the database's errors to `StorageUnavailable`. Their own text may hold addresses, and is left out.

    What belongs to a job that was deleted meanwhile cannot be stored: this raises `Canceled`. PostgreSQL's driver,
    which takes long to import, is asked for its errors only where it is in use.
    """
    try:
        yield
    except (SQLAlchemyError, sqlite3.Error, getattr(sys.modules.get("psycopg"), "Error", sqlite3.Error)) as error:
        if "IntegrityError" in (kind.__name__ for kind in type(error).__mro__):
            raise Canceled("The job was deleted before it was finished.") from error
        raise StorageUnavailable(
            f"The job database cannot be used ({type(error).__name__}): check COW_DATABASE_URL and its disk."
        ) from error


def _address(settings: Settings) -> tuple[str, Path | None]:
    """The URL, and the file where it is SQLite. Raises `SettingsError` without repeating it: it may hold a password."""
    given = None if settings.database_url is None else settings.database_url.get_secret_value()
    if given is None:
        file = settings.data_dir / "jobs.sqlite3"
        return f"sqlite:///{file}", file
    try:
        url = sa.make_url(given)
    except SQLAlchemyError as error:
        raise SettingsError("Bad settings: COW_DATABASE_URL is not a database URL.") from error
    if url.get_backend_name() == "sqlite" and url.database:
        return given, Path(url.database)
    if url.get_backend_name() in ("postgresql", "postgres"):
        return url.set(drivername="postgresql+psycopg").render_as_string(hide_password=False), None
    raise SettingsError("Bad settings: COW_DATABASE_URL must be sqlite:///FILE or postgresql://USER@HOST/DATABASE.")


def _engine(url: str, is_file: bool) -> sa.Engine:
    if not is_file:
        options = {
            # A commit outlives the end of this process at once, and is on the disk where that matters (`transaction`).
            "options": "-c synchronous_commit=off -c statement_timeout=60s -c lock_timeout=20s",
            "connect_timeout": CONNECT_SECONDS,
            "keepalives_idle": 10,
            "keepalives_interval": 3,
            "keepalives_count": 3,
            "tcp_user_timeout": int(1000 * STALLED_SECONDS),
        }
        return sa.create_engine(url, pool_size=16, max_overflow=32, hide_parameters=True, connect_args=options)
    engine = sa.create_engine(url, pool_size=16, max_overflow=32, hide_parameters=True)

    @event.listens_for(engine, "connect")
    def prepare(connection: object, _: object) -> None:  # pyright: ignore[reportUnusedFunction]
        connection.isolation_level = "IMMEDIATE"  # type: ignore[attr-defined] # writers wait instead of failing
        # The first one works only in a file without tables, and before the mode of its journal is set.
        for pragma in (
            "auto_vacuum=INCREMENTAL",
            "journal_mode=WAL",
            f"journal_size_limit={MAX_LOG_BYTES}",
            "synchronous=NORMAL",
            f"busy_timeout={BUSY_TIMEOUT_MS}",
            "foreign_keys=ON",
        ):
            connection.execute(f"PRAGMA {pragma}")  # type: ignore[attr-defined]

    return engine
