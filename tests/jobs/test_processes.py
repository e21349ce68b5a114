"""What processes tell of themselves, and for how long. What servers show of it is tested in `workers`."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import sqlalchemy as sa
from job_rows import add_job, open_database
from postgres import postgres
from pydantic import SecretStr, ValidationError
from refusals import refused

from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.computing import Computer, EngineParts
from cow_service.jobs.database import Database
from cow_service.jobs.job_table import JobTable
from cow_service.jobs.processes import FORGOTTEN_SECONDS, Processes
from cow_service.jobs.schema import ALIVE_SECONDS
from cow_service.records import WorkerInfo, WorkerJob
from cow_service.settings import Settings


def test_an_administrator_has_a_key() -> None:
    with pytest.raises(ValidationError, match="'bob'"):
        Settings(api_keys={"alice": "0" * 64}, admin_keys=("bob",))


class Worker(Computer):
    """It has a worker at work, and takes jobs of some queues."""

    def __init__(self, *queues: str) -> None:
        self._queues = queues

    def capacity(self, queue: str) -> int:
        return 3 if queue in self._queues else 0

    def workers(self, active: ActiveJobs) -> tuple[WorkerInfo, ...]:
        job = WorkerJob(id="secret", kind="answer", progress=0, seconds=1)
        return (WorkerInfo(name="light-1", queue="light", pid=2, memory_mb=1, jobs_done=0, jobs=(job,)),)


def processes_of(database: Database, settings: Settings, executor: str, *queues: str) -> Processes:
    service: Any = SimpleNamespace(settings=settings)
    parts = EngineParts(service, database, JobTable(database), ActiveJobs(), executor)
    return Processes(parts, Worker(*queues), None if executor == "api" else "worker")


@pytest.mark.slow
def test_processes_are_shown_while_they_tell_of_themselves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cow_service.jobs.processes.MAX_AGE_SECONDS", 0.0)
    with postgres() as server:
        url = SecretStr(server.url)
        settings = Settings(data_dir=tmp_path, role="api", database_url=url)
        with closing(open_database(tmp_path, url)) as database:
            api, other = processes_of(database, settings, "api"), processes_of(database, settings, "other", "light")
            with refused("not-ready"):
                api.check_served()
            other.tell()
            api.tell()
            api.check_served()
            told = api.overview().processes
            assert ([one.role for one in told], told[1].workers[0].jobs[0].id) == (["api", "worker"], "secret")
            hidden = api.overview(for_admin=False).processes[1]
            assert (hidden.host, hidden.workers[0].jobs[0].id) == (None, None)
            (queue,) = api.overview().queues
            assert (queue.name, queue.capacity, queue.queued, queue.oldest_seconds) == ("light", 3, 0, None)
            for name in ("light", "ati"):
                add_job(database, name, queue=name)
            assert [(one.queue, one.reason) for one in api.overview().unserved] == [("ati", "queue")]
            other.drain()
            other.tell()
            assert [one.queue for one in api.overview().unserved] == ["ati", "light"]
            age = sa.text("UPDATE cow_executors SET seen = seen - :seconds WHERE executor = 'other'")
            for seconds in (ALIVE_SECONDS + 1, FORGOTTEN_SECONDS):
                with database.transaction() as connection:
                    connection.execute(age, {"seconds": seconds})
                api.tell()
                assert [one.role for one in api.overview().processes] == ["api"]
            assert database.read(sa.text("SELECT executor FROM cow_executors")) == [("api",)], "the other is forgotten"
            api.stop()
            assert api.overview().processes == ()


def test_the_server_of_a_file_is_all_that_there_is(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    with closing(open_database(tmp_path)) as database:
        for name in ("light", "ati"):
            add_job(database, name, queue=name)
        found = processes_of(database, settings, "me", "light").overview()
        assert [one.queues for one in found.processes] == [{"light": 3}]
        assert [(one.queue, one.reason) for one in found.unserved] == [("ati", "queue")]
        for version, reason in (("0", "version"), ("2", "queue")):
            with database.transaction() as connection:
                connection.execute(sa.text(f"UPDATE cow_jobs SET version = '{version}'"))
            found = processes_of(database, settings, "me", "light").overview()
            told = {one.queue: (one.workflow_version, one.reason) for one in found.unserved}
            assert told["ati"] == (version, reason)
            assert ("light" in told) is (version == "0"), "a job of version 2 is computed here"
