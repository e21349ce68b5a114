"""While a store is down, callers get an error and jobs wait."""

from __future__ import annotations

from pathlib import Path

import pytest

from cow_service.errors import StorageUnavailable
from cow_service.jobs.readiness import StorageCheck
from cow_service.media.artifacts import DiskArtifacts


def test_who_waits_for_a_job_is_told_of_a_store_that_is_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cow_service.jobs.readiness.MAX_AGE_SECONDS", 0.0)
    folder = tmp_path / "artifacts"
    check = StorageCheck(lambda: DiskArtifacts(folder))
    check.check()
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    folder.write_text("in its place")
    with pytest.raises(StorageUnavailable, match=r"cannot be used .* The job continues when that is fixed"):
        check.check()
    folder.unlink()
    check.check()
