"""A scene of the second family while it is drawn: a table top or a floor, and what stands on it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..forms.base import Draft, Palette, pick, push, unit
from .physics import Fixture, Matter, OtherWorld
from .shapes import Solid, shapes

Random = np.random.Generator
Vector = tuple[float, float, float]
ROUND = ("ball", "ball", "ball", "orange", "apple")
"""What rolls; more often a ball."""


def rolling(thing: Solid, velocity: Vector) -> Vector:
    """The spin of what rolls; other objects slide."""
    if thing.shape not in ROUND:
        return (0.0, 0.0, 0.0)
    return (-velocity[1] / (thing.height / 2), velocity[0] / (thing.height / 2), 0.0)


@dataclass
class Stage:
    """A scene while it is drawn: `reach` is its size in metres, `blocked` what stands about besides `things`."""

    random: Random
    reach: float
    palette: Palette
    matter: Matter
    things: list[Solid] = field(default_factory=list)
    fixtures: list[Fixture] = field(default_factory=list)
    blocked: list[tuple[np.ndarray, float]] = field(default_factory=list)

    @property
    def nouns(self) -> tuple[str, ...]:
        """What occurs in a scene of this size."""
        return tuple(n for n in shapes() if self.sizes(n)[1] > 0)

    def sizes(self, noun: str) -> tuple[float, float]:
        """Least and largest scale of a kind of object."""
        return shapes()[noun].table if self.reach < 1 else shapes()[noun].floor

    def number(self, low: float, high: float) -> float:
        """A number between two."""
        return float(self.random.uniform(low, high))

    def add(self, noun: str, at: np.ndarray, lift: float = 0.0, scale: float = 0.0) -> Solid:
        """Stand an object at (x, y), or `lift` metres above the floor; with a scale of its own if none is given."""
        scale = scale or self.number(*self.sizes(noun))
        known = [c for c in shapes()[noun].colours if c in self.palette.left]
        if shapes()[noun].colours and not known:
            noun, scale = "cube", self.number(*self.sizes("cube"))
        colour = pick(self.random, tuple(known)) if known else self.palette.next()
        if known:
            self.palette.left.remove(colour)
        height = shapes()[noun].height * scale / 2 + lift
        made = Solid(noun, colour, (float(at[0]), float(at[1]), height), self.number(0, 2 * np.pi), scale)
        self.things.append(made)
        return made

    def choose(self, nouns: tuple[str, ...]) -> str:
        """One of the nouns that occurs here."""
        return pick(self.random, tuple(n for n in nouns if n in self.nouns) or ("ball",))

    def spot(self, share: float) -> np.ndarray:
        """A place (2,) about the middle."""
        return unit(self.number(0, 2 * np.pi)) * share * self.reach * np.sqrt(self.number(0, 1))

    def add_others(self, level: str) -> None:
        """Level L2: 2 to 4 more objects that stand about."""
        taken = [(np.array(t.centre[:2]), t.radius) for t in self.things] + self.blocked
        for _ in range(int(self.random.integers(2, 5)) if level == "L2" else 0):
            noun, at = self.choose(self.nouns), self.spot(1.1)
            size = shapes()[noun].radius * self.sizes(noun)[1]
            if all(np.hypot(*(at - other)) > size + radius + 0.06 * self.reach for other, radius in taken):
                taken.append((at, self.add(noun, at).radius))

    def launch(self, mover: Solid, heading: float, way: float) -> dict:
        """Velocity and spin that take the mover over `way` metres in 0.5 to 1.2 s; what slides has little friction."""
        if mover.shape not in ROUND:
            self.matter = Matter(self.matter.friction, self.matter.restitution, self.number(0.0, 0.03))
        velocity = push(heading, max(0.3, way / self.number(0.5, 1.2)))
        return {"velocity": velocity, "spin": rolling(mover, velocity)}

    def draft(
        self, form: str, motion: str, question: str, target: Solid, velocity: Vector = (0.0, 0.0, 0.0), **more: Any
    ) -> Draft:
        """The question about this scene; the first object is the mover. `spin` and the like are the world's."""
        ours = {name: more.pop(name) for name in ("spin", "removed", "carry_to") if name in more}
        world = OtherWorld(
            tuple(self.things), self.things[0].name, velocity, fixtures=tuple(self.fixtures), matter=self.matter, **ours
        )
        return Draft(form, motion, world, target.name, question, clear_gap=0.08 * self.reach, **more)


def open_stage(random: Random) -> Stage:
    """A table top or a floor, its friction and its restitution."""
    reach = random.uniform(0.4, 0.6) if random.uniform() < 0.6 else random.uniform(1.1, 1.6)
    matter = Matter(float(random.uniform(0.25, 1.0)), float(random.uniform(0.1, 0.75)))
    return Stage(random, float(reach), Palette(random), matter)
