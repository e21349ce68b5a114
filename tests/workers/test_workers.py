"""API servers and workers on one job database: jobs that harm their process, and who computes what."""

from __future__ import annotations

import platform
import re
import socket
from collections.abc import Iterator
from functools import cache
from typing import Any

import httpx
import pytest
from callers import as_caller, new_keys
from postgres import PostgresServer, postgres
from servers import ASYNC, BODY, Served, Worker, problem, slow
from waiting import TIME_LIMIT, eventually
from worker_contract import GIVES_UP_SOONER, Contract
from worker_processes import workers_of

from cow_service.errors import Canceled
from cow_service.observability.metrics import Metrics
from cow_service.settings import Settings
from cow_service.workers.pool import Group

pytestmark = pytest.mark.slow

SETTINGS, KEYS = new_keys("root", "alice")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server with one worker, asked by its administrator."""
    own = {"COW_WORKER_MEMORY_MB": "1000", "COW_JOB_TIMEOUT": "90", "COW_CONCURRENCY": "1", **SETTINGS}
    own |= {"COW_WORKERS": "true", "COW_ADMIN_KEYS": '["root"]'}
    folder = tmp_path_factory.mktemp("workers")
    with Served(folder, GIVES_UP_SOONER, **own) as one, as_caller(one, KEYS["root"]) as caller:
        yield caller


def told_by(served: Served) -> dict[str, Any]:
    response = served.http.get("/workers")
    assert response.status_code == 200, response.text
    return response.json()


def light(served: Served) -> dict[str, Any]:
    """The queue of light jobs."""
    return next(queue for queue in told_by(served)["queues"] if queue["name"] == "light")


def busy(served: Served) -> dict[str, Any] | None:
    """A worker that makes a clip, and that has told how much memory it takes."""
    workers = [one for process in told_by(served)["processes"] for one in process["workers"]]
    making = [one for one in workers if one["memory_mb"] and [job["stage"] for job in one["jobs"]] == ["generation"]]
    return making[0] if making else None


def test_a_server_shows_its_workers_and_queues(served: Served) -> None:
    first = served.submit(slow(100, seed=300))
    served.rendering(first["id"])
    waits = served.submit(slow(0.1, seed=301))
    worker = eventually(lambda: busy(served))
    (process,) = told_by(served)["processes"]
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
        (shown,) = told_by(alice)["processes"]
    (own,) = shown["workers"]
    hidden = [shown["host"], shown["pid"], own["pid"], own["jobs"][0]["id"]]
    assert (hidden, own["jobs"][0]["kind"]) == ([None] * 4, "simulate"), "places are told to administrators alone"
    served.http.post(f"/jobs/{first['id']}/cancel")
    assert served.ended(waits["id"])["status"] == "succeeded"
    eventually(lambda: light(served)["queued"] == light(served)["running"] == 0)
    eventually(lambda: light(served)["jobs_per_minute"] == 0.2)  # one in five minutes: canceled ones do not count


class TestProcesses(Contract):
    """Worker processes."""


@pytest.fixture(scope="module")
def database() -> Iterator[PostgresServer]:
    with postgres() as server:
        yield server


@pytest.fixture(scope="module")
def fleet(
    database: PostgresServer, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Served, Worker, Worker]]:
    """A server that computes nothing, and two workers, on one PostgreSQL."""
    folder, own = tmp_path_factory.mktemp("fleet"), {"COW_DATABASE_URL": database.url, "COW_SHUTDOWN_GRACE": "1"}
    own["COW_CONCURRENCY"] = "1"
    with (
        Served(folder, COW_ROLE="api", **own) as api,
        Worker(folder, log="first", COW_METRICS_PORT=str(metrics_port()), **own) as first,
    ):
        eventually(lambda: api.http.get("/readyz").is_success)
        with Worker(folder, log="second", **own) as second:
            yield api, first, second


@cache
def metrics_port() -> int:
    """One that was free just now."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


def test_an_api_server_computes_nothing_and_hears_of_jobs_that_two_workers_share(
    fleet: tuple[Served, Worker, Worker], database: PostgresServer
) -> None:
    api, *workers = fleet
    jobs = [api.submit(slow(100, seed=seed)) for seed in (200, 201)]
    waits = api.submit(slow(0.2, seed=202))

    def at_work() -> dict[int, str]:
        """The jobs of each process."""
        return {
            one["pid"]: job["id"]
            for one in told_by(api)["processes"]
            for each in one["workers"]
            for job in each["jobs"]
        }

    wanted = {job["id"] for job in jobs}
    shared = eventually(lambda: found if {*(found := at_work()).values()} == wanted else None)
    assert {*shared} == {one.process and one.process.pid for one in workers}
    assert workers_of(api) == []
    metrics = httpx.get(f"http://127.0.0.1:{metrics_port()}/metrics", timeout=TIME_LIMIT).text
    assert 'cow_workers{queue="light",state="busy"} 1.0' in metrics
    began = api.rendering(jobs[0]["id"])["progress"]
    eventually(lambda: api.job(jobs[0]["id"])["progress"] > began)
    for job in jobs:
        assert api.http.post(f"/jobs/{job['id']}/cancel").json()["status"] == "canceled"
    assert api.ended(waits["id"])["status"] == "succeeded"


def test_an_api_server_takes_jobs_for_models_that_it_does_not_have(fleet: tuple[Served, Worker, Worker]) -> None:
    api, *_ = fleet
    wrong = {**BODY, "generator": "ati", "num_frames": 81, "generator_options": {"steps": "many"}}
    problem(api.http.post("/simulate", json=wrong, headers=ASYNC), 422, "invalid-request")
    job = api.submit(wrong | {"generator_options": {"steps": 4}})
    assert api.job(job["id"])["status"] in ("queued", "running", "failed")
    api.http.delete(f"/jobs/{job['id']}")


def test_workers_that_are_stopped_end_while_the_database_is_away(
    fleet: tuple[Served, Worker, Worker], database: PostgresServer
) -> None:
    api, *workers = fleet
    for seed in (230, 231):
        api.rendering(api.submit(slow(60, seed=seed))["id"])
    database.kill()
    for worker in workers:
        assert worker.process is not None
        worker.process.terminate()
    assert [worker.process and worker.process.wait(TIME_LIMIT) for worker in workers] == [0, 0]


def test_a_job_whose_worker_ends_with_the_server_does_not_fail() -> None:
    """It would need another one, and has none before the next start."""
    group = Group("light", Settings(), Metrics())
    group.close()
    with pytest.raises(Canceled):
        group.take(lambda: None)
