"""Measures the cost of one clean-up of artifacts, by their number: seconds, memory, and deletions a second.

    python benchmarks/sweep.py [--names 10000000] [--database postgresql://...] [--json FILE]

The store is a simulation that generates names and counts what is deleted, without the time that a real one takes to
answer. The database is real. One artifact of ten has no reference and is removed; then a budget removes a tenth of all,
the longest unused, in two listings. Memory is what the process (its resident set) grows by, sampled at each deletion.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import psutil
import sqlalchemy as sa

from cow_service.jobs.cleaning import UNREFERENCED_GRACE_SECONDS, collect_artifacts
from cow_service.jobs.database import Database
from cow_service.jobs.job_table import JobSpec, JobTable
from cow_service.jobs.opening import open_database
from cow_service.media.artifacts import DiskArtifacts, ListedArtifact
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.stages.run import now as time_text

LOOSE_EVERY = 10  # one in so many artifacts has no reference
SIZE = 100_000  # bytes of each
DIGITS = 15  # of a name's number: with the rest of a digest's digits it sorts as text
OLDEST = 7 * 24 * 3600.0  # s, since the first one was used


class GeneratedArtifacts(DiskArtifacts):
    """So many artifacts, of evenly spread ages and in the order of their names, as S3 lists them."""

    def __init__(self, folder: Path, names: int, now: float) -> None:
        super().__init__(folder)
        self._names, self._now = names, now
        self.listings = self.deleted = self.peak = 0
        self._process = psutil.Process()

    def listed(self) -> Iterator[ListedArtifact]:
        """Names and ages; those of the first listing that were deleted are there again."""
        self.listings += 1
        for number in range(self._names):
            # Neighbours by name are not neighbours by age.
            age = UNREFERENCED_GRACE_SECONDS + OLDEST * (number * 7919 % self._names) / self._names
            yield ListedArtifact(f"{number:0{DIGITS}x}".ljust(64, "0"), SIZE, self._now - age)

    def delete(self, artifacts: Collection[str], untouched_since: float) -> set[str]:
        """Counts them."""
        self.deleted += len(artifacts)
        self.peak = max(self.peak, self._process.memory_info().rss)
        return set(artifacts)


def fill(database: Database, names: int) -> None:
    """References to all artifacts but one of `LOOSE_EVERY`, as of one job that has ended."""
    database.create_tables()
    request = {"image": {"artifact": "f" * 64}, "question": "?"}
    asked: dict[str, Any] = {"kind": "simulate", "reader": "embedded", "generator": "cutout"}
    JobTable(database).add("job", JobSpec(**asked, request=request, created_at=time_text()), None, "light", 1)
    JobTable(database).cancel("job")
    series = (
        f"SELECT generate_series(0, {names - 1}) AS n"
        if database.is_shared
        else f"SELECT 0 AS n UNION ALL SELECT n + 1 FROM numbers WHERE n < {names - 1}"
    )
    name = (
        f"rpad(lpad(to_hex(n), {DIGITS}, '0'), 64, '0')"
        if database.is_shared
        else f"printf('%0{DIGITS}x', n) || '{'0' * (64 - DIGITS)}'"
    )
    with database.transaction() as connection:
        if database.is_shared:
            connection.execute(sa.text("SET LOCAL statement_timeout = 0"))
        connection.execute(
            sa.text(
                f"WITH RECURSIVE numbers AS ({series}) INSERT INTO cow_references (sha256, job_id) "
                f"SELECT {name}, 'job' FROM numbers WHERE n % {LOOSE_EVERY} > 0"
            )
        )


def measure(database: Database, folder: Path, names: int, max_gb: float | None) -> dict[str, Any]:
    """One clean-up."""
    now = time.time()
    store = GeneratedArtifacts(folder, names, now)
    service = SimpleNamespace(artifacts=store, settings=Settings(data_dir=folder, artifacts_max_gb=max_gb))
    before, started, cpu = psutil.Process().memory_info().rss, time.perf_counter(), time.process_time()
    collect_artifacts(cast(Service, service), database, lambda: False, now)
    seconds = time.perf_counter() - started
    return {
        "names": names,
        "database": database.engine.dialect.name,
        "budget": max_gb is not None,
        "listings": store.listings,
        "seconds": round(seconds, 1),
        "cpu_seconds": round(time.process_time() - cpu, 1),
        "peak_mb": round(max(0, store.peak - before) / 1e6, 1),
        "deleted": store.deleted,
        "deleted_per_second": round(store.deleted / seconds),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", type=int, default=10_000_000)
    parser.add_argument("--database", help="postgresql://...; by default SQLite")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    url: dict[str, Any] = {"database_url": given.database} if given.database else {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        database = open_database(Settings(data_dir=folder, **url))
        fill(database, given.names)
        kept = 1 - 1 / LOOSE_EVERY
        budgets = None, given.names * SIZE * (kept - 0.1) / 1e9
        rows = [measure(database, folder, given.names, max_gb) for max_gb in budgets]
        database.close()
    for row in rows:
        print(json.dumps(row))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
