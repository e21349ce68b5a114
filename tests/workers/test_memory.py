"""What jobs will take of the memory, and how the workers of one server share it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from servers import BODY, Served, problem, slow
from waiting import eventually

from cow_service.jobs.computing import Work
from cow_service.jobs.job_table import JobSpec, TakenJob
from cow_service.media.artifacts import DiskArtifacts
from cow_service.media.images import encode_png
from cow_service.records import Artifact
from cow_service.requests import ImageArtifact
from cow_service.settings import WORKER_BYTES, Settings
from cow_service.workers.pool import BYTES_PER_PIXEL, memory_for_jobs, memory_needed


def needed(store: DiskArtifacts, image: str, **request: Any) -> float:
    """MB of a job."""
    asked = {**BODY, "image": ImageArtifact(artifact=image).model_dump(), **request}
    spec = JobSpec(kind="simulate", request=asked, reader="embedded", generator="cutout", created_at="")
    work = Work(TakenJob("a", spec, None, "light", "a"), *cast("Any", (None, None, None)))
    return memory_needed(work, store, Settings(max_image_megapixels=25)) / 1e6


def test_what_a_job_needs_follows_its_pixels_masks_and_frames(tmp_path: Path) -> None:
    store = DiskArtifacts(tmp_path)

    def kept(*shape: int) -> Artifact:
        return store.put(encode_png(np.zeros(shape, np.uint8)), "image/png")

    small, large = needed(store, kept(30, 40).sha256), needed(store, kept(3000, 4000, 3).sha256)
    assert small < 0.1
    assert large == pytest.approx(12 * BYTES_PER_PIXEL, rel=0.02)
    assert needed(store, "0" * 64) > 2 * large, "an image that is not there may be the largest"
    image = kept(3000, 4000, 3).sha256
    mask = {"object": "cube", "mask": {"artifact": kept(3000, 4000).sha256}}
    assert needed(store, image, objects=[mask]) > large + 20
    frames = {"indices": list(range(100)), "max_side": None}
    assert needed(store, image, num_frames=100, frames=frames) > large + 300


def test_what_is_left_for_jobs() -> None:
    assert memory_for_jobs(Settings(memory_mb=4000, concurrency=4)) == 4e9 - 5 * WORKER_BYTES
    assert memory_for_jobs(Settings(memory_mb=1000, concurrency=4)) == 1, "each runs alone"


@pytest.fixture(scope="module")
def tight(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server with two workers, whose memory is enough for one job."""
    own = {"COW_WORKERS": "true", "COW_CONCURRENCY": "2", "COW_MEMORY_MB": f"{3 * WORKER_BYTES / 1e6 + 1:g}"}
    with Served(tmp_path_factory.mktemp("tight"), COW_WARMUP="false", **own) as served:
        yield served


@pytest.mark.slow
def test_a_job_waits_until_its_memory_is_free(tight: Served) -> None:
    first, second = tight.submit(slow(100, seed=1)), tight.submit(slow(0.1, seed=2))
    eventually(lambda: tight.clips() == [1])
    assert tight.until(second["id"], "queued")["progress"] == 0
    tight.http.post(f"/jobs/{first['id']}/cancel")
    assert tight.ended(second["id"])["status"] == "succeeded"


@pytest.mark.slow
def test_the_job_that_takes_too_much_ends_where_no_worker_has_a_limit_of_its_own(tight: Served) -> None:
    greedy = {**slow(0.2, seed=3), "generator_options": {"seconds": 0.2, "end": "memory"}}
    told = problem(tight.http.post("/simulate", json=greedy), 500, "worker-ended")
    assert "all workers used" in told["detail"]
    assert tight.http.post("/simulate", json=slow(0.1, seed=4)).status_code == 200
