"""Looks at a job database without running an engine on it, and changes nothing."""

from __future__ import annotations

from urllib.parse import quote

import sqlalchemy as sa

from cow_service.jobs.database import Database
from cow_service.jobs.overview import unserved
from cow_service.jobs.process_table import Alive, ProcessTable
from cow_service.jobs.queue_counts import has_jobs, open_counts
from cow_service.records import Unserved
from cow_service.settings import Settings


def unserved_jobs(settings: Settings) -> tuple[Unserved, ...]:
    """Queued jobs that no live process takes. Raises `StorageUnavailable` where the database cannot be read."""
    database = Database(settings)
    if database.file is not None and not database.file.exists():
        return ()
    engine = database.engine
    if database.file is not None:
        engine = sa.create_engine(f"sqlite:///file:{quote(str(database.file.resolve()))}?mode=ro&uri=true")
    try:
        if not has_jobs(engine):
            return ()
        table = ProcessTable(engine)
        alive = table.alive() if table.exists() else Alive()
        return unserved(alive.processes, open_counts(engine, alive.waiting))
    finally:
        engine.dispose()
