"""Starts on a job database that another server holds, or that is read-only, locked or pooled: who waits, who ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from command_line import cow_from_nothing
from postgres import postgres
from servers import BODY, Served, problem, slow
from waiting import eventually

pytestmark = pytest.mark.slow


@contextmanager
def started(folder: Path, url: str) -> Iterator[Served]:
    """A server that answers probes, and perhaps waits."""
    served = Served(folder, COW_DATABASE_URL=url)
    try:
        served.start("/livez")
        yield served
    finally:
        served.kill()


def test_a_second_server_on_a_folder_is_refused_whatever_a_cleaner_deletes(tmp_path: Path) -> None:
    with Served(tmp_path) as first:
        job = first.submit(slow(2.0))
        for one in first.data.rglob("*.lock"):
            one.unlink()
        own = {"COW_DATA_DIR": str(first.data), "COW_WARMUP": "false"}
        for command in (["serve", "--port", "0"], ["worker"]):
            second = cow_from_nothing(tmp_path, *command, **own)
            assert second.returncode == 2, second.stderr
            assert "COW_DATABASE_URL" in second.stderr
            assert "Traceback" not in second.stderr
        assert first.ended(job["id"])["status"] == "succeeded"
        assert len(first.clips()) == 1
        first.kill()
        first.start()
        assert first.submit(BODY)


def test_a_server_on_a_standby_waits_until_it_is_promoted(tmp_path: Path) -> None:
    with postgres() as database:
        database.set_read_only(True)
        with started(tmp_path, database.url) as served:
            told = problem(served.http.get("/readyz"), 503, "storage-unavailable")
            assert "read-only" in told["detail"]
            problem(served.http.post("/simulate", json=BODY), 503, "storage-unavailable")
            assert "read-only" in served.log()
            database.set_read_only(False)
            eventually(lambda: served.http.get("/readyz").is_success)
            job = served.submit(slow(1.0))["id"]
            served.rendering(job)
            database.set_read_only(True)  # as after a failover: its connections lead to what is a standby now
            eventually(lambda: "a job waits: The job database is read-only" in served.log())
            problem(served.http.post("/simulate", json=BODY | {"seed": 1}), 503, "storage-unavailable")
            assert "read-only" in problem(served.http.get("/readyz"), 503, "storage-unavailable")["detail"]
            database.set_read_only(False)
            assert served.ended(job)["status"] == "succeeded"


def test_a_server_waits_for_tables_that_another_session_has_locked(tmp_path: Path) -> None:
    with postgres() as database:
        with started(tmp_path, database.url) as served:
            eventually(lambda: served.http.get("/readyz").is_success)
            job = served.submit(slow(1.0))["id"]
            served.rendering(job)
            with database.locked_tables():
                told = problem(served.http.post("/simulate", json=BODY), 503, "storage-unavailable")
                assert "locked" in told["detail"]
                assert "locked" in problem(served.http.get("/readyz"), 503, "storage-unavailable")["detail"]
            assert served.ended(job)["status"] == "succeeded"
        with ExitStack() as lock:
            lock.enter_context(database.locked_tables())
            with started(tmp_path, database.url) as served:
                told = eventually(lambda: said if "locked" in (said := served.http.get("/readyz").text) else None)
                assert "storage-unavailable" in told
                assert "has tables that another session has locked" in served.log()
                lock.close()
                eventually(lambda: served.http.get("/readyz").is_success)
                assert served.submit(BODY)


def test_a_pool_that_gives_sessions_to_others_is_refused(tmp_path: Path) -> None:
    with postgres() as database:
        with database.pooled("transaction") as url:
            told = cow_from_nothing(tmp_path, "serve", "--port", "0", COW_DATABASE_URL=url, COW_WARMUP="false")
            assert told.returncode == 2
            assert "transaction mode" in told.stderr
            assert "Traceback" not in told.stderr
        with database.pooled("session") as url, started(tmp_path, url) as served:
            eventually(lambda: served.http.get("/readyz").is_success)
            assert served.ended(served.submit(BODY)["id"])["status"] == "succeeded"


@pytest.mark.parametrize("url", ["postgresql://cow@db:port/cow", "somewhere", "mysql://db/cow"])
def test_an_address_that_is_none_is_refused_and_not_repeated(tmp_path: Path, url: str) -> None:
    told = cow_from_nothing(tmp_path, "serve", "--port", "0", COW_DATABASE_URL=url)
    assert told.returncode == 2
    assert "COW_DATABASE_URL" in told.stderr
    assert url not in told.stderr
    assert "Traceback" not in told.stderr
