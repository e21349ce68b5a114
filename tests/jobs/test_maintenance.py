"""What is kept stays small, is found by its state, and is cleaned up by one process at a time."""

from __future__ import annotations

import json
import os
import random
import threading
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import sqlalchemy as sa
from hypothesis import given
from hypothesis import strategies as st
from job_rows import add_job
from waiting import eventually

from cow_service.errors import ArtifactNotFound
from cow_service.jobs import maintenance
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.calls import Calls
from cow_service.jobs.database import Database, StoredResult
from cow_service.jobs.job_table import JobTable
from cow_service.jobs.maintenance import BUDGET_GRACE_SECONDS, CHUNK, UNREFERENCED_GRACE_SECONDS, collect_artifacts
from cow_service.jobs.packing import packed, unpacked
from cow_service.media.artifacts import DiskArtifacts, ListedArtifact
from cow_service.service import Service
from cow_service.settings import Settings


@given(st.recursive(st.none() | st.booleans() | st.text() | st.floats(-1e9, 1e9), st.lists))
def test_values_come_back_as_they_were(value: object) -> None:
    assert unpacked(packed(json.dumps(value))) == value


def test_long_results_are_kept_small() -> None:
    path = json.dumps([[0.125 * i, 0.5 * i] for i in range(2000)])
    assert len(packed(path)) < len(path) / 3


def test_one_process_cleans_up_at_a_time(tmp_path: Path) -> None:
    one, other = (Database(Settings(data_dir=tmp_path)) for _ in range(2))
    one.create_tables()
    assert one.take_turn("jobs", 600)
    assert not other.take_turn("jobs", 600)
    assert not one.take_turn("jobs", 600)
    assert other.take_turn("artifacts", 600), "that is another turn"
    assert other.take_turn("jobs", 0), "the turn is over"
    assert not one.take_turn("artifacts", 600)
    other.give_turn_back("artifacts")
    assert one.take_turn("artifacts", 600), "its work was not done"
    assert not one.take_turn("jobs", 600)
    one.close()
    other.close()


def test_what_belongs_to_a_job_is_deleted_with_it(tmp_path: Path) -> None:
    database = Database(Settings(data_dir=tmp_path))
    database.create_tables()
    for job, shared in (("one", "5" * 64), ("two", "5" * 64)):
        add_job(database, job)
        stored = StoredResult(job * 4, "trajectory", "{}", (job * 8, shared), '{"value":1}')
        database.store_results(job, [stored])
    assert JobTable(database).delete(["one"]) == {"one" * 8}, "the other artifacts are needed by another job"
    assert database.find_result("one" * 4) is None
    assert database.find_result("two" * 4) == ("two", {"value": {"value": 1}})
    assert database.finished_stages("one") == set()
    with database.engine.connect() as connection:
        for table in ("cow_results", "cow_trajectories_of_jobs", "cow_references", "cow_stages_of_jobs"):
            left = connection.execute(sa.text(f"SELECT DISTINCT job_id FROM {table}")).scalars().all()
            assert left == ["two"], table
    database.close()


def test_lists_of_a_status_look_at_no_other_jobs(tmp_path: Path) -> None:
    database = Database(Settings(data_dir=tmp_path))
    database.create_tables()
    with database.engine.connect() as connection:
        for wanted in ("status IN ('failed', 'canceled')", "owner = 'x'"):
            query = f"SELECT kind FROM cow_jobs WHERE {wanted} AND kind IN ('simulate', 'answer') "
            steps = connection.execute(
                sa.text(f"EXPLAIN QUERY PLAN {query} ORDER BY created_at DESC, id DESC LIMIT 50")
            )
            assert any("SEARCH" in row[3] and "cow_jobs_of" in row[3] for row in steps), wanted
    database.close()


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


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    database = Database(Settings(data_dir=tmp_path))
    database.create_tables()
    yield database
    database.close()


def sweep(store: DiskArtifacts, database: Database, max_gb: float | None = None) -> None:
    service = SimpleNamespace(artifacts=store, settings=Settings(artifacts_max_gb=max_gb))
    collect_artifacts(cast(Service, service), database, lambda: False, NOW)


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
    with pytest.raises(ArtifactNotFound):
        store.get(loose)


def test_an_artifact_of_many_jobs_is_one(database: Database) -> None:
    for job in ("one", "two"):
        refer(database, job, ["a" * 64])
    assert database.referenced(["a" * 64, "b" * 64]) == {"a" * 64}


class EndlessListing(ManyArtifacts):
    """A store of young artifacts without end."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, [])
        self.is_listed = threading.Event()

    def listed(self) -> Iterator[ListedArtifact]:
        self.is_listed.set()
        while True:
            yield ListedArtifact("a" * 64, SIZE, time.time())


def test_a_long_listing_holds_up_no_other_maintenance(
    tmp_path: Path, database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(maintenance, "CLEAN_UP_SECONDS", 0.0)
    monkeypatch.setattr(maintenance, "POLL_SECONDS", 0.01)
    store, canceled = EndlessListing(tmp_path), list[str]()
    service = SimpleNamespace(artifacts=store, settings=Settings())
    # A job that another process has canceled, once the listing has begun.
    active = ActiveJobs()
    monkeypatch.setattr(active, "runs", lambda: {"job": "1"} if store.is_listed.is_set() else {})
    monkeypatch.setattr(active, "request_cancel", canceled.append)
    parts: Any = SimpleNamespace(
        service=service, database=database, jobs=JobTable(database), active=active, executor="me"
    )
    thread = maintenance.Maintenance(
        parts, Calls(), maintenance.FolderLease(tmp_path), lambda _jobs, _since: None, lambda: None
    )
    thread.start()
    try:
        eventually(lambda: canceled)
        assert not database.take_turn("artifacts", 600)
    finally:
        thread.stop()
    assert database.take_turn("artifacts", 600), "it was stopped before it was done: another process may begin"
