"""Measures the overhead of the job engine: a job against the same request through the service alone.

    python benchmarks/engine.py [--runs N] [--database URL] [--json FILE]

Both do the same work in turn, so that a slow moment of the machine meets both: a small image with box and direction
given, three frames, nothing found again. What the engine costs does not hang on how long the work takes, and is a small
part of it: little work shows it best. Time that passed hangs on what else the machine does; computed time does not.
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

from cow_service.jobs.engine import JobEngine, new_job_id
from cow_service.jobs.job_table import JobSpec
from cow_service.media.images import encode_png
from cow_service.requests import ImageArtifact, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.stages.run import now


class Bench:
    """One engine, one image, one question."""

    def __init__(self, folder: Path, database: str | None) -> None:
        url: dict[str, Any] = {"database_url": database} if database else {}
        self.service = Service(Settings(data_dir=folder, **url))
        self.engine = JobEngine(self.service)
        self.engine.start()
        self._loop = asyncio.new_event_loop()
        pixels = np.full((64, 96, 3), 200, np.uint8)
        pixels[20:40, 10:30] = (200, 30, 30)
        artifact = self.service.keep_image(encode_png(pixels))
        given = {
            "grounding": {"bbox": [10, 20, 30, 40]},
            "motion": {"direction": [1, 0]},
            "num_frames": 9,
            "video": False,
        }
        asked = {"image": ImageArtifact(artifact=artifact.sha256), "question": "If it moves, what happens?", **given}
        self.request = SimulateRequest.model_validate(asked)

    def alone(self) -> None:
        """The request without an engine, to its result as JSON."""
        self.service.simulate(self.request).model_dump_json()

    def through_engine(self) -> None:
        """The request as a job that takes nothing from others, until its result is there."""
        self._loop.run_until_complete(self._job())

    async def _job(self) -> None:
        job_id = new_job_id(None, None)
        asked = self.request.model_dump(mode="json", exclude_defaults=True)
        spec = JobSpec(
            kind="simulate", request=asked, reader="embedded", generator="cutout", created_at=now(), fresh=True
        )
        with self.engine.active.waiting(job_id) as waiter:
            await asyncio.to_thread(self.engine.submit, job_id, spec, None, None, lambda: None)
            await waiter.ended.wait()
        assert waiter.refusal is None, waiter.refusal
        assert self.engine.find(job_id, None).result is not None


def _measured(work: Callable[[], None]) -> tuple[float, float]:
    """Milliseconds that passed, and that this process computed, all threads together."""
    passed, computed = time.perf_counter(), time.process_time()
    work()
    return 1000 * (time.perf_counter() - passed), 1000 * (time.process_time() - computed)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--database", help="postgresql://...; by default SQLite")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), given.database)
        found: dict[str, list[tuple[float, float]]] = {"alone": [], "engine": []}
        for turn in range(given.runs + 3):
            works = (("alone", bench.alone), ("engine", bench.through_engine))
            for name, work in works if turn % 2 else works[::-1]:
                measured = _measured(work)
                if turn >= 3:
                    found[name].append(measured)
        bench.engine.close()
    told: dict[str, Any] = {"database": "postgresql" if given.database else "sqlite", "runs": given.runs}
    for name, place in (("passed", 0), ("computed", 1)):
        added = [job[place] - plain[place] for plain, job in zip(found["alone"], found["engine"], strict=True)]
        for who, times in found.items():
            told[f"{who}_{name}_p50_ms"] = round(statistics.median(time[place] for time in times), 1)
        told[f"added_{name}_p50_ms"] = round(statistics.median(added), 1)
    print(json.dumps(told, indent=1))
    if given.json:
        given.json.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
