"""What both engines share while they run a world: the hand that carries the mover, and the log of touches."""

from collections.abc import Iterable, Sequence

import numpy as np

from .world import FPS, Contact, World

CARRY_SECONDS, CARRY_HEIGHT = 0.6, 1.0
FIXED = {"floor", "table", "ramp", "step"}
"""What the mover may rest on: a touch that is there at the start is no contact."""

Touch = tuple[str, str, float, Sequence[float]]
"""Two names, the normal force (N) and the point (m)."""


class ContactLog:
    """Collects touches step by step; one that began less than a sample ago is the same touch.

    `rate` is the engine's steps per second.
    """

    def __init__(self, rate: int) -> None:
        self.rate, self.substeps = rate, rate // FPS
        self.last: dict[tuple[str, str], int] = {}
        self.open: dict[tuple[str, str], dict] = {}
        self.found: list[tuple[tuple[str, str], dict]] = []

    def step(self, touches: Iterable[Touch], step: int) -> None:
        """Note what touches after `step` steps."""
        forces: dict[tuple[str, str], list] = {}
        for one, other, force, at in touches:
            forces.setdefault((one, other) if one < other else (other, one), []).append((force, at))
        for pair, points in forces.items():
            impulse = sum(force for force, _ in points) / self.rate
            if step - self.last.get(pair, -1000) > self.substeps:
                self.open[pair] = {"step": step, "point": np.mean([at for _, at in points], 0), "impulse": 0.0}
                if step > 1 or not (FIXED & set(pair)):
                    self.found.append((pair, self.open[pair]))
            record = self.open[pair]
            if step - record["step"] < self.substeps:
                record["impulse"] += impulse
            self.last[pair] = step

    def contacts(self) -> tuple[Contact, ...]:
        """All touches in the order of time."""
        return tuple(self.contact(*pair, record) for pair, record in self.found)

    def contact(self, a: str, b: str, record: dict) -> Contact:
        """One touch as it is recorded."""
        x, y, z = (float(c) for c in record["point"])
        step = record["step"]
        return Contact(a, b, step / self.rate, (x, y, z), float(record["impulse"]), -(-step // self.substeps))


def carried(world: World, time: float) -> list[float] | None:
    """Where the hand holds the mover at a time; None once it is released."""
    if world.carry_to is None or time > CARRY_SECONDS:
        return None
    s = time / CARRY_SECONDS
    s = s * s * (3 - 2 * s)
    start, end = np.array(world.thing(world.mover).centre), np.array(world.carry_to)
    x, y, z = start + (end - start) * s
    return [float(x), float(y), float(z + CARRY_HEIGHT * s * (1 - s))]
