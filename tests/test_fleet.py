"""Servers and workers without a shared folder lose nothing and do nothing wrong, whatever happens to them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from conftest import ROOT, SCALE
from object_store import serving
from postgres import postgres_server

sys.path.insert(0, str(ROOT / "benchmarks"))

from fleet import fleet

pytestmark = [pytest.mark.slow, pytest.mark.soak, pytest.mark.timeout(1800)]


@pytest.mark.skipif(SCALE == 1, reason="ten minutes of kills are for `make soak`")
def test_a_fleet_that_is_killed_and_frozen_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with postgres_server() as database, serving() as store:
        for name, value in store.environment.items():
            monkeypatch.setenv(name, value)
        report = fleet(database, store.url, seconds=60.0 * SCALE, seed=3, folder=tmp_path)
    assert report.acknowledged > 5 * SCALE
    assert report.outcomes == {"succeeded": report.acknowledged}, report.problems
    assert report.wrong_results == report.corrupt == []
    assert report.begun_twice > 0, "nothing was cut off: the test shows nothing"
