"""The job database: SQLite in the data folder, or PostgreSQL by COW_DATABASE_URL. DBOS keeps its tables beside ours.

`cow_stage_results` keeps the results of stages under their cache keys, `cow_trajectories` the trajectories, which are
most of them (`kept_apart.py`). `cow_holds` has the artifact references: which job needs which artifact. An artifact
without a reference may be removed.
"""

from __future__ import annotations

import os
import sqlite3
import sys
import time
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import StorageUnavailable
from cow_service.jobs.kept_apart import key_in, whole
from cow_service.jobs.packing import deflated, inflated, packed, unpacked
from cow_service.jobs.tables import METADATA, REFERENCES, RESULTS, STAGES, TRAJECTORIES
from cow_service.settings import Settings, SettingsError

BUSY_TIMEOUT_MS = 30_000  # how long SQLite waits for another writer
MAX_IDS = 500  # in one statement
CONNECT_SECONDS = 4  # for a connection to PostgreSQL
MAX_LOG_BYTES = 16_000_000  # of SQLite's write-ahead log, beyond which it is cut when it begins anew
TABLES_LOCK = 0x434F5701  # of PostgreSQL, held while tables are created
INCREMENTAL = 2  # SQLite's number of that mode
VACUUM_PAGES, KEPT_FREE_PAGES = 500, 500  # of 4 kB: given back at a time, and kept for what is written next

# These run several times in every job: as plain text they take a fifth of the time that expressions do.
_FIND = "SELECT job_id, result FROM cow_stage_results WHERE key = ?"
# A result that lost its artifacts is computed again, and replaces the one that was there.
_SAVE = (
    "INSERT INTO cow_stage_results (key, job_id, stage, result, created_at) VALUES (?, ?, ?, ?, ?) "
    "ON CONFLICT (key) DO UPDATE SET job_id = excluded.job_id, result = excluded.result, "
    "created_at = excluded.created_at"
)
_SAVE_TRAJECTORY = (
    "INSERT INTO cow_trajectories (job_id, key, trajectory) VALUES (?, ?, ?) "
    "ON CONFLICT (job_id, key) DO UPDATE SET trajectory = excluded.trajectory"
)
_FIND_TRAJECTORY = "SELECT trajectory FROM cow_trajectories WHERE job_id = ? AND key = ?"
_DONE = "INSERT INTO cow_job_stages (job_id, stage) VALUES (?, ?) ON CONFLICT DO NOTHING"
_ADD_REFERENCES = "INSERT INTO cow_holds (sha256, job_id) VALUES {} ON CONFLICT DO NOTHING"


