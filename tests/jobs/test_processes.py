"""What processes tell of themselves: `GET /workers`, `/readyz`, `cow doctor`, metrics."""

from __future__ import annotations

import json
import os
import platform
import re
import signal
import socket
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest
import sqlalchemy as sa
import yaml
from conftest import ROOT
from engines import running_engine
from postgres import postgres_server
from pydantic import ValidationError
from servers import ASYNC, Served, Worker, problem, slow
from waiting import eventually

from cow_service.api.middleware.access import hash_of
from cow_service.jobs.job_table import VERSION
from cow_service.jobs.processes import Overview, ProcessTable
from cow_service.records import ProcessInfo, WorkerInfo, WorkerJob
from cow_service.settings import Settings

pytestmark = pytest.mark.slow


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def workers_of(served: Served) -> dict[str, Any]:
    response = served.http.get("/workers")
    assert response.status_code == 200, response.text
    return response.json()


def queue_of(served: Served, name: str = "light") -> dict[str, Any]:
    return next(queue for queue in workers_of(served)["queues"] if queue["name"] == name)


def busy(served: Served) -> dict[str, Any] | None:
    """A worker that makes a clip, and that has told how much memory it takes."""
    workers = [one for process in workers_of(served)["processes"] for one in process["workers"]]
    making = [one for one in workers if one["memory_mb"] and [job["stage"] for job in one["jobs"]] == ["generation"]]
    return making[0] if making else None


