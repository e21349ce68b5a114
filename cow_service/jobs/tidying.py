"""What the job database is asked for while a process tidies: whose turn it is, and what belongs to no job."""

from __future__ import annotations

import time
from typing import Literal

import sqlalchemy as sa

from cow_service.jobs.database import Database, database_errors
from cow_service.jobs.tables import REFERENCES, RESULTS, TIDYING, TRAJECTORIES
from cow_service.jobs.workflow_table import workflow_table

Tidying = Literal["jobs", "artifacts"]
_ROWS: dict[Tidying, int] = {"jobs": 1, "artifacts": 2}


def takes_turn(database: Database, what: Tidying, seconds: float) -> bool:
    """Whether no process has begun to tidy that for so long: it is then the caller's turn, and nobody else's."""
    now, row = time.time(), _ROWS[what]
    first = "INSERT INTO cow_tidying (id, begun) VALUES (:row, 0) ON CONFLICT DO NOTHING"
    due = TIDYING.c.id == row, TIDYING.c.begun <= now - seconds
    taken = sa.update(TIDYING).where(*due).values(begun=now)
    with database_errors(), database.engine.begin() as connection:
        connection.execute(sa.text(first), {"row": row})
        return connection.execute(taken).rowcount > 0


def give_turn_back(database: Database, what: Tidying) -> None:
    """The work of a turn was not done: whoever asks next may take it."""
    with database_errors(), database.engine.begin() as connection:
        connection.execute(sa.update(TIDYING).where(TIDYING.c.id == _ROWS[what]).values(begun=0))


def without_job(database: Database) -> list[str]:
    """The ids under which there are results or references, and no job: it was deleted while it ran."""
    table = workflow_table(database.engine)
    with database_errors(), database.engine.connect() as connection:
        found: set[str] = set()
        for ours in (RESULTS, TRAJECTORIES, REFERENCES):
            known = sa.select(table.c.workflow_uuid).where(table.c.workflow_uuid == ours.c.job_id).exists()
            found |= set(connection.execute(sa.select(ours.c.job_id).distinct().where(~known)).scalars())
    return sorted(found)
