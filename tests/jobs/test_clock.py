"""What is kept stays small, is found by its state, and is cleaned up by one process at a time."""

from __future__ import annotations

import os
import random
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import sqlalchemy as sa
from job_rows import add_job, open_database, take_new_job
from refusals import refused
from waiting import eventually

from cow_service.jobs import cleaning
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.cleaning import BUDGET_GRACE_SECONDS, CHUNK, UNREFERENCED_GRACE_SECONDS, collect_artifacts
from cow_service.jobs.computing import Computer, EngineParts
from cow_service.jobs.database import Database, StoredResult
from cow_service.jobs.job_table import JobTable
from cow_service.jobs.loop import JobLoop
from cow_service.jobs.processes import Processes
from cow_service.jobs.schema import JOBS
from cow_service.jobs.ticker import Ticker
from cow_service.jobs.webhooks import Webhooks
from cow_service.media.artifacts import DiskArtifacts, ListedArtifact
from cow_service.settings import Settings


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    with closing(open_database(tmp_path)) as database:
        yield database


def test_one_process_cleans_up_at_a_time(tmp_path: Path, database: Database) -> None:
    with closing(open_database(tmp_path)) as other:
        assert database.take_turn("jobs", 600)
        assert not other.take_turn("jobs", 600)
        assert not database.take_turn("jobs", 600)
        assert other.take_turn("artifacts", 600), "that is another turn"
        assert other.take_turn("jobs", 0), "the turn is over"
        assert not database.take_turn("artifacts", 600)
        other.give_turn_back("artifacts")
        assert database.take_turn("artifacts", 600), "its work was not done"
        assert not database.take_turn("jobs", 600)


def test_what_belongs_to_a_job_is_deleted_with_it(database: Database) -> None:
    for job, shared in (("one", "5" * 64), ("two", "5" * 64)):
        add_job(database, job)
        stored = StoredResult(job * 4, "trajectory", "{}", (job * 8, shared), '{"value":1}')
        database.store_results(job, [stored])
    assert database.referenced(["one" * 8, "5" * 64, "6" * 64]) == {"one" * 8, "5" * 64}
    assert JobTable(database).cancel("one")
    assert JobTable(database).delete(["one"]) == {"one" * 8}, "the other artifacts are needed by another job"
    assert database.find_result("one" * 4) is None
    assert database.find_result("two" * 4) == ("two", {"value": {"value": 1}})
    assert database.finished_stages("one") == set()
    for table in ("cow_results", "cow_trajectories_of_jobs", "cow_references", "cow_stages_of_jobs"):
        assert database.read(sa.text(f"SELECT DISTINCT job_id FROM {table}")) == [("two",)], table


NOW = 1e9
SIZE = 1000  # bytes of each artifact


class ManyArtifacts(DiskArtifacts):
    """A store of as many artifacts as there are ages (s). It bears no caller who holds more of them than a chunk."""

    def __init__(self, folder: Path, ages: list[float]) -> None:
        super().__init__(folder)
        self.used_at = {f"a{number:063x}": NOW - age for number, age in enumerate(ages)}
        self.used_meanwhile = set[str]()
        self.deletions = 0  # of this listing

    def listed(self) -> Iterator[ListedArtifact]:
        self.deletions = 0
        for number, (sha256, used_at) in enumerate([*self.used_at.items()]):
            assert number < CHUNK * (self.deletions + 1), "more than one chunk is held"
            yield ListedArtifact(sha256, SIZE, used_at)

    def delete(self, artifacts: Collection[str], untouched_since: float) -> set[str]:
        self.deletions += 1
        deleted = {one for one in artifacts if one not in self.used_meanwhile}
        assert all(self.used_at.pop(one) <= untouched_since for one in deleted)
        return deleted

    def ages(self) -> list[float]:
        return sorted(NOW - used_at for used_at in self.used_at.values())


def sweep(store: DiskArtifacts, database: Database, max_gb: float | None = None) -> None:
    service: Any = SimpleNamespace(artifacts=store, settings=Settings(artifacts_max_gb=max_gb))
    collect_artifacts(service, database, lambda: False, NOW)