def cow(served: Served, *arguments: str, **settings: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COW_")}
    environment |= {"COW_DATA_DIR": str(served.data)} | settings
    command = [sys.executable, "-m", "cow_service.cli.main", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)


def queries() -> list[str]:
    """Of jobs by which Kubernetes' workers are scaled, in the order of the file."""
    scaling = (ROOT / "docker" / "kubernetes" / "scaling.yaml").read_text()
    scaled = [one["spec"] for one in yaml.safe_load_all(scaling) if one["kind"] == "ScaledObject"]
    return [spec["triggers"][0]["metadata"]["query"] for spec in scaled]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with Served(tmp_path_factory.mktemp("processes"), COW_WORKERS="true", COW_CONCURRENCY="1") as one:
        yield one


def test_a_server_shows_its_workers_and_queues(served: Served) -> None:
    job, waits = (served.submit(slow(6, seed=seed))["id"] for seed in (1, 2))
    served.rendering(job)
    worker = eventually(lambda: busy(served))
    (process,) = workers_of(served)["processes"]
    assert served.process is not None
    assert (process["role"], process["pid"], process["queues"]["light"]) == ("all", served.process.pid, 1)
    assert (worker["name"], worker["queue"]) == ("light-1", "light")
    assert worker["memory_mb"] > 20
    at_hand = worker["jobs"][0]
    assert (at_hand["id"], at_hand["kind"], at_hand["stage"]) == (job, "simulate", "generation")
    queue = eventually(lambda: found if (found := queue_of(served))["queued"] == 1 else None)
    assert (queue["running"], queue["capacity"]) == (1, 1)
    assert queue["oldest_seconds"] >= 0
    metrics = served.http.get("/metrics").text
    assert 'cow_workers{queue="light",state="busy"} 1.0' in metrics
    assert 'cow_queue_depth{generator="slow",queue="light",state="queued"} 1.0' in metrics
    memory = re.search(r'cow_worker_memory_bytes\{worker="light-1"\} (\S+)', metrics)
    assert memory is not None
    assert float(memory[1]) > 20e6
    for one in (job, waits):
        served.http.post(f"/jobs/{one}/cancel")
    eventually(lambda: queue_of(served)["queued"] == queue_of(served)["running"] == 0)
    assert served.http.post("/simulate", json=slow(0.1, seed=3)).status_code == 200
    eventually(lambda: queue_of(served)["jobs_per_minute"] > 0)


def test_jobs_of_another_version_are_told_of(served: Served) -> None:
    """As after a change of the workflow version with jobs in the queue."""
    *others, waits = (served.submit(slow(seconds, seed=4))["id"] for seconds in (20, 20, 0.1))
    served.rendering(others[0])  # the second one runs at the same time, the third stays in the queue

    def set_version(version: str) -> None:
        with sqlite3.connect(served.data / "jobs.sqlite3") as database:
            changed = database.execute(
                "UPDATE cow_jobs SET version = ? WHERE id = ? AND executor IS NULL",
                (version, waits),
            )
        assert changed.rowcount == 1

    set_version("0")
    for job in others:
        served.http.post(f"/jobs/{job}/cancel")
    eventually(lambda: served.http.get("/readyz").status_code == 503)
    told = problem(served.http.get("/readyz"), 503, "not-ready")
    assert "1 job of workflow version 0 waits, and no process takes them" in told["detail"]
    assert workers_of(served)["unserved"] == [
        {"queue": "light", "workflow_version": "0", "jobs": 1, "reason": "version"}
    ]
    assert 'cow_queue_unserved{queue="light",reason="version"} 1.0' in served.http.get("/metrics").text
    report = cow(served, "doctor")
    assert report.returncode == 1
    assert "Start a server or worker of a COW with workflow version 0" in report.stdout
    set_version(VERSION)
    assert served.ended(waits)["status"] == "succeeded"
    eventually(lambda: served.http.get("/readyz").status_code == 200)


def test_a_worker_that_crashes_is_counted(served: Served) -> None:
    (process,) = workers_of(served)["processes"]
    os.kill(process["workers"][0]["pid"], signal.SIGKILL)
    eventually(lambda: 'cow_worker_ends_total{reason="crashed"} 1.0' in served.http.get("/metrics").text)


def test_only_administrators_are_told_where_processes_are(tmp_path: Path) -> None:
    keys = json.dumps({name: hash_of(f"cow_{name}") for name in ("alice", "root")})
    with Served(tmp_path, COW_API_KEYS=keys, COW_ADMIN_KEYS='["root"]') as one:
        job = one.http.post("/simulate", json=slow(20), headers=ASYNC | {"Authorization": "Bearer cow_alice"}).json()

        def told(name: str) -> dict[str, Any] | None:
            answer = one.http.get("/workers", headers={"Authorization": f"Bearer cow_{name}"}).json()
            return (
                answer["processes"][0]
                if [1 for worker in answer["processes"][0]["workers"] if worker["jobs"]]
                else None
            )

        def places(process: dict[str, Any]) -> list[Any]:
            (worker,) = process["workers"]
            return [process["host"], process["pid"], worker["pid"], worker["jobs"][0]["id"]]

        pid = one.process.pid if one.process else 0
        assert places(eventually(lambda: told("root"))) == [platform.node(), pid, pid, job["id"]]
        shown = eventually(lambda: told("alice"))
        assert places(shown) == [None] * 4
        assert shown["workers"][0]["jobs"][0]["kind"] == "simulate"


def test_an_administrator_has_a_key() -> None:
    with pytest.raises(ValidationError, match="'bob' is not a name in COW_API_KEYS"):
        Settings(api_keys={"alice": hash_of("cow_alice")}, admin_keys=("bob",))


def test_processes_are_shown_while_they_tell_of_themselves() -> None:
    database = running_engine().database
    table = ProcessTable(database)
    job = WorkerJob(id="secret", kind="answer", progress=0, seconds=1)
    worker = WorkerInfo(name="light-1", queue="light", pid=2, memory_mb=1, jobs_done=0, jobs=(job,))
    info = {"role": "worker", "host": "box", "pid": 1, "version": "9", "workflow_version": "9", "seen_at": "now"}
    table.write(ProcessInfo(executor_id="other", workers=(worker,), queues={"light": 3}, **info))

    def shown(settings: Settings) -> list[str | None]:
        found = Overview(database, settings).workers().processes
        return [job.id for one in found if one.host == "box" for worker in one.workers for job in worker.jobs]

    assert shown(Settings()) == ["secret"]
    with database.transaction() as connection:
        connection.execute(sa.text("UPDATE cow_executors SET seen = seen - 11 WHERE executor = 'other'"))
    assert shown(Settings()) == []
    table.remove("other")


@pytest.fixture(scope="module")
def postgres() -> Iterator[str]:
    with postgres_server() as url:
        yield url


@pytest.mark.soak
def test_an_api_server_is_ready_with_a_worker(postgres: str, tmp_path: Path) -> None:
    own = {"COW_DATABASE_URL": postgres}
    with Served(tmp_path, COW_ROLE="api", **own) as api:
        told = problem(api.http.get("/readyz"), 503, "not-ready")
        assert "`cow worker --queues light`" in told["detail"]
        port = str(free_port())
        with Worker(tmp_path, log="worker", COW_METRICS_PORT=port, COW_CONCURRENCY="1", **own) as worker:
            eventually(lambda: api.http.get("/readyz").status_code == 200)
            assert [one["role"] for one in workers_of(api)["processes"]] == ["api", "worker"]
            job = api.submit(slow(2))["id"]
            assert eventually(lambda: busy(api))["jobs"][0]["id"] == job
            assert api.ended(job)["status"] == "succeeded"
            told = httpx.get(f"http://127.0.0.1:{port}/metrics").text
            assert 'cow_stage_seconds_count{stage="generation"} 1.0' in told
            assert 'cow_workers{queue="light",state="idle"} 1.0' in told
            worker.processes()[-1].send_signal(signal.SIGTERM)
            eventually(lambda: [one["role"] for one in workers_of(api)["processes"]] == ["api"])
        waits = api.submit(slow(0.1))["id"]
        eventually(lambda: workers_of(api)["unserved"])
        assert workers_of(api)["unserved"][0]["jobs"] == 1
        with psycopg.connect(postgres) as database:  # what KEDA asks
            numbers = [database.execute(query).fetchone() for query in queries()]
        assert numbers == [(1,), (0,)], "one job for light workers, none for GPU workers"
        api.http.delete(f"/jobs/{waits}")
