"""A slow generator that records every clip it begins, to show that a crash does not repeat work.

The folder of this file on PYTHONPATH registers it as `slow`, exactly as an installed package would.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from cow_service.errors import DeviceFailed
from cow_service.generators.base import GeneratorInput
from cow_service.records import GeneratorInfo


class SlowOptions(BaseModel):
    """How slow."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    seconds: float = Field(default=0.2, ge=0, le=3600)
    end: Literal["well", "kill", "memory", "hang", "device"] = "well"


def _end(how: str) -> None:
    """Does to this process what a fault in a native library, an image that is too large, or a lost lock would."""
    if how == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    held: list[bytearray] = []
    while how == "memory":
        held.append(bytearray(os.urandom(1_000_000)) * 50)
        time.sleep(0.05)
    if how == "device":
        raise DeviceFailed("The GPU failed.")
    if how == "hang":
        time.sleep(3600)


class SlowGenerator:
    """Paints each frame in a colour of its seed, after a while."""

    options_model = SlowOptions
    concurrency = 2
    fingerprint = "slow"

    def describe(self, given: GeneratorInput) -> GeneratorInfo:
        """Every seed is another clip."""
        return GeneratorInfo(name="slow", seed=given.seed, options=given.options.model_dump())

    def nearest_lengths(self, num_frames: int, fps: float) -> tuple[int, ...]:
        """Any length."""
        return (num_frames,)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Small."""
        return 64, 48

    def render(
        self, given: GeneratorInput, indices: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[NDArray[np.uint8]]:
        """The frames of these indices, RGB [48, 64, 3]."""
        if journal := os.environ.get("SLOW_JOURNAL"):
            with open(journal, "ab", buffering=0) as file:  # one write: it is whole, or not there
                file.write(f"{given.seed}\n".encode())
        _end(getattr(given.options, "end", "well"))
        seconds: float = getattr(given.options, "seconds", 0.0)
        for done, index in enumerate(indices):
            progress(done / len(indices))
            time.sleep(seconds / len(indices))
            colour = (given.seed % 251, given.seed // 251 % 251, index % 251)
            yield np.full((48, 64, 3), colour, np.uint8)


def create(settings: Any) -> SlowGenerator:
    """Factory for the registry."""
    return SlowGenerator()
