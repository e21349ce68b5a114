"""Whose job comes next: queues, turns of keys, their weights, and priorities within a key."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

from hypothesis import given
from hypothesis import strategies as st

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
