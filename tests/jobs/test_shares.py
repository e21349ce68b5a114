"""What one key may have of a server: a bound on its running jobs, priorities among its own, a weight among others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from callers import as_caller, new_keys
from job_rows import add_job, open_database
from servers import Served, problem, slow
from waiting import eventually

from cow_service.jobs.job_table import JobTable
from cow_service.jobs.queues import step_of

LIMIT = 1
SETTINGS, KEYS = new_keys("alice", "bob")


@pytest.fixture(scope="module")
def alice(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A caller of a server that runs two jobs, and one of each key."""
    own = {"COW_RUNNING_LIMIT_PER_KEY": str(LIMIT), "COW_CONCURRENCY": "2", **SETTINGS}
    with Served(tmp_path_factory.mktemp("shares"), **own) as one, as_caller(one, KEYS["alice"]) as caller:
        yield caller


@pytest.mark.slow
def test_a_key_has_no_more_running_jobs_than_it_may_have_and_those_of_higher_priority_first(alice: Served) -> None:
    first = alice.submit(slow(100, seed=10))
    alice.rendering(first["id"])
    ranks = ("low", "low", "high", "normal")
    jobs = [alice.submit(slow(0.2, seed=11 + place, priority=rank)) for place, rank in enumerate(ranks)]
    with as_caller(alice, KEYS["bob"]) as bob:
        assert bob.http.post("/simulate", json=slow(0.2)).status_code == 200, "there is a place for others"
    assert [alice.job(job["id"])["status"] for job in jobs] == ["queued"] * 4
    assert alice.job(jobs[2]["id"])["position"] < alice.job(jobs[1]["id"])["position"]
    alice.http.post(f"/jobs/{first['id']}/cancel")
    names = {job["id"]: f"{rank} {place}" for place, (job, rank) in enumerate(zip(jobs, ranks, strict=True))}

    def order_of_ends() -> list[str]:
        """Once all have ended. Never do more run than may."""
        listed = alice.http.get("/jobs", params={"limit": 100}).json()["jobs"]
        assert len([job for job in listed if job["status"] == "running"]) <= LIMIT
        ended = [job for job in listed if job["status"] == "succeeded"]
        order = [names[job["id"]] for job in sorted(ended, key=lambda job: job["finished_at"])]
        return order if len(order) == len(names) else []

    assert eventually(order_of_ends) == ["high 2", "normal 3", "low 0", "low 1"]
    problem(alice.http.post("/simulate", json=slow(0.1, priority="urgent")), 422, "invalid-request")
    key = {"Idempotency-Key": "hurry"}  # which stands for the same request, whatever its priority
    bodies = [slow(0.1, seed=30, priority=rank) for rank in ("low", "high")]
    replays = [
        alice.http.post("/simulate", json=body, headers=key).headers.get("Idempotent-Replayed") for body in bodies
    ]
    assert replays == [None, "true"]


def test_a_key_of_more_weight_has_more_turns(tmp_path: Path) -> None:
    with closing(open_database(tmp_path)) as database:

        def last_turn(owner: str, weight: float) -> int:
            for number in range(9):
                add_job(database, f"{owner}{number}", owner, step=step_of(weight))
            spec = JobTable(database).spec(f"{owner}8")
            assert spec is not None
            return spec.turn

        assert last_turn("bob", 1) == 4 * last_turn("alice", 4) > 0
