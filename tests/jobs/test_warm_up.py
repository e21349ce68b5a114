"""A server warms up behind its start, and nothing of the warm-up stays. It looks whether its store is there."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from refusals import refused
from waiting import TIME_LIMIT

from cow_service.jobs import readiness as warming
from cow_service.jobs.readiness import Readiness, StorageCheck
from cow_service.media.artifacts import DiskArtifacts
from cow_service.service import Service
from cow_service.settings import Settings

LOADED = """
import sys
from pathlib import Path
from cow_service.settings import Settings
from cow_service.jobs.readiness import warm_up
warm_up(Settings(data_dir=Path(sys.argv[1])))
print(*(f"cow_service.{name}" in sys.modules for name in (
    "readers.embedded.english.questions", "generators.cutout.generator", "media.video")))
"""


@pytest.mark.slow
def test_all_that_the_first_request_needs_is_there_and_nothing_is_kept(tmp_path: Path) -> None:
    command = [sys.executable, "-c", LOADED, str(tmp_path / "data")]
    told = subprocess.run(command, capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["True"] * 3, told.stderr
    assert not (tmp_path / "data").exists()


def test_a_failure_is_told_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(warming, "QUESTION", "What?")  # it names nothing that moves
    with caplog.at_level(logging.WARNING, "cow_service"):
        warming.warm_up(Settings(data_dir=tmp_path))
    assert [record.levelname for record in caplog.records if record.funcName == "warm_up"] == ["WARNING"]


def test_it_is_ready_before_it_is_warm_and_warms_up_once_until_the_process_may_end(service: Service) -> None:
    warm, begun, ended = threading.Event(), threading.Semaphore(0), threading.Event()

    def warm_up() -> None:
        begun.release()
        warm.wait(TIME_LIMIT)

    readiness = Readiness(service, lambda: None, warm_up)
    readiness.start()
    readiness.wait(TIME_LIMIT)
    readiness.check()
    assert begun.acquire(timeout=TIME_LIMIT)
    readiness.check()
    ending = threading.Thread(target=lambda: (readiness.end(), ended.set()))
    ending.start()
    assert not ended.wait(0.05), "a process does not end in the middle of it"
    warm.set()
    ending.join(TIME_LIMIT)
    assert ended.is_set()
    assert not begun.acquire(blocking=False), "once, and not whenever readiness is asked for"


def test_who_waits_for_a_job_is_told_of_a_store_that_is_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warming, "MAX_AGE_SECONDS", 0.0)
    folder = tmp_path / "artifacts"
    check = StorageCheck(DiskArtifacts(folder))
    check.check()
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    folder.write_text("in its place")
    with refused("storage-unavailable"):
        check.check()
    monkeypatch.setattr(warming, "MAX_AGE_SECONDS", TIME_LIMIT)
    folder.unlink()
    with refused("storage-unavailable"):  # what was found is given out again for a while
        check.check()
    monkeypatch.setattr(warming, "MAX_AGE_SECONDS", 0.0)
    check.check()
