"""Stored stage results, on a real database: who finds them again, and what is never stored."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from job_rows import add_job, open_database
from pydantic import SecretStr
from refusals import refused
from waiting import TIME_LIMIT

from cow_service.errors import Canceled, StorageUnavailable
from cow_service.jobs.computing import KeyLocks, Outages, StoredStep
from cow_service.jobs.database import Database
from cow_service.jobs.job_table import JobTable
from cow_service.media.artifacts import DiskArtifacts
from cow_service.observability.metrics import Metrics
from cow_service.records import MetresPerPixel, Motion
from cow_service.settings import SettingsError
from cow_service.stages.keys import FirstAnswers, StageKey, StageResult

SHARED, OWN = StageKey("a" * 64), StageKey("b" * 64, shareable=False)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    with closing(open_database(tmp_path)) as database:
        yield database


def step(
    database: Database,
    job_id: str,
    owner: str | None = None,
    fresh: bool = False,
    check: Callable[[], None] = lambda: None,
    budget: float = 0,
) -> StoredStep:
    add_job(database, job_id, owner)
    artifacts, outages = DiskArtifacts(Path(database.engine.url.database or "").parent), Outages(budget, check)
    return StoredStep(job_id, owner, fresh, database, artifacts, Metrics().stage_cache, KeyLocks().held, outages)


def stored(store: StoredStep, key: StageKey, compute: Callable[[], StageResult[Any]]) -> tuple[float, bool]:
    """The speed that a job has which has only this stage, and whether another job had computed it."""
    found, reused = store("motion", key, compute)
    store.flush()
    return found.value.speed, reused


def result(speed: float) -> StageResult[Any]:
    scale = MetresPerPixel(value=0.01, source="default")
    motion = Motion(
        kind="static", direction=None, cue="text", speed=speed, metres_per_pixel=scale, sentence="", source="request"
    )
    return StageResult(value=motion)


def speed_of(database: Database, job_id: str, key: StageKey, computed: float, **how: Any) -> tuple[float, bool]:
    return stored(step(database, job_id, **how), key, lambda: result(computed))


def test_nobody_finds_what_another_key_asked(database: Database) -> None:
    owners = ["alice", "bob", None, "alice", None]
    found = [speed_of(database, str(n), SHARED, n, owner=owner) for n, owner in enumerate(owners)]
    assert found == [(0, False), (1, False), (2, False), (0, True), (2, True)]


def test_a_stage_beside_others_holds_no_key_and_is_stored(database: Database) -> None:
    """A job holds one key at a time, so what is computed beside has none: neither waits for the other."""
    at_once, locks = threading.Barrier(2), KeyLocks()
    alone = StageResult(value=FirstAnswers(verdict=None, asked=1))

    def held(key: str, check: Callable[[], None]) -> AbstractContextManager[None]:
        return locks.held("any key of this job", check)

    def computed(found: StageResult[Any]) -> StageResult[Any]:
        at_once.wait(TIME_LIMIT)
        return found

    one = replace(step(database, "one"), hold_key=held)
    with ThreadPoolExecutor() as threads:
        beside = threads.submit(one, "baseline", OWN, lambda: computed(alone))
        one("motion", SHARED, lambda: computed(result(1)))
        beside.result()
    one.flush()
    again = replace(one, waiting=[])
    assert again("baseline", OWN, lambda: pytest.fail("asked again")) == (alone, False)
    assert stored(again, SHARED, lambda: pytest.fail("computed again")) == (1, False)


def test_a_result_is_found_by_other_jobs_only_where_it_may_be(database: Database) -> None:
    assert speed_of(database, "one", SHARED, 1) == (1, False)
    assert speed_of(database, "one", SHARED, 2) == (1, False)  # its own, after a restart
    assert speed_of(database, "two", SHARED, 3) == (1, True)
    assert speed_of(database, "three", SHARED, 4, fresh=True) == (4, False)
    assert speed_of(database, "one", OWN, 5) == (5, False)
    assert speed_of(database, "one", OWN, 6) == (5, False)
    assert speed_of(database, "two", OWN, 7) == (7, False)
    assert database.finished_stages("two") == {"motion"}


def test_a_result_that_says_more_is_taken_where_there_is_none_of_its_own(database: Database) -> None:
    alone = StageKey("c" * 64, also=(SHARED.digest,))
    assert speed_of(database, "one", SHARED, 1) == (1, False)
    assert speed_of(database, "two", alone, 2) == (1, True)
    assert speed_of(database, "two", alone, 2) == (1, True)  # after a restart
    assert database.finished_stages("two") == {"motion"}
    assert speed_of(database, "three", alone, 3, fresh=True) == (3, False)
    assert speed_of(database, "four", alone, 4, owner="alice") == (4, False)
    assert speed_of(database, "five", StageKey(alone.digest), 5) == (5, False)
    assert speed_of(database, "six", alone, 6) == (5, True)  # its own first


def test_nothing_is_stored_for_a_job_that_was_canceled_or_deleted_meanwhile(database: Database) -> None:
    def canceled() -> None:
        raise Canceled("The job was canceled.")

    with pytest.raises(Canceled):
        speed_of(database, "one", SHARED, 1, check=canceled)
    assert database.finished_stages("one") == set()
    store = step(database, "two")
    JobTable(database).cancel("two")
    JobTable(database).delete(["two"])
    with pytest.raises(Canceled):
        stored(store, SHARED, lambda: result(1))
    assert database.find_result(SHARED.digest) is None
    with pytest.raises(Canceled):
        database.reuse_result("two", "grounding", ["0" * 64])


def test_servers_of_one_database_have_one_place_for_artifacts(tmp_path: Path) -> None:
    """Another one would take jobs whose images it does not have."""
    url = SecretStr(f"sqlite:///{tmp_path / 'shared.sqlite3'}")
    with closing(open_database(tmp_path, url)) as one, closing(open_database(tmp_path, url)) as other:
        for _ in range(2):
            one.claim("folder-1")
        with pytest.raises(SettingsError, match="folder-1"):
            other.claim("folder-2")
        other.claim("folder-1")


@pytest.mark.parametrize("away", ["find_result", "store_results", "compute"])
def test_an_outage_is_waited_for(database: Database, monkeypatch: pytest.MonkeyPatch, away: str) -> None:
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
    assert stored(step(database, "one", budget=TIME_LIMIT), SHARED, compute) == (7, False)
    assert (len(computed), left) == (1, [0])
    monkeypatch.undo()
    assert stored(step(database, "two"), SHARED, compute) == (7, True)


def test_an_outage_without_end_fails_the_job_or_ends_with_it(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Any:
        raise StorageUnavailable("The job database cannot be used.")

    monkeypatch.setattr(database, "find_result", fail)
    with refused("storage-unavailable"):
        speed_of(database, "one", SHARED, 7, budget=0.3)
    asked = []

    def canceled() -> None:
        asked.append(1)
        if len(asked) > 3:
            raise Canceled("The job was canceled.")

    with pytest.raises(Canceled):
        speed_of(database, "one", SHARED, 7, budget=TIME_LIMIT, check=canceled)
