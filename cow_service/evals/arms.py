"""What a question is asked with: the arms that an evaluation compares."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from cow_service.errors import InvalidRequest
from cow_service.evals.items import Item
from cow_service.evals.observations import Ask

Shown = Literal["nothing", "simulation", "still", "wrong-direction", "facts", "oracle"]
MAX_TRIES = 16
_BEST_OF = re.compile(r"best-of-(\d+)")


@dataclass(frozen=True)
class Arm:
    """What is shown beside the image, and how often it is asked."""

    name: str
    shown: Shown = "nothing"
    with_image: bool = True  # whether the question's image is shown
    gated: bool = False  # whether the answers from the image alone decide if anything is imagined
    tries: int = 1  # simulations, a reply each; the most frequent answer is taken

    @property
    def asks(self) -> tuple[Ask, ...]:
        """The ways to ask in which there is such an arm."""
        plain = self.shown in ("nothing", "simulation") and self.with_image
        return ("prompt", "answer") if plain else ("prompt",)


ARMS: dict[str, tuple[Arm, str]] = {
    arm.name: (arm, meaning)
    for arm, meaning in (
        (Arm("never"), "the image alone"),
        (Arm("always", "simulation"), "the image and frames of its imagined future"),
        (Arm("auto", "simulation", gated=True), "the same where three answers from the image alone disagree"),
        (
            Arm("best-of-3", "simulation", tries=3),
            "three simulations, each with its own seed: the most frequent answer",
        ),
        (Arm("placebo-still", "still"), "the first image again in place of each frame"),
        (Arm("placebo-direction", "wrong-direction"), "frames of a simulation in the opposite direction"),
        (Arm("encounters", "facts"), "the image, and what the simulation found in words; no frames"),
        (Arm("frames-only", "simulation", with_image=False), "the frames without the image"),
        (Arm("oracle", "oracle"), "the image and pictures of what really happens"),
    )
}


def arm_of(name: str) -> Arm:
    """The arm of a name; `best-of-K` for any number of simulations. Raises `InvalidRequest` for another name."""
    best = _BEST_OF.fullmatch(name)
    if best and 2 <= int(best[1]) <= MAX_TRIES:
        return Arm(name, "simulation", tries=int(best[1]))
    if name not in ARMS:
        raise InvalidRequest(
            f"There is no arm '{name}': there are {', '.join(ARMS)}, and best-of-K for K from 2 to {MAX_TRIES}."
        )
    return ARMS[name][0]


def check_arms(names: Sequence[str], ask: Ask, items: Sequence[Item]) -> tuple[Arm, ...]:
    """The arms of these names. Raises `InvalidRequest` for one that cannot be asked so, or of these items."""
    arms = tuple(arm_of(name) for name in dict.fromkeys(names))
    if not arms:
        raise InvalidRequest(f"Name at least one arm: {', '.join(ARMS)}.")
    for arm in arms:
        if ask not in arm.asks:
            there = ", ".join(name for name, (each, _) in ARMS.items() if ask in each.asks)
            raise InvalidRequest(
                f"The service's own /answer has no arm '{arm.name}', only {there}: use --ask prompt with --mllm."
            )
    without = [item for item in items if not item.oracle]
    if without and any(arm.shown == "oracle" for arm in arms):
        raise InvalidRequest(
            f"The arm 'oracle' needs pictures of what really happens, and {len(without)} of {len(items)} items have "
            f"none, such as {without[0].row}."
        )
    return arms
