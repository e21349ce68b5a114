"""Runs of the pipeline without a service: an image in memory, a request, and backends that are not expected to load."""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cow_service.concurrency import PrioritySemaphore
from cow_service.media.artifacts import DiskArtifacts
from cow_service.media.images import DecodedImage
from cow_service.perception.base import Perception
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import ImageInfo
from cow_service.requests import SimulateRequest
from cow_service.settings import Settings
from cow_service.stages.run import Backends, Run

_FOLDER = tempfile.TemporaryDirectory(prefix="cow-tests-")  # of artifacts, until the process ends


def unexpected() -> Any:
    raise AssertionError("the request said it all: no backend may be loaded")


def run_of(pixels: NDArray[np.uint8], reader=unexpected, generator=unexpected, **request: Any) -> Run:
    """A run of a request on an image [H, W, 3]."""
    sha256 = hashlib.sha256(pixels.tobytes()).hexdigest()
    image = DecodedImage(pixels, ImageInfo(width=pixels.shape[1], height=pixels.shape[0], sha256=sha256), "image/png")
    cpu = PrioritySemaphore(1)
    artifacts, perception = DiskArtifacts(Path(_FOLDER.name)), Perception(Settings())
    backends = Backends("reader", reader, EmbeddedReader, generator, artifacts, perception, cpu, lambda: cpu)
    asked = SimulateRequest.model_validate({"image": {"artifact": sha256}, "question": "?", **request})
    return Run(asked, image, backends)
