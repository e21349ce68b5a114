"""What processes tell of themselves, and for how long. What servers show of it is tested in `workers`."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest
import sqlalchemy as sa
from job_rows import add_job, open_database
from pydantic import ValidationError
from refusals import refused

from cow_service.jobs.job_table import VERSION
from cow_service.jobs.processes import FORGOTTEN_SECONDS, Overview, ProcessTable, unserved_jobs
from cow_service.jobs.schema import ALIVE_SECONDS
from cow_service.records import ProcessInfo, WorkerInfo, WorkerJob
from cow_service.settings import Settings


def test_an_administrator_has_a_key() -> None:
    with pytest.raises(ValidationError, match="'bob'"):
        Settings(api_keys={"alice": "0" * 64}, admin_keys=("bob",))


def test_processes_are_shown_while_they_tell_of_themselves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cow_service.jobs.processes.MAX_AGE_SECONDS", 0.0)
    settings = Settings(data_dir=tmp_path, role="api")
    assert unserved_jobs(settings) == (), "no server has used it"
    with closing(open_database(tmp_path)) as database:
        table, overview = ProcessTable(database), Overview(database, settings)
        job = WorkerJob(id="secret", kind="answer", progress=0, seconds=1)
        worker = WorkerInfo(name="light-1", queue="light", pid=2, memory_mb=1, jobs_done=0, jobs=(job,))
        info = {"host": "box", "pid": 1, "version": "9", "workflow_version": VERSION, "seen_at": "now"}
        with refused("not-ready"):
            overview.check_served()
        table.write(ProcessInfo(executor_id="other", role="worker", workers=(worker,), queues={"light": 3}, **info))
        table.write(ProcessInfo(executor_id="api", role="api", workers=(), queues={}, **info))
        overview.check_served()
        told = overview.workers().processes
        assert ([one.role for one in told], told[1].workers[0].jobs[0].id) == (["api", "worker"], "secret")
        hidden = overview.workers(for_admin=False).processes[1]
        assert (hidden.host, hidden.workers[0].jobs[0].id) == (None, None)
        (queue,) = overview.workers().queues
        assert (queue.name, queue.capacity, queue.queued, queue.oldest_seconds) == ("light", 3, 0, None)
        for name in ("light", "ati"):
            add_job(database, name, queue=name)
        assert [(one.queue, one.reason) for one in unserved_jobs(settings)] == [("ati", "queue")]
        assert unserved_jobs(settings) == overview.workers().unserved
        age = sa.text("UPDATE cow_executors SET seen = seen - :seconds WHERE executor = 'other'")
        for seconds in (ALIVE_SECONDS + 1, FORGOTTEN_SECONDS):
            with database.transaction() as connection:
                connection.execute(age, {"seconds": seconds})
            table.write(ProcessInfo(executor_id="api", role="api", workers=(), queues={}, **info))
            assert [one.role for one in overview.workers().processes] == ["api"]
        assert database.read(sa.text("SELECT executor FROM cow_executors")) == [("api",)], "the other is forgotten"
        table.remove("api")
        assert overview.workers().processes == ()
