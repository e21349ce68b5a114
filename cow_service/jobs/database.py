"""The job database: SQLite in the data folder, or PostgreSQL by COW_DATABASE_URL. DBOS keeps its tables beside ours.

`cow_stage_results` holds what stages came to, by the digest of what decided it. `cow_holds` says which job needs which
artifact: an artifact that no job holds may go.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import StorageUnavailable
from cow_service.settings import Settings, SettingsError

BUSY_MS = 30_000  # how long SQLite waits for another writer
AT_ONCE = 500  # ids in one statement

_metadata = sa.MetaData()
_results = sa.Table(
    "cow_stage_results",
    _metadata,
    sa.Column("key", sa.String(64), primary_key=True),
    sa.Column("job_id", sa.String(64), nullable=False, index=True),
    sa.Column("stage", sa.String(32), nullable=False),
    sa.Column("result", sa.Text, nullable=False),
    sa.Column("created_at", sa.Float, nullable=False),
)
_holds = sa.Table(
    "cow_holds",
    _metadata,
    sa.Column("sha256", sa.String(64), primary_key=True),
    sa.Column("job_id", sa.String(64), primary_key=True, index=True),
)
# The stages of each job that are done, whoever computed their results.
_stages = sa.Table(
    "cow_job_stages",
    _metadata,
    sa.Column("job_id", sa.String(64), primary_key=True),
    sa.Column("stage", sa.String(32), primary_key=True),
)
# These run several times in every job: as plain text they take a fifth of the time that expressions do.
_FIND = "SELECT job_id, result FROM cow_stage_results WHERE key = ?"
# A result that lost its artifacts is made anew, and replaces the one that was there.
_KEEP = (
    "INSERT INTO cow_stage_results (key, job_id, stage, result, created_at) VALUES (?, ?, ?, ?, ?) "
    "ON CONFLICT (key) DO UPDATE SET job_id = excluded.job_id, result = excluded.result, "
    "created_at = excluded.created_at"
)
_DONE = "INSERT INTO cow_job_stages (job_id, stage) VALUES (?, ?) ON CONFLICT DO NOTHING"
_HOLD = "INSERT INTO cow_holds (sha256, job_id) VALUES {} ON CONFLICT DO NOTHING"


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
        with database_errors():
            _metadata.create_all(self.engine)

    def check(self) -> None:
        """Asks the database for something."""
        with database_errors(), self._reading.connect() as connection:
            connection.execute(sa.text("SELECT 1"))

    def check_far(self) -> None:
        """As `check`, where the database is a server: DBOS would wait for one that is away, and so would the caller."""
        if self.file is None:
            self.check()

    def close(self) -> None:
        """Lets go of its connections."""
        self.engine.dispose()

    def settle(self) -> None:
        """What was committed is on the disk when this returns, and outlives a loss of power, too."""
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
        return None if row is None else (row[0], row[1])

    def store_result(self, key: str, job: str, stage: str, result: str, artifacts: Iterable[str]) -> None:
        """Holds a stage's artifacts for the job, then stores its result: in this order, each may stand alone."""
        with self._cursor() as cursor:
            self._hold(cursor, job, artifacts)
            cursor.execute(self._plain(_KEEP), (key, job, stage, result, time.time()))
            cursor.execute(self._plain(_DONE), (job, stage))

    def reuse_result(self, job: str, stage: str, artifacts: Iterable[str]) -> None:
        """Holds the artifacts of a result that another job had computed."""
        with self._cursor() as cursor:
            self._hold(cursor, job, artifacts)
            cursor.execute(self._plain(_DONE), (job, stage))

    def finished_stages(self, job: str) -> set[str]:
        """The stages of a job that are done."""
        with database_errors(), self._reading.connect() as connection:
            return set(connection.execute(sa.select(_stages.c.stage).where(_stages.c.job_id == job)).scalars())

    def hold(self, job: str, artifacts: Iterable[str]) -> None:
        """Holds artifacts for a job."""
        with self._cursor() as cursor:
            self._hold(cursor, job, artifacts)

    def forget(self, jobs: list[str]) -> list[str]:
        """Removes what was kept for some jobs; returns the artifacts that no job holds any more."""
        loose: set[str] = set()
        with database_errors(), self.engine.begin() as connection:
            for some in _parts(jobs):
                mine = sa.select(_holds.c.sha256).where(_holds.c.job_id.in_(some)).distinct()
                loose |= set(connection.execute(mine).scalars())
                connection.execute(sa.delete(_holds).where(_holds.c.job_id.in_(some)))
                connection.execute(sa.delete(_results).where(_results.c.job_id.in_(some)))
                connection.execute(sa.delete(_stages).where(_stages.c.job_id.in_(some)))
        held = self.held(loose)
        return [sha256 for sha256 in loose if sha256 not in held]

    def held(self, artifacts: Iterable[str]) -> set[str]:
        """Those of some artifacts that a job holds."""
        found: set[str] = set()
        with database_errors(), self._reading.connect() as connection:
            for some in _parts(list(artifacts)):
                found |= set(connection.execute(sa.select(_holds.c.sha256).where(_holds.c.sha256.in_(some))).scalars())
        return found

    def holds(self, job: str, sha256: str) -> bool:
        """Whether a job holds an artifact."""
        with database_errors(), self._reading.connect() as connection:
            query = sa.select(_holds.c.job_id).where(_holds.c.sha256 == sha256, _holds.c.job_id == job)
            return connection.execute(query).first() is not None

    def holders(self, sha256: str) -> list[str]:
        """The jobs that hold an artifact."""
        with database_errors(), self._reading.connect() as connection:
            return list(connection.execute(sa.select(_holds.c.job_id).where(_holds.c.sha256 == sha256)).scalars())

    @contextmanager
    def _cursor(self) -> Generator[Any]:
        """A cursor of a pooled connection. In PostgreSQL each statement is a transaction, in SQLite all together."""
        with database_errors():
            connection: Any = self.engine.raw_connection()
            try:
                if self.file is None:
                    connection.dbapi_connection.autocommit = True  # else every statement takes three messages
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

    def _hold(self, cursor: Any, job: str, artifacts: Iterable[str]) -> None:
        rows = [value for sha256 in dict.fromkeys(artifacts) for value in (sha256, job)]
        if rows:
            cursor.execute(self._plain(_HOLD.format(", ".join(["(?, ?)"] * (len(rows) // 2)))), rows)

    def jobs(self) -> list[str]:
        """The jobs for which something is kept."""
        with database_errors(), self._reading.connect() as connection:
            both = sa.union(sa.select(_holds.c.job_id), sa.select(_results.c.job_id))
            return list(connection.execute(both).scalars())


@contextmanager
def database_errors() -> Generator[None]:
    """What the database raises, as `StorageUnavailable`. Its own words may hold addresses, and are left out."""
    try:
        yield
    except (SQLAlchemyError, sqlite3.Error, psycopg.Error) as error:
        raise StorageUnavailable(
            f"The job database cannot be used ({type(error).__name__}): see COW_DATABASE_URL, and the disk it is on."
        ) from error


def _parts(values: list[str]) -> Iterable[list[str]]:
    return (values[i : i + AT_ONCE] for i in range(0, len(values), AT_ONCE))


def _address(settings: Settings) -> tuple[str, Path | None]:
    """The URL, and the file where it is SQLite. Raises `SettingsError` without repeating it: it may hold a password."""
    told = None if settings.database_url is None else settings.database_url.get_secret_value()
    if told is None:
        file = settings.data_dir / "jobs.sqlite3"
        return f"sqlite:///{file}", file
    try:
        url = sa.make_url(told)
    except SQLAlchemyError as error:
        raise SettingsError("Bad settings: COW_DATABASE_URL is no database URL.") from error
    if url.get_backend_name() == "sqlite" and url.database:
        return told, Path(url.database)
    if url.get_backend_name() in ("postgresql", "postgres"):
        return url.set(drivername="postgresql+psycopg").render_as_string(hide_password=False), None
    raise SettingsError("Bad settings: COW_DATABASE_URL must be sqlite:///FILE or postgresql://USER@HOST/DATABASE.")


def _engine(url: str, is_file: bool) -> sa.Engine:
    if not is_file:
        # A commit is safe from the end of this process at once; `settle` waits for the disk where that matters.
        options = {"options": "-c synchronous_commit=off"}
        return sa.create_engine(url, pool_size=16, max_overflow=32, hide_parameters=True, connect_args=options)
    engine = sa.create_engine(url, pool_size=16, max_overflow=32, hide_parameters=True)

    @event.listens_for(engine, "connect")
    def prepare(connection: object, _: object) -> None:  # pyright: ignore[reportUnusedFunction]
        connection.isolation_level = "IMMEDIATE"  # type: ignore[attr-defined] # writers wait instead of failing
        for pragma in ("journal_mode=WAL", "synchronous=NORMAL", f"busy_timeout={BUSY_MS}", "foreign_keys=ON"):
            connection.execute(f"PRAGMA {pragma}")  # type: ignore[attr-defined]

    return engine
