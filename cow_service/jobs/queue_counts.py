"""Counts the jobs of each queue in the table of DBOS, without reading them one by one."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime

import sqlalchemy as sa

from cow_service.jobs.database import database_errors
from cow_service.jobs.queues import LIGHT
from cow_service.jobs.state import (
    ATTRIBUTE_CREATED_AT,
    ATTRIBUTE_GENERATOR,
    ATTRIBUTE_QUEUE,
    KINDS,
    OPEN,
)
from cow_service.jobs.workflow_table import workflow_table

RATE_SECONDS = 300.0  # over which ended jobs are counted


@dataclass(frozen=True)
class OpenCount:
    """Open jobs that have all of this in common."""

    queue: str
    generator: str
    state: str  # "queued" or "running"
    workflow_version: str
    jobs: int
    oldest_seconds: float  # since the first of them was created


def open_counts(engine: sa.Engine, waiting: Iterable[str]) -> list[OpenCount]:
    """The jobs that wait or run anywhere; `waiting` are those that a process has taken and not begun.

    Raises `StorageUnavailable`.
    """
    table = workflow_table(engine)
    attributes = table.c.attributes
    runs = sa.and_(table.c.status == "PENDING", table.c.workflow_uuid.not_in(list(waiting)))
    groups = (
        sa.func.coalesce(attributes[ATTRIBUTE_QUEUE].as_string(), LIGHT).label("queue"),
        sa.func.coalesce(attributes[ATTRIBUTE_GENERATOR].as_string(), "").label("generator"),
        sa.case((runs, "running"), else_="queued").label("state"),
        sa.func.coalesce(table.c.application_version, "").label("version"),
    )
    oldest = sa.func.min(attributes[ATTRIBUTE_CREATED_AT].as_string())
    query = (
        sa.select(*groups, sa.func.count(), oldest)
        .where(table.c.status.in_(OPEN), table.c.name.in_(KINDS))
        .group_by(*(sa.literal_column(str(place + 1)) for place in range(len(groups))))
    )
    with database_errors(), engine.connect() as connection:
        rows = connection.execute(query).all()
    return [
        OpenCount(queue, generator, state, version, jobs, _age(oldest))
        for queue, generator, state, version, jobs, oldest in rows
    ]


def has_jobs(engine: sa.Engine) -> bool:
    """Whether a database has the table of DBOS. Raises `StorageUnavailable`."""
    table = workflow_table(engine)
    with database_errors():
        return sa.inspect(engine).has_table(table.name, schema=table.schema)


def ended_lately(engine: sa.Engine) -> dict[str, int]:
    """How many jobs of each queue ended, well or not, in the last `RATE_SECONDS`. Raises `StorageUnavailable`."""
    table = workflow_table(engine)
    queue = sa.func.coalesce(table.c.attributes[ATTRIBUTE_QUEUE].as_string(), LIGHT)
    since = int((time.time() - RATE_SECONDS) * 1000)
    query = (
        sa.select(queue, sa.func.count())
        .where(table.c.completed_at > since, table.c.status.in_(("SUCCESS", "ERROR")), table.c.name.in_(KINDS))
        .group_by(sa.literal_column("1"))
    )
    with database_errors(), engine.connect() as connection:
        return {row[0]: row[1] for row in connection.execute(query)}


def _age(created_at: str | None) -> float:
    if created_at is None:  # of an older version
        return 0.0
    return max(0.0, time.time() - datetime.fromisoformat(created_at).timestamp())
