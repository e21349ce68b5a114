"""A server that is killed again and again loses nothing that it acknowledged, and does nothing twice."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT, SCALE
from postgres import postgres_server

sys.path.insert(0, str(ROOT / "benchmarks"))

from crash import Report, crash

pytestmark = [pytest.mark.slow, pytest.mark.soak, pytest.mark.timeout(600 * SCALE)]
JOBS, KILLS = 6 * SCALE, 2 * SCALE


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest) -> Iterator[str | None]:
    if request.param == "sqlite":
        yield None
        return
    if SCALE == 1:
        pytest.skip("kills on PostgreSQL are tested in `make soak`; recovery on it is in test_job_table.py")
    with postgres_server() as url:
        yield url


def test_nothing_acknowledged_is_lost(database: str | None, tmp_path: Path) -> None:
    report: Report = crash(JOBS, KILLS, database, seed=20, folder=tmp_path)
    assert report.acknowledged == JOBS
    assert report.outcomes == {"succeeded": JOBS}
    assert report.lost == report.wrong_results == []
    assert report.redone == [], "clips that the database held were made again"
    assert report.begun_twice > 0, "no kill cut off a clip: the test shows nothing"
    assert report.corrupt == report.missing == []
    # How fast they are is a figure of the benchmark, not of this test.
    assert len(report.back_at_work_s) >= KILLS // 2, "too few jobs went on after a kill"
