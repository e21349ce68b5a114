"""The job database: what is the same in SQLite (`sqlite.py`) and in PostgreSQL (`postgres.py`)."""

from __future__ import annotations

import logging
import sqlite3
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Iterable, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import Canceled, StorageUnavailable
from cow_service.jobs import schema
from cow_service.jobs.schema import JOBS, MAINTENANCE, REFERENCES, SCHEMA, STAGES, STORES, packed, unpacked
from cow_service.records import Stage
from cow_service.settings import SettingsError

MAX_IDS = 500  # in one statement
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

# What the databases say, by SQLSTATE, SQLite's names and classes of errors, in words after "The job database".
_REASONS = {
    "OperationalError": "cannot be reached",
    "ConnectionTimeout": "cannot be reached",
    "25006": "is read-only, as a standby of PostgreSQL is",
    "55P03": "has tables that another session has locked",
    "57014": "took too long, perhaps as another session has locked its tables",
    "53100": "has a full disk",
    "53300": "has no connections left",
    "57P03": "is starting or stopping",
    "42501": "does not give this role the rights that it needs",
    "SQLITE_BUSY": "is locked by another process",
    "SQLITE_READONLY": "is a file that cannot be written",
    "SQLITE_CANTOPEN": "is a file that cannot be opened",
    "SQLITE_FULL": "has a full disk",
    "SQLITE_CORRUPT": "is a damaged file",
    "SQLITE_NOTADB": "is a file of another kind",
}

log = logging.getLogger("cow_service")


@dataclass(frozen=True)
class Notification:
    """What happened to a job in another process. `stage` and `done` are those of its progress."""

    what: Literal["queued", "progress", "ended", "canceled"]
    job_id: str
    stage: Stage | None = None
    done: float = 0.0


Receive = Callable[[Notification], None]


@dataclass(frozen=True)
class StoredResult:
    """The result of a stage, to be stored."""

    key: str
    stage: str
    result: str  # JSON
    artifacts: tuple[str, ...]
    trajectory: str | None = None  # JSON: its value, where that is stored apart from it


