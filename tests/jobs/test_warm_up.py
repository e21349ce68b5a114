"""A server warms up behind its start, and nothing of the warm-up stays."""

from __future__ import annotations

import logging
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from cow_service.jobs import readiness as warming
from cow_service.jobs.readiness import Readiness
from cow_service.service import Service
from cow_service.settings import Settings

LOADED = """
import sys
from pathlib import Path
from cow_service.settings import Settings
from cow_service.jobs.readiness import warm_up
warm_up(Settings(data_dir=Path(sys.argv[1])))
from cow_service.readers.embedded.english import grammar as parsing
print(parsing._grammar.cache_info().currsize, *(f"cow_service.{name}" in sys.modules for name in (
    "readers.embedded.reader", "generators.cutout.generator", "media.video")))
"""


def test_all_that_the_first_request_needs_is_there_and_nothing_is_kept(tmp_path: Path) -> None:
    command = [sys.executable, "-c", LOADED, str(tmp_path / "data")]
    told = subprocess.run(command, capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["1", "True", "True", "True"], told.stderr
    assert not (tmp_path / "data").exists()


def test_a_failure_is_told_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(warming, "QUESTION", "What?")  # it names nothing that moves
    with caplog.at_level(logging.WARNING, "cow_service"):
        warming.warm_up(Settings(data_dir=tmp_path))
    assert "the warm-up failed" in caplog.text


def test_it_is_ready_before_it_is_warm_and_warms_up_once(service: Service) -> None:
    warm, begun = threading.Event(), threading.Semaphore(0)

    def warm_up() -> None:
        begun.release()
        warm.wait(10)

    readiness = Readiness(service, lambda: None, warm_up)
    readiness.start()
    readiness.wait(10)
    readiness.check()
    assert begun.acquire(timeout=10)
    readiness.check()
    warm.set()
    readiness.end()
    assert not begun.acquire(blocking=False), "once, and not whenever readiness is asked for"


def test_a_process_does_not_end_in_the_middle_of_it(service: Service) -> None:
    warm, begun, ended = threading.Event(), threading.Event(), threading.Event()

    def warm_up() -> None:
        begun.set()
        warm.wait(10)

    readiness = Readiness(service, lambda: None, warm_up)
    readiness.start()
    begun.wait(10)
    threading.Thread(target=lambda: (readiness.end(), ended.set())).start()
    assert not ended.wait(0.05)
    warm.set()
    assert ended.wait(10)
