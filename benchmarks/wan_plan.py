"""Estimates the time of a run of `wan_speed.py` before it starts, from operations, bytes and earlier results.

Every number here is a guess that the first results correct; none of them is a figure of the benchmark.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, field

from cow_service.generators.wan.capabilities import MINIMUM_VERSIONS, Capabilities, is_installed

SHARE_OF_PEAK = 0.4  # of matrix products, in a pass
FILL_BYTES_PER_SECOND = 4e9  # random weights
MOVED_BYTES_PER_SECOND = 15e9  # from the machine's memory to the GPU's
COMPILE_SECONDS = 60.0
OTHER_SECONDS = 12.0  # of a clip of the full size: encoders and decoding
VAE_SECONDS = 15.0  # to encode and to decode a clip of the full size
FIRST_SECONDS = 15.0  # golden figures and attention
TOY_SECONDS = 10.0  # for anything with a toy


@dataclass
class Budget:
    """Seconds that a run may take, and how wrong the guesses were so far."""

    seconds: float
    begun: float = field(default_factory=time.monotonic)
    _errors: list[float] = field(default_factory=list[float])

    @property
    def left(self) -> float:
        """Seconds."""
        return self.seconds - (time.monotonic() - self.begun)

    def expected(self, reckoned: float) -> float:
        """Seconds, by what the results before have taken."""
        return reckoned * (statistics.median(self._errors) if self._errors else 1.0)

    def took(self, reckoned: float, seconds: float) -> None:
        """Corrects what is expected of the others."""
        self._errors.append(seconds / reckoned)


WANTED = {"accelerate": "0.17.0", "flash-attn": "2.6.3", "kernels": "0.12.3", **MINIMUM_VERSIONS}


def missing_packages() -> list[str]:
    """What a bare machine lacks, as arguments of `pip download` elsewhere."""
    return [f"{name}>={least}" for name, least in WANTED.items() if not is_installed(name, least)]


# Where `--plan` is asked for without the GPU that it is for.
ASSUMED = Capabilities(
    device="cuda",
    name="NVIDIA H100 (assumed: there is no GPU here)",
    compute_capability=(9, 0),
    memory=85_000_000_000,
    gpus=1,
    packages=tuple(MINIMUM_VERSIONS),
    compiler=True,
)
ASSUMED_PEAK = 7e14  # FLOP/s of matrix products in bfloat16