class Database:
    """One engine for DBOS and for our own tables. Every method raises `StorageUnavailable` where it cannot be used."""

    def __init__(self, settings: Settings) -> None:
        self.url, self.file = _address(settings)
        self.engine = _engine(self.url, self.file is not None)
        self._reading = self.engine.execution_options(isolation_level="AUTOCOMMIT")  # single statements

    def create_tables(self) -> None:
        """Makes our tables where they are missing, and the folder of a file."""
        if self.file is not None:
            self.file.parent.mkdir(parents=True, exist_ok=True)
        with database_errors(), self.engine.begin() as connection:
            if self.file is None:  # two processes that create the same table at the same time would fail one another
                connection.execute(sa.text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": TABLES_LOCK})
            METADATA.create_all(connection)

    def check_tables(self) -> None:
        """Raises `StorageUnavailable` where a table of ours is missing."""
        with database_errors():
            missing = METADATA.tables.keys() - set(sa.inspect(self.engine).get_table_names())
        if missing:
            raise StorageUnavailable(f"The job database has no table {min(missing)}: run `cow migrate` first.")

    def claim(self, address: str) -> None:
        """Notes where the artifacts of all jobs are. Raises `StorageUnavailable` where they are elsewhere.

        A server with a store of its own would take jobs whose images it does not have, and fail them.
        """
        with self._cursor() as cursor:
            cursor.execute(
                self._plain("INSERT INTO cow_artifact_store (id, address) VALUES (1, ?) ON CONFLICT DO NOTHING"),
                (address,),
            )
            cursor.execute("SELECT address FROM cow_artifact_store WHERE id = 1")
            known = cursor.fetchone()[0]
        if known != address:
            raise StorageUnavailable(
                f"The jobs of this database have their images in {known}, and this server in {address}. Give all "
                "servers on a database the same COW_ARTIFACTS: an object store, or a folder on a disk that they share, "
                "by default that of COW_DATA_DIR. Or give this one another COW_DATABASE_URL. Where that place is lost "
                "for good, delete the row of the table cow_artifact_store."
            )

    def check(self) -> None:
        """Runs a query that always succeeds where the database can be used."""
        with database_errors(), self._reading.connect() as connection:
            connection.execute(sa.text("SELECT 1"))

    def check_server(self) -> None:
        """As `check`, but only of a database server: DBOS would wait for one that is down, and so would the caller."""
        if self.file is None:
            self.check()

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

            if pragma("auto_vacuum") != INCREMENTAL:  # the file of an earlier version: it is written anew once
                if pragma("freelist_count") > pragma("page_count") / 2:
                    pragma("auto_vacuum=INCREMENTAL")
                    cursor.execute("VACUUM")
            else:
                while (free := pragma("freelist_count") - KEPT_FREE_PAGES) > 0 and not stop():
                    pragma(f"incremental_vacuum({min(free, VACUUM_PAGES)})")
            pragma("wal_checkpoint(PASSIVE)")  # the file is cut by it

    def close(self) -> None:
        """Closes its connections."""
        self.engine.dispose()

    def notify(self, channel: str, payload: str) -> None:
        """Tells all who listen to a channel of PostgreSQL."""
        with database_errors(), self._reading.connect() as connection:
            connection.execute(
                sa.text("SELECT pg_notify(:channel, :payload)"), {"channel": channel, "payload": payload}
            )

    def flush(self) -> None:
        """Returns once everything that was committed is on the disk, and so outlives a loss of power."""
        if self.file is None:
            with database_errors(), self.engine.begin() as connection:
                connection.execute(sa.text("SET LOCAL synchronous_commit = on"))
                connection.execute(sa.text("SELECT txid_current()"))  # a commit that waits for all before it
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

    def find_result(self, key: str) -> tuple[str, str] | None:
        """The job that computed a stage's result, and the result as JSON."""
        with self._cursor() as cursor:
            cursor.execute(self._plain(_FIND), (key,))
            row = cursor.fetchone()
        if row is None:
            return None
        job, text = row[0], self.whole(row[0], unpacked(row[1]), "value")
        return None if text is None else (job, text)

    def whole(self, job: str, text: str, name: str = "trajectory") -> str | None:
        """The result of a job as JSON, or of a stage, with the trajectory that the job keeps apart from it.

        None where there is none any more: the job was deleted.
        """
        key = key_in(text, name)
        if key is None:
            return text
        with self._cursor() as cursor:
            cursor.execute(self._plain(_FIND_TRAJECTORY), (job, key))
            row = cursor.fetchone()
        return None if row is None else whole(text, name, inflated(row[0]), key)

    def store_result(
        self, key: str, job: str, stage: str, result: str, artifacts: Iterable[str], trajectory: str | None = None
    ) -> None:
        """Adds references to a stage's artifacts, and saves its result, and the trajectory that is apart from it."""
        with self._cursor(writes=True) as cursor:
            self._add_references(cursor, job, artifacts)
            if trajectory is not None:
                cursor.execute(self._plain(_SAVE_TRAJECTORY), (job, key, deflated(trajectory)))
            cursor.execute(self._plain(_SAVE), (key, job, stage, packed(result), time.time()))
            cursor.execute(self._plain(_DONE), (job, stage))

    def reuse_result(self, job: str, stage: str, artifacts: Iterable[str]) -> None:
        """Adds references to the artifacts of a result that another job had computed."""
        with self._cursor(writes=True) as cursor:
            self._add_references(cursor, job, artifacts)
            cursor.execute(self._plain(_DONE), (job, stage))

    def finished_stages(self, job: str) -> set[str]:
        """The stages of a job that are done."""
        return self._column(sa.select(STAGES.c.stage).where(STAGES.c.job_id == job))

    def add_references(self, job: str, artifacts: Iterable[str]) -> None:
        """Notes that a job needs some artifacts."""
        with self._cursor() as cursor:
            self._add_references(cursor, job, artifacts)

    def remove_jobs(self, jobs: list[str]) -> list[str]:
        """Removes the results and references of some jobs; returns the artifacts that no job needs any more."""
        artifacts: set[str] = set()
        with database_errors(), self.engine.begin() as connection:
            for chunk in _chunks(jobs):
                theirs = sa.select(REFERENCES.c.sha256).where(REFERENCES.c.job_id.in_(chunk)).distinct()
                artifacts |= set(connection.execute(theirs).scalars())
                connection.execute(sa.delete(REFERENCES).where(REFERENCES.c.job_id.in_(chunk)))
                for ours in (RESULTS, TRAJECTORIES, STAGES):
                    connection.execute(sa.delete(ours).where(ours.c.job_id.in_(chunk)))
        return list(artifacts - self.referenced(artifacts))

    def referenced(self, artifacts: Iterable[str]) -> set[str]:
        """Those of some artifacts that a job needs."""
        found: set[str] = set()
        for chunk in _chunks(list(artifacts)):
            found |= self._column(sa.select(REFERENCES.c.sha256).where(REFERENCES.c.sha256.in_(chunk)))
        return found

    def artifacts_of(self, jobs: Iterable[str]) -> set[str]:
        """The artifacts that some jobs need."""
        found: set[str] = set()
        for chunk in _chunks(list(jobs)):
            found |= self._column(sa.select(REFERENCES.c.sha256).where(REFERENCES.c.job_id.in_(chunk)))
        return found

    def jobs_with(self, sha256: str) -> list[str]:
        """The jobs that need an artifact."""
        return list(self._column(sa.select(REFERENCES.c.job_id).where(REFERENCES.c.sha256 == sha256)))

    def _column(self, query: Any) -> set[str]:
        with database_errors(), self._reading.connect() as connection:
            return set(connection.execute(query).scalars())

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


@contextmanager
def database_errors() -> Generator[None]:
    """Translates the database's errors to `StorageUnavailable`. Their own text may hold addresses, and is left out."""
    try:
        yield
    except (SQLAlchemyError, sqlite3.Error, *_driver_errors()) as error:
        raise StorageUnavailable(
            f"The job database cannot be used ({type(error).__name__}): see COW_DATABASE_URL, and the disk it is on."
        ) from error


def _driver_errors() -> tuple[type[Exception], ...]:
    """Those of PostgreSQL's driver, which takes long to import where it is not needed."""
    driver = sys.modules.get("psycopg")
    return () if driver is None else (driver.Error,)


def _chunks(values: list[str]) -> Iterable[list[str]]:
    return (values[i : i + MAX_IDS] for i in range(0, len(values), MAX_IDS))


def _address(settings: Settings) -> tuple[str, Path | None]:
    """The URL, and the file where it is SQLite. Raises `SettingsError` without repeating it: it may hold a password."""
    given = None if settings.database_url is None else settings.database_url.get_secret_value()
    if given is None:
        file = settings.data_dir / "jobs.sqlite3"
        return f"sqlite:///{file}", file
    try:
        url = sa.make_url(given)
    except SQLAlchemyError as error:
        raise SettingsError("Bad settings: COW_DATABASE_URL is no database URL.") from error
    if url.get_backend_name() == "sqlite" and url.database:
        return given, Path(url.database)
    if url.get_backend_name() in ("postgresql", "postgres"):
        return url.set(drivername="postgresql+psycopg").render_as_string(hide_password=False), None
    raise SettingsError("Bad settings: COW_DATABASE_URL must be sqlite:///FILE or postgresql://USER@HOST/DATABASE.")


def _engine(url: str, is_file: bool) -> sa.Engine:
    if not is_file:
        # A commit survives the end of this process at once; `flush` waits for the disk where that matters.
        options = {"options": "-c synchronous_commit=off", "connect_timeout": CONNECT_SECONDS}
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
