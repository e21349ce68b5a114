"""Whose job comes next: queues, turns of keys, their weights and bounds, and priorities within a key."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from callers import as_caller, new_keys
from hypothesis import given
from hypothesis import strategies as st
from job_rows import add_job, open_database
from servers import Served, problem, slow
from waiting import eventually

from cow_service.jobs.job_table import JobTable
from cow_service.jobs.queues import LAST, STEP, clips, known_queues, moves, next_turn, queue_of, step_of
from cow_service.requests import PRIORITIES, Priority
from cow_service.settings import Settings

OWNERS = st.sampled_from(("alice", "bob", "carol", None))
JOBS = st.lists(st.tuples(OWNERS, st.sampled_from(PRIORITIES)), max_size=40)


@dataclass(frozen=True)
class Waiting:
    number: int
    owner: str | None
    priority: Priority
    turn: int


class Line:
    """A queue: who comes first is taken first."""

    def __init__(self, weights: dict[str | None, float] | None = None) -> None:
        self.jobs: list[Waiting] = []
        self.weights = weights or {}
        self.came = 0

    def add(self, owner: str | None, priority: Priority = "normal") -> None:
        step = step_of(self.weights.get(owner, 1))
        turn = next_turn(self.jobs, owner, priority, step)
        self.jobs = [
            replace(job, turn=job.turn + step) if moves(job, owner, priority, turn) else job for job in self.jobs
        ]
        self.jobs.append(Waiting(self.came, owner, priority, turn))
        self.came += 1

    def take(self) -> Waiting:
        first = min(self.jobs, key=lambda job: (job.turn, job.number))
        self.jobs.remove(first)
        return first

    def taken(self, number: int) -> list[Waiting]:
        return [self.take() for _ in range(number)]


@given(JOBS)
def test_a_key_has_its_jobs_by_priority_and_then_as_they_came(jobs: list[tuple[str | None, Priority]]) -> None:
    line = Line()
    for job in jobs:
        line.add(*job)
    taken = line.taken(len(jobs))
    for owner in {job.owner for job in taken}:
        own = [job for job in taken if job.owner == owner]
        assert own == sorted(own, key=lambda job: (-PRIORITIES.index(job.priority), job.number))


@given(JOBS, st.data())
def test_priorities_change_no_share(jobs: list[tuple[str | None, Priority]], data: st.DataObject) -> None:
    """Whose job is taken when is what it would be if all jobs had the same priority."""
    ranked, plain = Line(), Line()
    for owner, priority in jobs:
        ranked.add(owner, priority)
        plain.add(owner)
    number = data.draw(st.integers(0, len(jobs)))
    shares = [Counter(job.owner for job in line.taken(number)) for line in (ranked, plain)]
    for owner in {owner for owner, _ in jobs}:
        assert abs(shares[0][owner] - shares[1][owner]) <= 1


def test_keys_take_turns_by_their_weights() -> None:
    line = Line({"alice": 3, "bob": 1, "carol": 0.5})
    for owner in ("alice", "bob", "carol"):
        for _ in range(200):
            line.add(owner)
    taken = Counter(job.owner for job in line.taken(180))
    assert taken == {"alice": 120, "bob": 40, "carol": 20}


def test_whoever_comes_late_waits_for_nobodys_flood_and_makes_up_for_nothing() -> None:
    line = Line()
    for _ in range(100):
        line.add("alice")
    line.taken(50)
    for _ in range(10):
        line.add("bob")
    assert Counter(job.owner for job in line.taken(20)) == {"alice": 10, "bob": 10}


def test_turns_begin_anew_when_nobody_waits_and_never_become_too_large() -> None:
    line = Line()
    line.add("alice")
    line.taken(1)
    line.add("alice")
    assert line.take().turn == 0
    late = Waiting(0, "alice", "normal", LAST)
    assert next_turn([late], "alice", "normal", STEP) == LAST
    assert step_of(1e9) == 1


def test_what_has_a_device_or_a_limit_of_its_own_has_a_queue_of_its_own() -> None:
    plain, limited = Settings(), Settings(generator_concurrency={"slow": 2})
    assert [clips(name, limited) for name in ("cutout", "ati", "slow")] == [None, 1, 2]
    assert [queue_of("embedded", name, plain) for name in ("cutout", "ati", "slow")] == ["light", "ati", "light"]
    assert [queue_of(reader, "slow", limited) for reader in ("embedded", "local")] == ["slow", "local"]
    assert {*known_queues(limited)} - {*known_queues(plain)} == {"slow"}
    assert {"light", "ati", "local"} < {*known_queues(plain)}


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
