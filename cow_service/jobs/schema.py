"""Our tables in the job database, and which versions of COW can serve on them at the same time.

Results, references and finished stages belong to a job, and are deleted with its row.
"""

from __future__ import annotations

import logging
import zlib
from typing import Any

import numpy as np
import sqlalchemy as sa
from pydantic_core import from_json
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import StorageUnavailable
from cow_service.settings import SettingsError

SCHEMA = 4  # of our tables; 1 is that without `cow_schema`, 2 without answers of jobs, 3 without calls of webhooks
# The oldest version of COW, by its own `SCHEMA`, that can serve on these tables. It stays where a version only adds
# tables, and columns that may be null: such a change is made while older servers run.
OLDEST_SERVING = 1
ALIVE_SECONDS = 10.0  # since a process last told of itself
TABLES_LOCK, INDEXES_LOCK = 0x434F5701, 0x434F5703  # of PostgreSQL, held while these are made

log = logging.getLogger("cow_service")

METADATA = sa.MetaData()
JOBS = sa.Table(
    "cow_jobs",
    METADATA,
    sa.Column("id", sa.String(64), primary_key=True),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("owner", sa.Text),  # the name of a key; null if the server has none
    sa.Column("status", sa.String(16), nullable=False),  # a `JobStatus`: queued until work on it begins
    sa.Column("created_at", sa.String(32), nullable=False),  # RFC 3339 in UTC, to the millisecond: sorts as text
    sa.Column("ended", sa.Float),  # Unix time, s
    sa.Column("version", sa.String(16), nullable=False),  # of the workflow that computes it
    sa.Column("queue", sa.String(64), nullable=False),
    sa.Column("priority", sa.String(16), nullable=False),
    sa.Column("turn", sa.Integer, nullable=False),  # among the jobs of its queue: the lowest is taken first
    sa.Column("executor", sa.String(64)),  # the process that has taken it; null while it waits in its queue
    sa.Column("run", sa.String(64)),  # names this attempt: an earlier one can change nothing any more
    # How often a process ended that had it; in earlier versions, how often it was taken.
    sa.Column("starts", sa.Integer, nullable=False, key="deaths"),
    sa.Column("generator", sa.Text, nullable=False),
    sa.Column("question", sa.Text, nullable=False),
    sa.Column("answer", sa.Text),  # in words, for lists
    sa.Column("given", sa.Text),  # names of what the request gave instead of the reader, with commas
    sa.Column("image", sa.String(64), nullable=False),
    sa.Column("webhook", sa.Text),
    sa.Column("spec", sa.LargeBinary, nullable=False),  # a `JobSpec` as JSON, deflated
    sa.Column("format", sa.Integer),  # of the result: `FORMAT` when it was stored
    sa.Column("result", sa.LargeBinary),  # JSON, deflated, without the trajectory where `trajectory_key` names one
    sa.Column("trajectory_key", sa.String(64)),
    sa.Column("error", sa.Text),  # JSON
    sa.Index("cow_jobs_of_time", "created_at"),
    sa.Index("cow_jobs_of_status", "status", "created_at"),
    sa.Index("cow_jobs_of_owner", "owner", "created_at"),
    sa.Index("cow_jobs_ended", "ended"),
    # Lists by kind or status are merged from ranges of one of these.
    sa.Index("cow_jobs_of_kind", "kind", "status", "created_at"),
    sa.Index("cow_jobs_of_owner_and_kind", "owner", "kind", "status", "created_at"),
)


def _of_job(**options: Any) -> sa.Column[str]:
    return sa.Column("job_id", sa.String(64), sa.ForeignKey(JOBS.c.id, ondelete="CASCADE"), **options)


# Results of stages by their cache keys.
RESULTS = sa.Table(
    "cow_results",
    METADATA,
    sa.Column("key", sa.String(64), primary_key=True),
    _of_job(nullable=False, index=True),
    sa.Column("stage", sa.String(32), nullable=False),
    sa.Column("result", sa.LargeBinary, nullable=False),  # JSON, deflated; without its value where that is a trajectory
    sa.Column("created_at", sa.Float, nullable=False),
)
# A trajectory is most of a result: it is stored once for its stage and its job, under the key of the stage.
TRAJECTORIES = sa.Table(
    "cow_trajectories_of_jobs",
    METADATA,
    _of_job(primary_key=True),
    sa.Column("key", sa.String(64), primary_key=True),
    sa.Column("trajectory", sa.LargeBinary, nullable=False),  # JSON, deflated
)
# Which job needs which artifact: one without a reference may be removed.
REFERENCES = sa.Table(
    "cow_references",
    METADATA,
    sa.Column("sha256", sa.String(64), primary_key=True),
    _of_job(primary_key=True, index=True),
)
# The finished stages of each job, even if another job computed their results.
STAGES = sa.Table(
    "cow_stages_of_jobs", METADATA, _of_job(primary_key=True), sa.Column("stage", sa.String(32), primary_key=True)
)
# Webhooks to be called: one row for each job that has ended, until its receiver has heard of it or is given up.
CALLS = sa.Table(
    "cow_webhooks",
    METADATA,
    _of_job(primary_key=True),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("receiver", sa.String(64), nullable=False),  # a digest of host and port
    sa.Column("attempts", sa.Integer, nullable=False),  # that have begun
    sa.Column("due", sa.Float, nullable=False, index=True),  # the next one; Unix time of the database, s
)
# Where the artifacts of all jobs are: one row, once a server has started.
STORES = sa.Table(
    "cow_artifact_store",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True),  # always 1
    sa.Column("address", sa.Text, nullable=False),
)
# When each kind of maintenance last began; only one process does each kind at a time.
MAINTENANCE = sa.Table(
    "cow_maintenance",
    METADATA,
    sa.Column("task", sa.String(16), primary_key=True),
    sa.Column("begun", sa.Float, nullable=False),  # Unix time, s
)
# Which versions of COW can serve on these tables: one row.
SCHEMAS = sa.Table(
    "cow_schema",
    METADATA,
    sa.Column("id", sa.Integer, primary_key=True),  # always 1
    sa.Column("version", sa.Integer, nullable=False),  # `SCHEMA` of the COW that last changed the tables
    sa.Column("oldest_serving", sa.Integer, nullable=False),
)
# One row for each process that runs an engine.
PROCESSES = sa.Table(
    "cow_executors",
    METADATA,
    sa.Column("executor", sa.String(64), primary_key=True),
    sa.Column("seen", sa.Float, nullable=False),  # Unix time of the database, s
    sa.Column("info", sa.Text, nullable=False),  # a `ProcessInfo` as JSON
)


