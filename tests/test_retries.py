"""Callers are told of a database that is away; jobs wait for it."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from dbos import _dbos as dbos_instances  # pyright: ignore[reportPrivateUsage]
from engines import running_engine

from cow_service.errors import ShuttingDown, StorageUnavailable
from cow_service.jobs.retries import _Retries, without_retries  # pyright: ignore[reportPrivateUsage]
from cow_service.jobs.state import JobFilters
from cow_service.jobs.storage_check import StorageCheck
from cow_service.media.disk_artifacts import DiskArtifacts


def test_only_the_thread_that_answers_a_caller_does_not_wait() -> None:
    retries, seen = _Retries(), {}

    @without_retries
    def inner() -> None:
        seen["inner"] = bool(retries)

    @without_retries
    def answering() -> None:
        inner()
        seen["after"] = bool(retries)
        thread = threading.Thread(target=lambda: seen.update(job=bool(retries)))
        thread.start()
        thread.join()

    answering()
    assert seen == {"inner": False, "after": False, "job": True}
    assert retries


def test_dbos_asks_the_thread_whether_to_wait() -> None:
    assert running_engine().is_running
    database = dbos_instances._get_dbos_instance()._sys_db  # pyright: ignore[reportPrivateUsage]
    assert isinstance(database._retry_connection_errors, _Retries)  # pyright: ignore[reportPrivateUsage]


def test_who_waits_for_a_job_is_told_of_a_store_that_is_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cow_service.jobs.storage_check.MAX_AGE_SECONDS", 0.0)
    folder = tmp_path / "artifacts"
    check = StorageCheck(lambda: DiskArtifacts(folder))
    check.check()
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    folder.write_text("in its place")
    with pytest.raises(StorageUnavailable, match=r"cannot be used .* The job goes on when that is over"):
        check.check()
    folder.unlink()
    check.check()


def test_who_asks_while_the_server_ends_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = running_engine()
    monkeypatch.setattr(dbos_instances, "_dbos_global_instance", None)  # as after `DBOS.destroy`
    for asking in (lambda: engine.find("job", None), lambda: engine.page(None, JobFilters())):
        with pytest.raises(ShuttingDown, match="is stopping"):
            asking()
