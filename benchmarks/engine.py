"""Measures what the job engine adds: a job through it, beside the same request through the service alone.

    python benchmarks/engine.py [--runs N] [--database URL] [--json FILE]

Both do the same work in turn, so that a slow moment of the machine meets both: reading and drawing of an example with
three frames, nothing found again. The difference of the medians is what the engine costs per job.
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

from cow_service.images import DecodedImage
from cow_service.jobs.engine import Engine, new_job_id
from cow_service.jobs.orders import Order
from cow_service.pipeline import now
from cow_service.requests import ImageArtifact, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "ball-and-mug"


class Bench:
    """One engine, one image, one question."""

    def __init__(self, folder: Path, database: str | None) -> None:
        given: dict[str, Any] = {"database_url": database} if database else {}
        self.service = Service(Settings(data_dir=folder, **given))
        self.engine = Engine(self.service)
        self.engine.start()
        artifact, self.image = self.service.keep_image((EXAMPLE / "image.jpg").read_bytes())
        question = json.loads((EXAMPLE / "meta.json").read_text())["question"]
        self.request = SimulateRequest(image=ImageArtifact(artifact=artifact.sha256), question=question, video=False)

    def alone(self) -> None:
        """The request without an engine, to its result as JSON."""
        self.service.simulate(self.request, image=_again(self.image)).model_dump_json()

    def through_engine(self) -> None:
        """The request as a job that takes nothing from others, until its result is there."""
        asyncio.run(self._job())

    async def _job(self) -> None:
        job_id = new_job_id(None, None)
        asked = self.request.model_dump(mode="json", exclude_defaults=True)
        order = Order(kind="simulate", request=asked, created_at=now(), fresh=True)
        with self.engine.live.waiting(job_id) as waiting:
            submit = (order, "cutout", None, None, _again(self.image), job_id)
            await asyncio.to_thread(self.engine.submit, *submit)
            outcome = await waiting.settled
        assert isinstance(outcome, str), outcome


def _again(image: DecodedImage) -> DecodedImage:
    """The same image, of which nothing has been looked at yet."""
    return DecodedImage(**{name: getattr(image, name) for name in image.__dataclass_fields__})


def _seconds(work: Callable[[], None]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=60)
    parser.add_argument("--database", help="postgresql://...; by default SQLite")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), given.database)
        pairs: list[tuple[float, float]] = []
        for turn in range(given.runs + 3):
            order = (bench.alone, bench.through_engine) if turn % 2 else (bench.through_engine, bench.alone)
            times = {work.__name__: 1000 * _seconds(work) for work in order}
            if turn >= 3:
                pairs.append((times["alone"], times["through_engine"]))
        bench.engine.close()
    alone, engine = ([pair[i] for pair in pairs] for i in (0, 1))
    told = {
        "database": "postgresql" if given.database else "sqlite",
        "runs": given.runs,
        "alone_p50_ms": round(statistics.median(alone), 1),
        "engine_p50_ms": round(statistics.median(engine), 1),
        "added_p50_ms": round(statistics.median(b - a for a, b in pairs), 1),
        "added_by_medians_ms": round(statistics.median(engine) - statistics.median(alone), 1),
    }
    print(json.dumps(told, indent=1))
    if given.json:
        given.json.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
