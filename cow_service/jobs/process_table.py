"""The table `cow_processes` of the job database: one row for each process that runs an engine.

Times are the database's: the clocks of machines differ.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass

import sqlalchemy as sa

from cow_service.jobs.database import database_errors
from cow_service.jobs.tables import PROCESSES
from cow_service.records import ProcessInfo

ALIVE_SECONDS = 10.0  # since its last row, that a process is shown
FORGOTTEN_SECONDS = 3600.0  # after which a row is deleted

_NOW = {
    "sqlite": "(julianday('now') - 2440587.5) * 86400.0",
    "postgresql": "CAST(EXTRACT(EPOCH FROM clock_timestamp()) AS double precision)",
}

log = logging.getLogger("cow_service")


@dataclass(frozen=True)
class Alive:
    """The processes that were seen lately, by role, host and process id, and the jobs that wait in one of them."""

    processes: tuple[ProcessInfo, ...] = ()
    waiting: frozenset[str] = frozenset()


class ProcessTable:
    """Writes and reads the rows. Every method raises `StorageUnavailable` where the database cannot be used."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine
        self._now = _NOW[engine.dialect.name]

    def write(self, info: ProcessInfo, waiting: list[str]) -> None:
        """Notes that a process is alive, what it does, and which jobs it has not begun; deletes rows of those long
        gone."""
        with database_errors(), self._engine.begin() as connection:
            connection.execute(
                sa.text(
                    "INSERT INTO cow_processes (executor_id, seen, info, waiting) "
                    f"VALUES (:executor_id, {self._now}, :info, :waiting) ON CONFLICT (executor_id) "
                    "DO UPDATE SET seen = excluded.seen, info = excluded.info, waiting = excluded.waiting"
                ),
                {"executor_id": info.executor_id, "info": info.model_dump_json(), "waiting": json.dumps(waiting)},
            )
            connection.execute(
                sa.text(f"DELETE FROM cow_processes WHERE seen < {self._now} - :age"), {"age": FORGOTTEN_SECONDS}
            )

    def remove(self, executor_id: str) -> None:
        """Deletes the row of a process that ends."""
        with database_errors(), self._engine.begin() as connection:
            connection.execute(sa.delete(PROCESSES).where(PROCESSES.c.executor_id == executor_id))

    def alive(self) -> Alive:
        """Who was seen in the last `ALIVE_SECONDS`."""
        query = sa.text(f"SELECT executor_id, info, waiting FROM cow_processes WHERE seen > {self._now} - :age")
        with database_errors(), self._engine.connect() as connection:
            rows = connection.execute(query, {"age": ALIVE_SECONDS}).all()
        found: list[ProcessInfo] = []
        waiting: set[str] = set()
        for executor_id, info, jobs in rows:
            try:
                # Fields that only a later version knows are passed over.
                found.append(ProcessInfo.model_validate_json(info, extra="ignore"))
                waiting.update(json.loads(jobs))
            except ValueError:
                log.warning("the process %s is of a version that this one does not understand", executor_id)
        found.sort(key=lambda one: (one.role, one.host, one.pid))
        return Alive(tuple(found), frozenset(waiting))

    def exists(self) -> bool:
        """Whether a process of this version ever used the database."""
        with database_errors():
            return sa.inspect(self._engine).has_table(PROCESSES.name)
