"""Jobs in a job database that no engine computes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import sqlalchemy as sa
from pydantic import SecretStr

from cow_service.jobs import opening
from cow_service.jobs.database import OPEN, Database
from cow_service.jobs.job_table import JobSpec, JobTable, TakenJob
from cow_service.jobs.schema import JOBS
from cow_service.settings import Settings
from cow_service.stages.run import now

STEP = 100


def url_of(database: Database) -> SecretStr:
    """The address of a database, with its password."""
    return SecretStr(database.engine.url.render_as_string(hide_password=False))


def open_database(folder: Path, url: SecretStr | None = None) -> Database:
    """A database with all tables: in a file of the folder, or that of the URL."""
    database = opening.open_database(Settings(data_dir=folder, database_url=url))
    database.create_tables()
    return database


def add_job(database: Database, job_id: str, owner: str | None = None, **more: Any) -> bool:
    """Adds a job; False if there is one of that id."""
    step, queue = more.pop("step", STEP), more.pop("queue", "light")
    request = {"image": {"artifact": "0" * 64}, "question": "?"}
    asked = {"kind": "simulate", "request": request, "reader": "embedded", "generator": "cutout"}
    spec = JobSpec(**({**asked, "created_at": now()} | more))
    return JobTable(database).add(job_id, spec, owner, queue, step)


def take_new_job(database: Database, job_id: str, executor: str) -> TakenJob:
    """Adds a job, and gives it to a process: no other one waits."""
    assert add_job(database, job_id)
    (job,) = JobTable(database).take("light", executor, 1, None)
    return job


def open_jobs(database: Database) -> list[str]:
    """The jobs that wait or run."""
    return [row.id for row in database.read(sa.select(JOBS.c.id).where(JOBS.c.status.in_(OPEN)))]
