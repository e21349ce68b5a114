"""The table of DBOS in which jobs are rows, for what its methods do not answer or would answer one by one."""

from __future__ import annotations

import sqlalchemy as sa
from sqlalchemy.sql.selectable import TableClause

from cow_service.jobs.database import TABLES_LOCK, database_errors
from cow_service.jobs.queues import PREFIX
from cow_service.jobs.state import ATTRIBUTE_PRIORITY
from cow_service.jobs.turns import below
from cow_service.requests import Priority

INDEXES = {
    "cow_jobs_of_status": "status, created_at",
    "cow_jobs_of_owner": "authenticated_user, created_at",
}
SCHEMA = "dbos"  # of the tables of DBOS in PostgreSQL; in SQLite they have none


def workflow_table(engine: sa.Engine) -> TableClause:
    """Its columns, as far as they are used."""
    return sa.table(
        "workflow_status",
        sa.column("workflow_uuid", sa.Text),
        sa.column("name", sa.Text),
        sa.column("status", sa.Text),
        sa.column("application_version", sa.Text),
        sa.column("authenticated_user", sa.Text),
        sa.column("queue_name", sa.Text),
        sa.column("priority", sa.Integer),
        sa.column("completed_at", sa.BigInteger),  # Unix time, ms
        sa.column("attributes", sa.JSON),
        schema=SCHEMA if engine.dialect.name == "postgresql" else None,
    )


def create_indexes(engine: sa.Engine) -> None:
    """Indexes for the lists of jobs, newest first, of a status or an owner.

    None begins with the kind: SQLite would take it for lists of all kinds, and sort. Raises `StorageUnavailable`.
    """
    table = workflow_table(engine)
    on = f"ON {'' if table.schema is None else table.schema + '.'}{table.name}"
    with database_errors(), engine.begin() as connection:
        if table.schema is not None:  # two processes that create the same index at the same time would fail one another
            connection.execute(sa.text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": TABLES_LOCK})
        for name, columns in INDEXES.items():
            connection.execute(sa.text(f"CREATE INDEX IF NOT EXISTS {name} {on} ({columns})"))


def move_back(engine: sa.Engine, owner: str | None, queue: str, priority: Priority, turn: int, step: int) -> None:
    """Moves the waiting jobs of an owner that are below a priority back by a step, from a turn on.

    Raises `StorageUnavailable`.
    """
    table = workflow_table(engine)
    whose = table.c.authenticated_user.is_(None) if owner is None else table.c.authenticated_user == owner
    lower = table.c.attributes[ATTRIBUTE_PRIORITY].as_string().in_(below(priority))
    moved = (
        sa.update(table)
        .where(table.c.status == "ENQUEUED", table.c.queue_name == PREFIX + queue, whose, lower)
        .where(table.c.priority > turn)
        .values(priority=table.c.priority + step)
    )
    with database_errors(), engine.begin() as connection:
        connection.execute(moved)
