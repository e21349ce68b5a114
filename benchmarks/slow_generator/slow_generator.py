"""A generator that takes its time and writes down every clip that it begins: what a crash must not make it do again.

The folder of this file on PYTHONPATH registers it as `slow`, exactly as an installed package would.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from cow_service.generators.base import Shot
from cow_service.records import GeneratorInfo


class SlowOptions(BaseModel):
    """How slow."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    seconds: float = Field(default=0.2, ge=0, le=3600)


class SlowGenerator:
    """Paints each frame in a colour of its seed, after a while."""

    options_model = SlowOptions
    concurrency = 2

    def describe(self, shot: Shot) -> GeneratorInfo:
        """Every seed is another clip."""
        return GeneratorInfo(name="slow", seed=shot.seed, options=shot.options.model_dump())

    def nearest_lengths(self, num_frames: int) -> tuple[int, ...]:
        """Any length."""
        return (num_frames,)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Small."""
        return 64, 48

    def render(
        self, shot: Shot, wanted: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[NDArray[np.uint8]]:
        """The wanted frames, RGB [48, 64, 3]."""
        if journal := os.environ.get("SLOW_JOURNAL"):
            with open(journal, "ab", buffering=0) as file:  # one write: it is whole, or not there
                file.write(f"{shot.seed}\n".encode())
        seconds: float = getattr(shot.options, "seconds", 0.0)
        for done, index in enumerate(wanted):
            progress(done / len(wanted))
            time.sleep(seconds / len(wanted))
            colour = (shot.seed % 251, shot.seed // 251 % 251, index % 251)
            yield np.full((48, 64, 3), colour, np.uint8)


def create(settings: Any) -> SlowGenerator:
    """Factory for the registry."""
    return SlowGenerator()
