"""What one key may have of a server: a bound on its running jobs, priorities among its own, a weight among others."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from job_rows import add_job
from postgres import postgres_server
from servers import ASYNC, TERMINAL, Served, problem, slow
from waiting import TIME_LIMIT, eventually

from cow_service.api.middleware.access import hash_of, new_key
from cow_service.jobs.database import Database
from cow_service.jobs.job_table import JobTable
from cow_service.jobs.queues import step_of
from cow_service.settings import Settings

LIMIT = 1
KEYS = {name: new_key() for name in ("alice", "bob")}
HASHES = {name: hash_of(key) for name, key in KEYS.items()}


class Caller:
    """A caller with a key."""

    def __init__(self, served: Served, key: str) -> None:
        headers = {"Authorization": f"Bearer {key}"}
        self.http = httpx.Client(base_url=served.http.base_url, timeout=TIME_LIMIT, headers=headers)

    def submit(self, body: dict[str, Any]) -> str:
        response = self.http.post("/simulate", json=body, headers=ASYNC)
        assert response.status_code == 202, response.text
        return response.json()["id"]

    def jobs(self) -> list[dict[str, Any]]:
        return self.http.get("/jobs", params={"limit": 100}).json()["jobs"]

    def order_of_ends(self, names: dict[str, str]) -> list[str]:
        """The names of jobs by their ids, in the order in which they are seen to end.

        Times in SQLite are whole seconds.
        """
        order: list[str] = []

        def all_ended() -> bool:
            jobs = self.jobs()
            assert len([job for job in jobs if job["status"] == "running"]) <= LIMIT
            ended = [job for job in jobs if job["id"] in names and job["status"] in TERMINAL]
            assert {job["status"] for job in ended} <= {"succeeded"}
            new = [job for job in ended if names[job["id"]] not in order]
            order.extend(names[job["id"]] for job in sorted(new, key=lambda job: job["finished_at"]))
            return len(order) == len(names)

        eventually(all_ended)
        return order


@pytest.fixture(scope="module", params=["sqlite", "postgres"])
def served(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    own = {
        "COW_API_KEYS": json.dumps(HASHES),
        "COW_RUNNING_LIMIT_PER_KEY": str(LIMIT),
        "COW_CONCURRENCY": "2",
    }
    folder: Path = tmp_path_factory.mktemp("shares")
    if request.param == "sqlite":
        with Served(folder, **own) as one:
            yield one
    else:
        with postgres_server() as url, Served(folder, COW_DATABASE_URL=url, **own) as one:
            yield one


@pytest.fixture
def alice(served: Served) -> Iterator[Caller]:
    caller = Caller(served, KEYS["alice"])
    yield caller
    caller.http.close()


@pytest.fixture
def bob(served: Served) -> Iterator[Caller]:
    caller = Caller(served, KEYS["bob"])
    yield caller
    caller.http.close()


@pytest.mark.slow
def test_a_key_has_no_more_running_jobs_than_it_may_have(alice: Caller, bob: Caller) -> None:
    names = {alice.submit(slow(1.5, seed=seed)): str(seed) for seed in range(3)}
    assert bob.http.post("/simulate", json=slow(0.2)).status_code == 200, "there is a place for others"
    assert sum(job["status"] in TERMINAL for job in alice.jobs()) <= 1, "and nobody waits for it"
    assert alice.order_of_ends(names) == ["0", "1", "2"]


@pytest.mark.slow
def test_a_job_of_higher_priority_comes_before_those_of_its_key_that_wait(alice: Caller) -> None:
    ranks = ("normal", "low", "low", "high", "normal")
    names = {
        alice.submit(slow(0.6, seed=10 + place, priority=rank)): f"{rank} {place}" for place, rank in enumerate(ranks)
    }
    queued = {names[job["id"]]: job for job in alice.jobs() if job["id"] in names}
    positions = [alice.http.get(f"/jobs/{queued[name]['id']}").json()["position"] for name in ("high 3", "low 2")]
    assert positions[0] < positions[1]
    assert alice.order_of_ends(names) == ["normal 0", "high 3", "normal 4", "low 1", "low 2"]
    problem(alice.http.post("/simulate", json=slow(0.1, priority="urgent")), 422, "invalid-request")


@pytest.mark.slow
def test_priority_is_no_part_of_what_an_idempotency_key_stands_for(alice: Caller) -> None:
    key = {"Idempotency-Key": "hurry"}
    first = alice.http.post("/simulate", json=slow(0.1, seed=30, priority="low"), headers=key)
    again = alice.http.post("/simulate", json=slow(0.1, seed=30, priority="high"), headers=key)
    assert (first.status_code, again.status_code) == (200, 200)
    assert again.headers["Idempotent-Replayed"] == "true"


def test_a_key_of_more_weight_has_more_turns(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("COW_API_KEYS", json.dumps(HASHES))
    monkeypatch.setenv("COW_KEY_WEIGHTS", json.dumps({"alice": 4}))
    settings = Settings(data_dir=tmp_path)
    database = Database(settings)
    database.create_tables()

    def last_turn(owner: str) -> int:
        step = step_of(settings.key_weights.get(owner, 1.0))
        for number in range(9):
            add_job(database, f"{owner}{number}", owner, step=step)
        spec = JobTable(database).spec(f"{owner}8")
        assert spec is not None
        return spec.turn

    assert last_turn("bob") == 4 * last_turn("alice") > 0
    database.close()