def refer(database: Database, job: str, artifacts: Collection[str], *, is_open: bool = False) -> None:
    add_job(database, job)
    database.reuse_result(job, "generation", artifacts)
    if not is_open:
        JobTable(database).cancel(job)


def test_artifacts_without_a_job_go_chunk_by_chunk(tmp_path: Path, database: Database) -> None:
    store = ManyArtifacts(tmp_path, [2 * UNREFERENCED_GRACE_SECONDS] * (2 * CHUNK) + [10.0] * (CHUNK // 2))
    needed = {f"a{number:063x}" for number in range(0, 2 * CHUNK, 100)}
    refer(database, "job", needed)
    store.used_meanwhile = {f"a{CHUNK + 1:063x}"}
    sweep(store, database)
    young = {f"a{number:063x}" for number in range(2 * CHUNK, 2 * CHUNK + CHUNK // 2)}
    assert set(store.used_at) == needed | young | store.used_meanwhile


def test_the_budget_removes_the_longest_unused_first(tmp_path: Path, database: Database) -> None:
    ages = [1000.0 * (number + 1) for number in range(2 * CHUNK + 1)]
    random.Random(0).shuffle(ages)
    store = ManyArtifacts(tmp_path, [*ages, 3e8])
    oldest = f"a{len(ages):063x}"
    refer(database, "ended", [*store.used_at][:-1])
    refer(database, "open", [oldest], is_open=True)
    sweep(store, database, max_gb=SIZE * 10 / 1e9)
    assert store.ages() == [*(1000.0 * (number + 1) for number in range(9)), 3e8]


@pytest.mark.parametrize("kept", [0, 3, 7])
def test_of_equally_old_artifacts_no_more_go_than_the_budget_asks_for(
    tmp_path: Path, database: Database, kept: int
) -> None:
    store = ManyArtifacts(tmp_path, [2000.0] * 5 + [4000.0] * 5 + [BUDGET_GRACE_SECONDS - 1])
    refer(database, "ended", store.used_at)
    sweep(store, database, max_gb=SIZE * (kept + 1) / 1e9)
    assert store.ages() == [BUDGET_GRACE_SECONDS - 1, *([2000.0] * 5 + [4000.0] * 5)[:kept]]


def test_an_artifact_that_is_used_while_it_is_listed_stays(
    tmp_path: Path, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = DiskArtifacts(tmp_path / "artifacts")
    used, loose = (store.put(data, "image/png").sha256 for data in (b"used", b"loose"))
    listed = [ListedArtifact(one.sha256, one.size, NOW - 1e6) for one in store.listed()]
    with store.local_file(loose) as path:
        os.utime(path, (NOW - 1e6, NOW - 1e6))
    monkeypatch.setattr(store, "listed", lambda: iter(listed))
    sweep(store, database)
    assert store.read(used) == b"used"
    with refused("artifact-not-found"):
        store.get(loose)


class EndlessListing(ManyArtifacts):
    """A store of young artifacts without end."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, [])
        self.is_listed = threading.Event()

    def listed(self) -> Iterator[ListedArtifact]:
        self.is_listed.set()
        while True:
            yield ListedArtifact("a" * 64, SIZE, time.time())


@contextmanager
def ticking(service: Any, database: Database) -> Iterator[tuple[Ticker, ActiveJobs]]:
    """A ticker, of the process "me"."""
    active = ActiveJobs()
    parts = EngineParts(service, database, JobTable(database), active, "me")
    loop = JobLoop(parts, Computer())
    ticker = Ticker(parts, loop, Processes(parts, Computer(), None), Webhooks(parts))
    ticker.start()
    yield ticker, active
    ticker.stop()


def test_a_long_listing_holds_up_nothing_else(
    tmp_path: Path, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ticker.CLEAN_UP_SECONDS", "ticker.CHECK_SECONDS", "ticker.TICK_SECONDS"):
        monkeypatch.setattr(f"cow_service.jobs.{name}", 0.01)
    store, turns, take_turn = EndlessListing(tmp_path), list[Any](), database.take_turn
    monkeypatch.setattr(database, "take_turn", lambda *turn: (turns.append(turn), take_turn(*turn))[1])
    with ticking(SimpleNamespace(artifacts=store, settings=Settings()), database) as (_, active):
        eventually(store.is_listed.is_set)
        job = active.begin("job", "simulate", "1")  # which another process has canceled
        eventually(job.cancel_requested.is_set)
        assert turns[:2] == [("jobs", cleaning.TURN_SECONDS), ("artifacts", cleaning.LISTING_SECONDS)]
        assert not database.take_turn("artifacts", 600)
    eventually(lambda: database.take_turn("artifacts", 600))  # it was stopped before it was done: another may begin


def test_jobs_that_nobody_works_on_go_back_to_their_queue(
    database: Database, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Those of a process that has ended, and those of this one that could not be started."""
    caplog.set_level("INFO", "cow_service")
    for name in ("CHECK_SECONDS", "TICK_SECONDS"):
        monkeypatch.setattr(f"cow_service.jobs.ticker.{name}", 0.05)
    at_work = take_new_job(database, "at work", "me")
    for job, executor in (("stalled", "me"), ("left", "gone")):
        take_new_job(database, job, executor)
    waits = sa.select(JOBS.c.id).where(JOBS.c.executor.is_(None))
    with ticking(SimpleNamespace(settings=Settings()), database) as (ticker, active):
        job = active.begin("at work", "simulate", at_work.run)
        ticker.recover()  # as a start does
        eventually(lambda: {row.id for row in database.read(waits)} == {"stalled", "left"})
        assert not job.cancel_requested.is_set()
    assert "job left goes back to its queue: its process has ended" in caplog.text
    assert "job stalled goes back to its queue: nothing works on it" in caplog.text


def test_after_jobs_connections_are_closed(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cow_service.jobs.active.QUIET_SECONDS", 0.5)
    monkeypatch.setattr("cow_service.jobs.ticker.TICK_SECONDS", 0.05)
    for one in [database.engine.connect() for _ in range(5)]:
        one.close()
    pool: Any = database.engine.pool
    assert pool.checkedin() >= 4
    with ticking(SimpleNamespace(settings=Settings()), database):
        eventually(lambda: pool.checkedin() <= 1)
    database.check()


def test_a_sign_of_a_job_ends_a_long_rest(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cow_service.jobs.active.QUIET_SECONDS", -1.0)
    monkeypatch.setattr("cow_service.jobs.ticker.QUIET_TICK_SECONDS", 600.0)
    monkeypatch.setattr("cow_service.jobs.ticker.CHECK_SECONDS", 0.0)
    before = {*threading.enumerate()}  # with those of other tests' servers
    with ticking(SimpleNamespace(settings=Settings()), database) as (_, active):
        eventually(lambda: not active.stirred.is_set())
        job = active.begin("job", "simulate", "1")
        eventually(job.cancel_requested.is_set)  # it is not in the table
        active.end("job", job)
        assert active.is_quiet
    assert not [one for one in {*threading.enumerate()} - before if one.name == "cow-ticker"], "a stop ends it, too"


def test_jobs_go_when_they_were_kept_as_long_as_they_are_to_be(database: Database) -> None:
    deleted: list[tuple[set[str], float]] = []
    artifacts = SimpleNamespace(delete=lambda names, since: deleted.append((names, since)))
    service: Any = SimpleNamespace(settings=Settings(job_retention_hours=2), artifacts=artifacts)
    parts = EngineParts(service, database, JobTable(database), ActiveJobs(), "me")
    for job, hours in (("old", 2.1), ("young", 1.9), ("open", None)):
        add_job(database, job)
        if hours is not None:
            with database.transaction() as connection:
                ended = {"status": "failed", "ended": time.time() - 3600 * hours}
                connection.execute(sa.update(JOBS).where(JOBS.c.id == job).values(ended))
            database.reuse_result(job, "generation", [job * 8])
    began = time.time()
    cleaning.remove_old_jobs(parts, lambda: False)
    ((names, since),) = deleted
    assert names == {"old" * 8}
    assert began - 7200 <= since - 1 <= time.time() - 7200
    assert {row.id for row in database.read(sa.select(JOBS.c.id))} == {"young", "open"}
