"""Stored stage results, on a real database: who finds them again, and what is never stored."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from job_rows import add_job
from pydantic import SecretStr

from cow_service.errors import Canceled, StorageUnavailable
from cow_service.jobs.computing import KeyLocks, Outages, StoredStep
from cow_service.jobs.database import Database
from cow_service.jobs.job_table import JobTable
from cow_service.media.artifacts import DiskArtifacts
from cow_service.observability.metrics import Metrics
from cow_service.records import MetresPerPixel, Motion
from cow_service.settings import Settings
from cow_service.stages.keys import StageKey, StageResult

SHARED, OWN = StageKey("a" * 64), StageKey("b" * 64, shareable=False)


def never() -> None:
    """Does nothing."""


@pytest.fixture
def database(tmp_path: Path) -> Database:
    database = Database(Settings(data_dir=tmp_path))
    database.create_tables()
    return database


def step(
    database: Database,
    tmp_path: Path,
    job_id: str,
    fresh: bool = False,
    check=never,
    owner: str | None = None,
    budget: float = 0,
) -> StoredStep:
    add_job(database, job_id, owner)
    return StoredStep(
        job_id,
        owner,
        fresh,
        database,
        DiskArtifacts(tmp_path),
        Metrics().stage_cache,
        KeyLocks().held,
        Outages(budget, check),
    )


def stored(store: StoredStep, key: StageKey, compute: Callable[[], StageResult[Any]]) -> tuple[StageResult[Any], bool]:
    """The result of a job that has only this stage."""
    found = store("motion", key, compute)
    store.flush()
    return found


def result(speed: float) -> StageResult[Any]:
    scale = MetresPerPixel(value=0.01, source="default")
    motion = Motion(
        kind="static", direction=None, cue="text", speed=speed, metres_per_pixel=scale, sentence="", source="request"
    )
    return StageResult(value=motion)


def test_nobody_finds_what_another_key_asked(database: Database, tmp_path: Path) -> None:
    def reused(job_id: str, owner: str | None) -> bool:
        return stored(step(database, tmp_path, job_id, owner=owner), SHARED, lambda: result(1))[1]

    assert [reused(str(n), owner) for n, owner in enumerate(["alice", "bob", None, "alice", "bob", None])] == [
        False, False, False, True, True, True,
    ]  # fmt: skip


def test_a_result_is_found_by_other_jobs_only_where_it_may_be(database: Database, tmp_path: Path) -> None:
    def speed_of(job_id: str, key: StageKey, computed: float, fresh: bool = False) -> tuple[float, bool]:
        found, reused = stored(step(database, tmp_path, job_id, fresh), key, lambda: result(computed))
        return found.value.speed, reused

    assert speed_of("one", SHARED, 1) == (1, False)
    assert speed_of("one", SHARED, 2) == (1, False)  # its own, after a restart
    assert speed_of("two", SHARED, 3) == (1, True)
    assert speed_of("three", SHARED, 4, fresh=True) == (4, False)
    assert speed_of("one", OWN, 5) == (5, False)
    assert speed_of("one", OWN, 6) == (5, False)
    assert speed_of("two", OWN, 7) == (7, False)
    assert database.finished_stages("two") == {"motion"}


def test_a_result_that_says_more_is_taken_where_there_is_none_of_its_own(database: Database, tmp_path: Path) -> None:
    alone = StageKey("c" * 64, also=(SHARED.digest,))

    def speed_of(job_id: str, key: StageKey, computed: float, **how: Any) -> tuple[float, bool]:
        found, reused = stored(step(database, tmp_path, job_id, **how), key, lambda: result(computed))
        return found.value.speed, reused

    assert speed_of("one", SHARED, 1) == (1, False)
    assert speed_of("two", alone, 2) == (1, True)
    assert speed_of("two", alone, 2) == (1, True)  # after a restart
    assert database.finished_stages("two") == {"motion"}
    assert speed_of("three", alone, 3, fresh=True) == (3, False)
    assert speed_of("four", alone, 4, owner="alice") == (4, False)
    assert speed_of("five", StageKey(alone.digest), 5) == (5, False)
    assert speed_of("six", alone, 6) == (5, True)  # its own first


def test_nothing_is_stored_for_a_job_that_was_canceled_meanwhile(database: Database, tmp_path: Path) -> None:
    def canceled() -> None:
        raise Canceled("The job was canceled.")

    with pytest.raises(Canceled):
        stored(step(database, tmp_path, "one", check=canceled), SHARED, lambda: result(1))
    assert database.find_result(SHARED.digest) is None
    assert database.finished_stages("one") == set()


def test_nothing_is_stored_for_a_job_that_was_deleted_meanwhile(database: Database, tmp_path: Path) -> None:
    store = step(database, tmp_path, "one")
    JobTable(database).delete(["one"])
    with pytest.raises(Canceled, match="was deleted"):
        stored(store, SHARED, lambda: result(1))
    assert database.find_result(SHARED.digest) is None
    with pytest.raises(Canceled, match="was deleted"):
        database.reuse_result("one", "grounding", ["0" * 64])


def test_servers_of_one_database_have_one_place_for_artifacts(tmp_path: Path) -> None:
    """Another one would take jobs whose images it does not have."""
    url = SecretStr(f"sqlite:///{tmp_path / 'shared.sqlite3'}")
    databases = [Database(Settings(data_dir=tmp_path / name, database_url=url)) for name in "ab"]
    for database in databases:
        database.create_tables()
    for _ in range(2):
        databases[0].claim("folder-1")
    with pytest.raises(StorageUnavailable, match="COW_DATA_DIR"):
        databases[1].claim("folder-2")
    databases[1].claim("folder-1")


@pytest.mark.parametrize("away", ["find_result", "store_results", "compute"])
def test_an_outage_is_waited_for(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, away: str
) -> None:
    """The work that is done is not done again."""
    left, computed, works = [3], [], getattr(database, away, None)

    def fail(*given: Any) -> Any:
        if left[0]:
            left[0] -= 1
            raise StorageUnavailable("The job database cannot be used.")
        return None if works is None else works(*given)

    def compute() -> StageResult[Any]:
        if away == "compute":
            fail()
        computed.append(1)
        return result(7)

    if works is not None:
        monkeypatch.setattr(database, away, fail)
    found, reused = stored(step(database, tmp_path, "one", budget=30), SHARED, compute)
    assert (found.value.speed, reused, len(computed), left) == (7, False, 1, [0])
    monkeypatch.undo()
    assert stored(step(database, tmp_path, "two"), SHARED, compute)[1]


def test_an_outage_without_end_fails_the_job_or_ends_with_it(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Any:
        raise StorageUnavailable("The job database cannot be used.")

    monkeypatch.setattr(database, "find_result", fail)
    with pytest.raises(StorageUnavailable):
        stored(step(database, tmp_path, "one", budget=0.3), SHARED, lambda: result(7))
    asked = []

    def canceled() -> None:
        asked.append(1)
        if len(asked) > 3:
            raise Canceled("The job was canceled.")

    with pytest.raises(Canceled):
        stored(step(database, tmp_path, "one", budget=30, check=canceled), SHARED, lambda: result(7))