def schema_of(connection: sa.Connection) -> int:
    """That of the tables; 0 where there are none. Raises `SettingsError` if this version cannot use it."""
    there = set(sa.inspect(connection).get_table_names())
    if SCHEMAS.name in there:
        found = connection.execute(sa.select(SCHEMAS)).one_or_none()
        if found is not None and found.oldest_serving > SCHEMA:
            raise SettingsError(
                f"The job database is of a later version of COW (schema {found.version}), on whose tables this one "
                f"(schema {SCHEMA}) cannot serve: update it."
            )
        if found is not None:  # otherwise a restore has lost the row, and it is written again
            return found.version
    return int(JOBS.name in there)


def update_tables(connection: sa.Connection, now: sa.ColumnElement[float]) -> None:
    """Makes our tables, or adds what those of an earlier version lack; those of a later one stay as they are.

    Raises `SettingsError` if this version cannot use them, `StorageUnavailable` while it would change them in a way
    that processes which run do not bear.
    """
    found = schema_of(connection)
    if found > SCHEMA:
        return
    if 0 < found < OLDEST_SERVING:
        alive = sa.select(PROCESSES.c.executor).where(PROCESSES.c.seen > now - ALIVE_SECONDS)
        if connection.execute(alive).first() is not None:
            raise StorageUnavailable(
                f"The tables of the job database change (schema {found} to {SCHEMA}) in a way that running servers "
                "and workers cannot handle: stop all of them first."
            )
    METADATA.create_all(connection)
    for table in METADATA.sorted_tables:
        there = {column["name"] for column in sa.inspect(connection).get_columns(table.name)}
        for column in table.columns:
            if column.name not in there:
                added = sa.schema.CreateColumn(column).compile(dialect=connection.dialect)
                connection.execute(sa.text(f"ALTER TABLE {table.name} ADD COLUMN {added}"))
    connection.execute(sa.delete(SCHEMAS))
    connection.execute(sa.insert(SCHEMAS).values(id=1, version=SCHEMA, oldest_serving=OLDEST_SERVING))


def add_indexes(connection: sa.Connection) -> None:
    """Adds the indexes that tables of an earlier version lack. Each statement of the connection must be a transaction.

    They change no schema: without them lists are right, but slow. In PostgreSQL servers write meanwhile; one process
    adds them, and others do not wait. One that could not be added (a backup that runs delays it for too long) is left
    invalid, and is made anew at the next start.
    """
    if schema_of(connection) > SCHEMA:
        return
    indexes = [(table, index) for table in METADATA.sorted_tables for index in table.indexes]
    if connection.dialect.name == "sqlite":
        for _, index in indexes:
            connection.execute(sa.schema.CreateIndex(index, if_not_exists=True))
    elif connection.execute(sa.text(f"SELECT pg_try_advisory_lock({INDEXES_LOCK})")).scalar():
        try:
            valid = "SELECT relname FROM pg_index JOIN pg_class ON pg_class.oid = indexrelid WHERE indisvalid"
            there = set(connection.execute(sa.text(valid)).scalars())
            connection.execute(sa.text("SET statement_timeout = 0"))
            for table, index in ((table, index) for table, index in indexes if index.name not in there):
                columns = ", ".join(column.name for column in index.columns)
                connection.execute(sa.text(f"DROP INDEX CONCURRENTLY IF EXISTS {index.name}"))
                made = f"CREATE INDEX CONCURRENTLY {index.name} ON {table.name} ({columns})"
                connection.execute(sa.text(made))
        except SQLAlchemyError as error:
            log.warning("an index could not be added, so lists of jobs are slow (%s)", type(error).__name__)
        connection.invalidate()  # with its session the lock and the setting end


# --- JSON, which is kept compressed

DEFLATE_LEVEL = 3  # of zlib: higher ones take several times as long and save a twentieth
ROWS, DECIMALS = "~rows", "~decimals"  # by which earlier versions kept second differences in place of lists of numbers


def packed(json: str) -> bytes:
    """A JSON text."""
    return zlib.compress(json.encode(), DEFLATE_LEVEL)


def unpacked(kept: bytes) -> Any:
    """The values of a JSON text that was packed, by this version or an earlier one."""
    text = zlib.decompress(kept)
    values = from_json(text)
    return _restored(values) if f'"{ROWS}"'.encode() in text else values


def _restored(value: Any) -> Any:
    if isinstance(value, list):
        return [_restored(each) for each in value]
    if not isinstance(value, dict):
        return value
    if ROWS not in value:
        return {key: _restored(each) for key, each in value.items()}
    units = np.array(value[ROWS], np.int64).T.cumsum(axis=0).cumsum(axis=0)
    return (units / 10 ** value[DECIMALS]).tolist()