class Database(ABC):
    """The tables of jobs. Every method raises `StorageUnavailable` where the database cannot be used."""

    is_shared: ClassVar[bool]  # whether several processes take jobs from it
    now: sa.ColumnElement[float]  # the database's clock, Unix time in s: those of machines differ

    def __init__(self, engine: sa.Engine) -> None:
        self.engine = engine
        self._reading = engine.execution_options(isolation_level="AUTOCOMMIT")  # single statements

    # What differs.

    @abstractmethod
    def acquire(self) -> str:
        """Takes a lease, which lasts as long as this process works on jobs; returns the id of its holder.

        Raises `SettingsError` where this process cannot have one on this database.
        """

    def keep(self) -> None:  # noqa: B027 # a lease that cannot be lost needs nothing
        """Verifies the lease, which is taken again after an outage. Called every few seconds."""

    @abstractmethod
    def ended(self, executors: Iterable[str]) -> AbstractContextManager[list[str]]:
        """Those of some holders that have ended. Inside the block no other process can say so of them."""

    @abstractmethod
    def release(self) -> None:
        """Gives the lease back."""

    def watch(self, receive: Receive) -> None:  # noqa: B027 # a file has no other processes
        """From now on `receive` is called with what other processes notify of, in a thread."""

    def notify(self, connection: sa.Connection, *notifications: Notification) -> None:  # noqa: B027 # likewise
        """Notifies the other processes once the transaction of a connection is committed.

        This only makes things quick: what counts is in the tables.
        """

    @abstractmethod
    def transaction(self, *, durable: bool = False) -> AbstractContextManager[sa.Connection]:
        """A connection whose statements are committed together at the end of the block.

        With `durable` they are on the disk by then, before anybody can read them. Without it they outlive this process,
        but not a crash of PostgreSQL or of the machine within the next second: `flush` waits for them.
        """

    @abstractmethod
    def flush(self) -> None:
        """Returns once everything that was committed is on the disk, and so outlives a loss of power."""

    @abstractmethod
    def lock(self, connection: sa.Connection, number: int) -> None:
        """Holds a lock of this number until the transaction of the connection ends."""

    def give_room_back(self, stop: Callable[[], bool]) -> None:  # noqa: B027 # PostgreSQL does it by itself
        """Returns the room of removed rows to the disk, in steps between which others write, until `stop` says so."""

    @abstractmethod
    def _cursor(self, *, writes: bool = False) -> AbstractContextManager[Any]:
        """A cursor whose statements, all of which write with `writes`, are one transaction."""

    @abstractmethod
    def _plain(self, statement: str) -> str:
        """A statement with the driver's marks in place of question marks."""

    def insert(self, table: sa.Table) -> postgresql.Insert | sqlite.Insert:
        """An insertion that can say what becomes of rows that are there."""
        return (postgresql if self.is_shared else sqlite).insert(table)

    # What is the same.

    def prepare(self, *, migrate: bool) -> None:
        """Makes our tables, or looks whether they are there."""
        if migrate:
            self.create_tables()
        elif self.schema() < SCHEMA:
            raise StorageUnavailable("The job database lacks tables of this version of COW: run `cow migrate` first.")

    def create_tables(self) -> None:
        """Makes our tables, or adds what those of an earlier version lack. Those of a later version stay as they are.

        Raises as `schema.update_tables`.
        """
        with self.transaction() as connection:
            self.lock(connection, schema.TABLES_LOCK)  # two processes that create the same table fail one another
            schema.update_tables(connection, self.now)
        with database_errors(), self._reading.connect() as connection:
            schema.add_indexes(connection)

    def schema(self) -> int:
        """That of the tables; 0 where there are none. Raises `SettingsError` if this version cannot use it."""
        with database_errors(), self.engine.connect() as connection:
            return schema.schema_of(connection)

    def claim(self, address: str) -> None:
        """Notes where the artifacts of all jobs are. Raises `SettingsError` if they are elsewhere.

        A server with a store of its own would take jobs whose images it does not have, and fail them.
        """
        with self.transaction() as connection:
            connection.execute(self.insert(STORES).on_conflict_do_nothing(), {"id": 1, "address": address})
            known = connection.execute(sa.select(STORES.c.address)).scalar_one()
        if known != address:
            raise SettingsError(
                f"The jobs of this database have their images in {known}, and this server in {address}. Give all "
                "servers on a database the same COW_ARTIFACTS: an object store, or a folder on a disk that they share, "
                "by default that of COW_DATA_DIR. Or give this one another COW_DATABASE_URL. If that place is lost "
                "for good, delete the row of the table cow_artifact_store."
            )

    def check(self) -> None:
        """Runs a query that always succeeds where the database can be used."""
        self.read(sa.text("SELECT 1"))

    def read(self, query: sa.Executable, values: dict[str, Any] | None = None) -> Sequence[Any]:
        """The rows of a single query, with the values of its parameters."""
        with database_errors(), self._reading.connect() as connection:
            return connection.execute(query, values).all()

    def close_idle(self) -> None:
        """Closes the unused connections; they are opened again when needed."""
        self.engine.dispose()

    def close(self) -> None:
        """Closes its connections."""
        self.engine.dispose()

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
                cursor.execute(self._plain(_SAVE_TRAJECTORY), (job, each.key, packed(each.trajectory)))
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

    def referenced(self, artifacts: Collection[str]) -> set[str]:
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
        # One that seems to begin later was noted before the clock was set back.
        due = sa.or_(MAINTENANCE.c.begun <= now - seconds, MAINTENANCE.c.begun > now + seconds)
        with self.transaction() as connection:
            connection.execute(self.insert(MAINTENANCE).on_conflict_do_nothing(), {"task": task, "begun": 0})
            taken = sa.update(MAINTENANCE).where(MAINTENANCE.c.task == task, due).values(begun=now)
            return connection.execute(taken).rowcount > 0

    def give_turn_back(self, task: str) -> None:
        """The task was not done: the next process that asks may take it."""
        with self.transaction() as connection:
            connection.execute(sa.update(MAINTENANCE).where(MAINTENANCE.c.task == task).values(begun=0))

    def _column(self, query: sa.Executable) -> set[str]:
        return {row[0] for row in self.read(query)}

    def _add_references(self, cursor: Any, job: str, artifacts: Iterable[str]) -> None:
        rows = [value for sha256 in dict.fromkeys(artifacts) for value in (sha256, job)]
        if rows:
            cursor.execute(self._plain(_ADD_REFERENCES.format(", ".join(["(?, ?)"] * (len(rows) // 2)))), rows)


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
        told = getattr(error, "orig", None) or error
        if "DataError" in (kind.__name__ for kind in type(told).__mro__):
            raise  # what is to be stored is at fault: it would be the same tomorrow
        code = getattr(told, "sqlstate", None) or getattr(told, "sqlite_errorname", "") or ""
        raise unavailable(code, type(told).__name__) from error


def unavailable(code: str, name: str = "") -> StorageUnavailable:
    """Says why the database cannot be used, by SQLSTATE or SQLite's name, or else by that of the error's class."""
    reason = _REASONS.get(code or name, f"cannot be used ({name})")
    return StorageUnavailable(f"The job database {reason}: check COW_DATABASE_URL, its server and its disk.")
