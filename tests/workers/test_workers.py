"""API servers and workers on one job database: jobs that harm their process, and who computes what."""

from __future__ import annotations

import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import psutil
import pytest
from postgres import PostgresServer, postgres
from servers import ASYNC, BODY, Served, Worker, problem, slow
from waiting import TIME_LIMIT, eventually

from cow_service.errors import Canceled, install_line
from cow_service.jobs.queues import check_queues
from cow_service.observability.metrics import Metrics
from cow_service.settings import Settings, SettingsError
from cow_service.workers.pool import Group

pytestmark = pytest.mark.slow


def poison(how: str, seed: int = 0) -> dict[str, Any]:
    """A request whose clip does something to the process that makes it, after a moment."""
    body = slow(0.2, seed=seed)
    return body | {"generator_options": {"seconds": 0.2, "end": how}}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    limits = {"COW_WORKER_MEMORY_MB": "1000", "COW_JOB_TIMEOUT": "25"}
    with Served(tmp_path_factory.mktemp("workers"), COW_WORKERS="true", **limits) as one:
        yield one


def workers_of(served: Served) -> list[psutil.Process]:
    assert served.process is not None
    alive = [one for one in psutil.Process(served.process.pid).children() if one.status() != psutil.STATUS_ZOMBIE]
    return [one for one in alive if "cow_service.workers" in one.cmdline()]


def test_a_crash_harms_the_job_that_caused_it_and_no_other(served: Served) -> None:
    innocents = [served.submit(slow(0.3, seed=seed))["id"] for seed in range(1, 7)]
    guilty = served.submit(poison("kill", seed=100))["id"]
    innocents += [served.submit(slow(0.3, seed=seed))["id"] for seed in range(7, 13)]
    ended = served.ended(guilty)
    assert ended["status"] == "failed"
    assert ended["problem"]["type"] == "urn:cow:problem:worker-ended"
    assert "signal 9" in ended["problem"]["detail"]
    others = [served.ended(one) for one in innocents]
    assert [one["problem"] for one in others if one["status"] != "succeeded"] == []
    assert served.clips().count(100) == 3, "it is tried again: the crash may have been no fault of the job"
    assert all(served.clips().count(seed) == 1 for seed in range(1, 13)), "nobody else was begun twice"


def test_too_much_memory_ends_the_job_alone(served: Served) -> None:
    told = problem(served.http.post("/simulate", json=poison("memory", seed=101)), 500, "worker-ended")
    assert "MB" in told["detail"]
    assert served.clips().count(101) == 1, "it would take as much again"
    assert served.http.post("/simulate", json=slow(0.1, seed=102)).status_code == 200


@pytest.mark.parametrize(("path", "seed"), [("/simulate", 120), pytest.param("/answer", 122, marks=pytest.mark.soak)])
def test_a_worker_whose_device_fails_is_replaced(path: str, seed: int, served: Served) -> None:
    before = {one.pid for one in workers_of(served)}
    told = problem(served.http.post(path, json=poison("device", seed=seed)), 503, "device-failed")
    assert told["detail"] == "The GPU failed."
    assert served.clips().count(seed) == 3, "another process may be able to use it"
    assert served.http.post("/simulate", json=slow(0.1, seed=121)).status_code == 200
    assert not before & {one.pid for one in workers_of(served)}


@pytest.mark.soak
def test_a_job_that_never_ends_is_ended(served: Served) -> None:
    problem(served.http.post("/simulate", json=poison("hang", seed=103)), 504, "job-timeout")
    assert served.http.post("/simulate", json=slow(0.1, seed=104)).status_code == 200


def test_a_job_that_cannot_be_stopped_is_canceled_all_the_same(served: Served) -> None:
    job = served.submit(poison("hang", seed=105))
    served.rendering(job["id"])
    assert served.http.post(f"/jobs/{job['id']}/cancel").json()["status"] == "canceled"
    eventually(
        lambda: len(served.clips()) and served.http.post("/simulate", json=slow(0.1, seed=106)).status_code == 200
    )


def test_a_queued_job_says_how_long_it_will_wait(served: Served) -> None:
    jobs = [served.submit(slow(0.5, seed=110 + place)) for place in range(8)]
    last = served.job(jobs[-1]["id"])
    assert last["status"] == "queued"
    assert 3 <= last["position"] <= 7
    assert 0 < last["expected_wait"] < 60, "the tests before have shown the pace"
    ended = served.ended(jobs[-1]["id"])
    assert ended["position"] is ended["expected_wait"] is None


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
    with (
        Served(folder, COW_ROLE="api", **own) as api,
        Worker(folder, log="first", **own) as first,
        Worker(folder, log="second", **own) as second,
    ):
        yield api, first, second


def test_an_api_server_computes_nothing_and_two_workers_share_the_jobs(fleet: tuple[Served, Worker, Worker]) -> None:
    api, *workers = fleet
    assert api.process is not None
    assert workers_of(api) == []
    before = [one.cpu_seconds() for one in workers]
    with ThreadPoolExecutor(8) as threads:
        bodies = [slow(2, seed=seed) for seed in range(200, 208)]
        answers = list(threads.map(lambda body: api.http.post("/simulate", json=body), bodies))
    assert [answer.status_code for answer in answers] == [200] * 8
    assert all(one.cpu_seconds() > spent + 0.2 for one, spent in zip(workers, before, strict=True)), "one did nothing"


def test_progress_and_cancellation_reach_the_other_process(fleet: tuple[Served, Worker, Worker]) -> None:
    api, *_ = fleet
    job = api.submit(slow(30, seed=210))
    api.rendering(job["id"])
    eventually(lambda: api.job(job["id"])["progress"] > 0.25)
    assert api.http.post(f"/jobs/{job['id']}/cancel").json()["status"] == "canceled"
    assert api.http.post("/simulate", json=slow(0.1, seed=211)).status_code == 200


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


@pytest.mark.parametrize("name", ["lihgt", "cutout"])
def test_a_queue_that_does_not_exist_is_told_before_a_worker_starts(name: str) -> None:
    check_queues(Settings(queues=("light", "tiny-ati")))
    with pytest.raises(SettingsError, match=f"no queue '{name}' here. Known: light, .*tiny-ati"):
        check_queues(Settings(queues=("light", name)))


def test_a_queue_whose_backend_is_not_installed_is_told_with_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cow_service.weights.manifests.find_spec", lambda name: None)
    with pytest.raises(SettingsError, match=rf"ati lacks .*torch.*: {re.escape(install_line('wan'))}"):
        check_queues(Settings(queues=("ati",)))
