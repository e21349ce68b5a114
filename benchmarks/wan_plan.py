"""What a run of `wan_speed.py` will take, reckoned before it is begun: by operations, bytes, and what came out so far.

Every number here is a guess that the first results correct; none of them is a figure of the benchmark.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass, field

from wan_flops import pass_flops
from wan_models import Case

from cow_service.generators.wan.capabilities import MINIMUM_VERSIONS, Capabilities
from cow_service.generators.wan.profiles import Profile

SHARE_OF_PEAK = 0.4  # of matrix products, in a pass
FILL_BYTES_PER_SECOND = 4e9  # random weights
MOVED_BYTES_PER_SECOND = 15e9  # from the machine's memory to the GPU's
COMPILE_SECONDS = 60.0
OTHER_SECONDS = 12.0  # of a clip of the full size: encoders and decoding
BUDGET_STEPS = 4  # of a clip, where there is a budget: the others are computed from them
FIRST_SECONDS = 15.0  # golden figures and attention
TOY_SECONDS = 10.0  # to build a toy and to warm it up


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


def steps_within_budget(case: Case, profile: Profile) -> int:
    """The steps of a clip that is measured within a budget."""
    return min(case.steps or BUDGET_STEPS, profile.sampling.steps)


def reckoned_seconds(case: Case, profile: Profile, peak: float, warm_up_steps: int) -> float:
    """To build, to warm up and to run the clips of a profile. `peak`: FLOP/s of matrix products in bfloat16."""
    sampling, wanted = case.sampled(profile.sampling), profile.acceleration
    size = case.manifest.architecture, case.num_frames, case.width, case.height
    passes = (sampling.steps * case.runs + min(warm_up_steps, sampling.steps)) * (2 if sampling.guided else 1)
    seconds = passes * pass_flops(*size) / (SHARE_OF_PEAK * peak)
    if case.toy:
        return seconds + TOY_SECONDS
    weights = 2 * sum(case.manifest.parameters.values())
    if wanted.offload != "none":
        seconds += passes * 2 * case.manifest.parameters["transformer"] / MOVED_BYTES_PER_SECOND
    compiling = COMPILE_SECONDS if wanted.compile != "none" else 0.0
    return seconds + weights / FILL_BYTES_PER_SECOND + compiling + OTHER_SECONDS * (case.runs + 1)


def missing_packages(machine: Capabilities) -> list[str]:
    """What a bare machine lacks, as arguments of `pip download` elsewhere."""
    return [f"{name}>={least}" for name, least in MINIMUM_VERSIONS.items() if name not in machine.packages]
