"""Measures the cost of stored jobs: lists of them and clean-up, by their number.

    python benchmarks/jobs.py [--jobs 0,1000,10000,100000] [--database postgresql://...] [--json FILE]

The rows of one real job that succeeded and of one that failed are copied: of a hundred jobs one has failed.
Milliseconds are medians of `GET /jobs` in this process, without HTTP. Tidying is CPU seconds of one round that finds
nothing to remove, as one server makes every ten minutes. The files of artifacts are not copied: all copies refer to the
same.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import sqlalchemy as sa

from cow_service.jobs.cleaning import collect_artifacts, remove_old_jobs
from cow_service.jobs.engine import JobEngine, new_job_id
from cow_service.jobs.job_table import JobFilters, JobSpec
from cow_service.media.images import encode_png
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.stages.run import now

FAILED_EVERY = 100
# Their keys; the last one is that of the job.
TABLES = {
    "cow_jobs": ("id",),
    "cow_results": ("key", "job_id"),
    "cow_trajectories_of_jobs": ("job_id",),
    "cow_references": ("job_id",),
    "cow_stages_of_jobs": ("job_id",),
}
GIVEN: dict[str, Any] = {"grounding": {"bbox": [10, 20, 30, 40]}, "num_frames": 9, "video": False}


def run_job(engine: JobEngine, image: str, motion: dict[str, Any]) -> str:
    """One job to its end; its id."""
    asked = {
        "image": {"artifact": image},
        "question": "If it moves, what happens?",
        "motion": motion,
        **GIVEN,
    }
    job_id = new_job_id(None, None)
    spec = JobSpec(kind="simulate", request=asked, reader="embedded", generator="cutout", created_at=now())

    async def ended() -> None:
        with engine.active.waiting(job_id) as waiter:
            await asyncio.to_thread(engine.submit, job_id, spec, None, None, lambda: None)
            await waiter.ended.wait()

    asyncio.run(ended())
    return job_id


def copies(engine: sa.Engine, job: str, first: int, count: int, step_ms: int) -> None:
    """Copies all rows of a job, each a little older than the one before."""
    is_postgres = engine.dialect.name == "postgresql"
    series = (
        f"SELECT generate_series({first}, {first + count - 1}) AS n"
        if is_postgres
        else f"SELECT {first} AS n UNION ALL SELECT n + 1 FROM numbers WHERE n < {first + count - 1}"
    )
    older = (
        f"to_char(CAST(t.created_at AS timestamptz) AT TIME ZONE 'UTC' - numbers.n * interval '{step_ms} ms', "
        """'YYYY-MM-DD"T"HH24:MI:SS.MS"Z"')"""
        if is_postgres
        else f"strftime('%Y-%m-%dT%H:%M:%fZ', t.created_at, '-' || (numbers.n * {step_ms / 1000}) || ' seconds')"
    )
    inspector = sa.inspect(engine)
    with engine.begin() as connection:
        for table, keys in TABLES.items():
            columns = [column["name"] for column in inspector.get_columns(table)]
            told: list[str] = []
            for column in columns:
                if column in keys:  # a digest's last digits give way: it has as many as the column holds
                    kept = f"substr(t.{column}, 1, 63 - length(CAST(numbers.n AS TEXT)))"
                    told.append(f"{kept} || '-' || numbers.n")
                elif (table, column) == ("cow_jobs", "created_at"):
                    told.append(older)
                elif column == "ended":
                    told.append(f"t.ended - {step_ms / 1000} * numbers.n")
                else:
                    told.append(f"t.{column}")
            connection.execute(
                sa.text(
                    f"WITH RECURSIVE numbers AS ({series}) INSERT INTO {table} ({', '.join(columns)}) "
                    f"SELECT {', '.join(told)} FROM {table} t, numbers WHERE t.{keys[-1]} = :job"
                ),
                {"job": job},
            )
        if is_postgres:  # as it would have done by itself within a minute
            connection.execute(sa.text("ANALYZE"))


def timed(work: Callable[[], object], runs: int = 7) -> float:
    """Median milliseconds after one call that is not counted."""
    work()
    times: list[float] = []
    for _ in range(runs):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return round(1000 * statistics.median(times), 2)


def measure(engine: JobEngine, counts: list[int]) -> list[dict[str, Any]]:
    """A row for each number of jobs."""
    pixels = np.full((64, 96, 3), 200, np.uint8)
    pixels[20:40, 10:30] = (200, 30, 30)
    image = engine.service.keep_image(encode_png(pixels)).sha256
    good = run_job(engine, image, {"direction": [1, 0]})
    bad = run_job(engine, image, {})  # the question tells no direction
    rows: list[dict[str, Any]] = []
    own = sa.create_engine(engine.database.engine.url)  # the engine's own connections are ended after seconds
    made = 2
    for count in counts:
        more = max(0, count - made)
        if more:
            failed = max(1, more // FAILED_EVERY)
            copies(own, bad, made, failed, 20 * FAILED_EVERY)
            copies(own, good, made + failed, more - failed, 20)
            made += more
        rows.append(
            {
                "jobs": made,
                "page_ms": timed(lambda: engine.page(None, JobFilters())),
                "failed_ms": timed(lambda: engine.page(None, JobFilters(status=["failed"]))),
                "succeeded_ms": timed(lambda: engine.page(None, JobFilters(status=["succeeded"]))),
                "running_ms": timed(lambda: engine.page(None, JobFilters(status=["running"]))),
                "answers_ms": timed(lambda: engine.page(None, JobFilters(kind="answer"))),
                "failed_simulations_ms": timed(
                    lambda: engine.page(None, JobFilters(kind="simulate", status=["failed", "canceled"]))
                ),
                "one_ms": timed(lambda: engine.find(good, None)),
            }
        )

        def tidy() -> None:
            remove_old_jobs(engine._parts, lambda: False)  # pyright: ignore[reportPrivateUsage]
            collect_artifacts(engine.service, engine.database, lambda: False)

        tidy()  # the first round after such a change of the tables is not typical
        started = time.process_time()
        tidy()
        rows[-1]["tidying_cpu_s"] = round(time.process_time() - started, 3)
        print(json.dumps(rows[-1]), flush=True)
    return rows


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", default="0,1000,10000,100000")
    parser.add_argument("--database", help="postgresql://...; by default SQLite")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    url: dict[str, Any] = {"database_url": given.database} if given.database else {}
    with tempfile.TemporaryDirectory() as folder:
        engine = JobEngine(Service(Settings(data_dir=Path(folder), **url)))
        engine.start()
        rows = measure(engine, [int(count) for count in given.jobs.split(",")])
        engine.close()
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
