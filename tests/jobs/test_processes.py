"""What processes tell of themselves: `GET /workers`, `/readyz`, `cow doctor`, metrics."""

from __future__ import annotations

import platform
import re
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from callers import as_caller, new_keys
from job_rows import add_job, open_database
from pydantic import ValidationError
from refusals import refused
from servers import Served, slow
from waiting import eventually

from cow_service.jobs.job_table import VERSION
from cow_service.jobs.processes import FORGOTTEN_SECONDS, Overview, ProcessTable, unserved_jobs
from cow_service.jobs.schema import ALIVE_SECONDS
from cow_service.records import ProcessInfo, WorkerInfo, WorkerJob
from cow_service.settings import Settings

ENDLESS = 100.0  # seconds that no test waits for; it can be ended after each fortieth of them
SETTINGS, KEYS = new_keys("root", "alice")


def workers_of(served: Served) -> dict[str, Any]:
    response = served.http.get("/workers")
    assert response.status_code == 200, response.text
    return response.json()


def light(served: Served) -> dict[str, Any]:
    """The queue of light jobs."""
    return next(queue for queue in workers_of(served)["queues"] if queue["name"] == "light")


def busy(served: Served) -> dict[str, Any] | None:
    """A worker that makes a clip, and that has told how much memory it takes."""
    workers = [one for process in workers_of(served)["processes"] for one in process["workers"]]
    making = [one for one in workers if one["memory_mb"] and [job["stage"] for job in one["jobs"]] == ["generation"]]
    return making[0] if making else None


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server with one worker, asked by its administrator."""
    own = {"COW_WORKERS": "true", "COW_CONCURRENCY": "1", "COW_ADMIN_KEYS": '["root"]'}
    folder = tmp_path_factory.mktemp("processes")
    with Served(folder, **own, **SETTINGS) as one, as_caller(one, KEYS["root"]) as caller:
        yield caller


@pytest.mark.slow
def test_a_server_shows_its_workers_and_queues(served: Served) -> None:
    first = served.submit(slow(ENDLESS, seed=1))
    served.rendering(first["id"])
    waits = served.submit(slow(0.1, seed=2))
    worker = eventually(lambda: busy(served))
    (process,) = workers_of(served)["processes"]
    assert served.process is not None
    assert (process["role"], process["host"], process["pid"]) == ("all", platform.node(), served.process.pid)
    assert process["queues"]["light"] == 1
    assert (worker["name"], worker["queue"]) == ("light-1", "light")
    assert worker["memory_mb"] > 20
    at_hand = worker["jobs"][0]
    assert (at_hand["id"], at_hand["kind"], at_hand["stage"]) == (first["id"], "simulate", "generation")
    queue = eventually(lambda: found if (found := light(served))["queued"] == 1 else None)
    assert (queue["running"], queue["capacity"]) == (1, 1)
    assert queue["oldest_seconds"] >= 0
    metrics = served.http.get("/metrics").text
    assert 'cow_workers{queue="light",state="busy"} 1.0' in metrics
    assert 'cow_queue_depth{generator="slow",queue="light",state="queued"} 1.0' in metrics
    memory = re.search(r'cow_worker_memory_bytes\{worker="light-1"\} (\S+)', metrics)
    assert memory is not None
    assert float(memory[1]) > 20e6
    with as_caller(served, KEYS["alice"]) as alice:
        (shown,) = workers_of(alice)["processes"]
    (own,) = shown["workers"]
    hidden = [shown["host"], shown["pid"], own["pid"], own["jobs"][0]["id"]]
    assert (hidden, own["jobs"][0]["kind"]) == ([None] * 4, "simulate"), "places are told to administrators alone"
    served.http.post(f"/jobs/{first['id']}/cancel")
    assert served.ended(waits["id"])["status"] == "succeeded"
    eventually(lambda: light(served)["queued"] == light(served)["running"] == 0)
    eventually(lambda: light(served)["jobs_per_minute"] == 0.2)  # one in five minutes: canceled ones do not count


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
