"""The stages of a run: the one list of them, from which progress, events and storage follow.

`pipeline` says how they follow from each other, `stages.keys` what decides the result of each.
"""

from dataclasses import dataclass
from typing import Literal

ReadingStage = Literal["gating", "baseline", "grounding", "motion", "answering"]  # may ask the reader
Stage = Literal[ReadingStage, "depth", "trajectory", "generation"]


@dataclass(frozen=True)
class StageTraits:
    """What the rest of the service knows of a stage."""

    share: float  # of the work of a job that has all stages; 0 of a stage that reports no progress
    is_simulation: bool = False  # a stage of simulations; the others are of answers alone
    # Takes less than its transactions would: stored together with the next, and not looked for behind a computed one.
    is_quick: bool = False
    has_event: bool = False  # its end is an event of its own; others take milliseconds, or run beside
    # Runs beside others. A job holds one key at a time: its process hears of one that was granted to the job.
    is_beside: bool = False


STAGES: dict[Stage, StageTraits] = {  # in the order in which they begin
    "gating": StageTraits(0.05, has_event=True),
    "baseline": StageTraits(0.0, is_beside=True),
    "grounding": StageTraits(0.1, is_simulation=True, is_quick=True, has_event=True),
    "depth": StageTraits(0.05, is_simulation=True, is_quick=True),
    "motion": StageTraits(0.05, is_simulation=True, is_quick=True),
    "trajectory": StageTraits(0.05, is_simulation=True, is_quick=True),
    "generation": StageTraits(0.6, is_simulation=True, has_event=True),
    "answering": StageTraits(0.1, has_event=True),
}
SIMULATION_STAGES: tuple[Stage, ...] = tuple(name for name, traits in STAGES.items() if traits.is_simulation)
_ORDER: dict[str | None, int] = {name: place for place, name in enumerate(STAGES)}

At = tuple[Stage | None, float]
"""A stage, and the share of it that is done."""


def is_ahead(one: At, other: At) -> bool:
    """Whether the first is later in a run than the second."""
    return (_ORDER.get(one[0], -1), one[1]) > (_ORDER.get(other[0], -1), other[1])


def share_done(kind: str, stage: str | None, done: float) -> float:
    """Share of the whole work, 0 to 1, when a stage of a job is so far. Stages that were skipped count as done."""
    shares = [traits.share if kind == "answer" or traits.is_simulation else 0.0 for traits in STAGES.values()]
    if stage not in _ORDER:  # of a later version
        return 0.0
    place = _ORDER[stage]
    return round(min(1.0, (sum(shares[:place]) + shares[place] * done) / sum(shares)), 4)
