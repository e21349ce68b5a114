"""What every form shares: the draft of a question about a world, and how objects are placed."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..catalogue import COLOURS, HEIGHT, STANDING
from ..world import Run, Thing, World

Random = np.random.Generator
YES_NO = ("Yes", "No", "Not sure")
CLEAR_GAP = 0.12
"""Metres: a miss closer than this is left out."""


@dataclass(frozen=True)
class Draft:
    """A question about a world; the answer is not in it, Bullet gives it.

    `question` has no options yet; `options` ends with the one that abstains. `arrow` says whether one is drawn,
    `along` whether it points as the mover moves. `trail_times` are seconds before t = 0 at which the mover is
    shown too. `via` is the object between the mover and the target. `view_yaw` (radians) fixes the camera's side.
    A miss closer than `clear_gap` metres is left out.
    """

    form: str
    motion: str
    world: World
    target: str
    question: str
    options: tuple[str, ...] = YES_NO
    arrow: bool = False
    along: bool = True
    trail_times: tuple[float, ...] = ()
    via: str | None = None
    view_yaw: float | None = None
    clear_gap: float = CLEAR_GAP


@dataclass(frozen=True)
class Form:
    """How a form is drawn and judged. `judge` gives the option's index, or None for an unclear outcome.

    `pushes` are other pushes (degrees about z, factor of speed) that have to give the same answer.
    """

    draw: Callable[[Random, str, int], Draft]
    judge: Callable[[Draft, Run], int | None]
    pushes: tuple[tuple[float, float], ...] = ()


class Palette:
    """Hands out colours, each once per world, so that every name is said of one object only."""

    def __init__(self, random: Random) -> None:
        self.left = list(random.permutation(list(COLOURS)))

    def next(self) -> str:
        """A colour that no object has yet."""
        return str(self.left.pop())


def pick(random: Random, names: tuple[str, ...]) -> str:
    """One of the names."""
    return names[int(random.integers(len(names)))]


def stand(shape: str, colour: str, at: np.ndarray, yaw: float = 0.0, scale: float = 1.0, lift: float = 0.0) -> Thing:
    """An object that stands on the floor at (x, y), or is `lift` metres above it."""
    z = HEIGHT[shape] * scale / 2 + lift
    return Thing(shape, colour, (float(at[0]), float(at[1]), float(z)), float(yaw), float(scale))


def unit(angle: float) -> np.ndarray:
    """The direction (2,) on the floor."""
    return np.array([np.cos(angle), np.sin(angle)])


def spot(random: Random, reach: float = 0.9) -> np.ndarray:
    """A place (2,) in a disc about the origin."""
    return unit(random.uniform(0, 2 * np.pi)) * reach * np.sqrt(random.uniform())


def free(at: np.ndarray, radius: float, things: list[Thing], room: float = 0.12) -> bool:
    """Whether a circle keeps its distance to all objects."""
    return all(np.hypot(*(at - np.array(t.centre[:2]))) > radius + t.radius + room for t in things)


def add_others(random: Random, palette: Palette, things: list[Thing], level: str, least: int = 2) -> None:
    """Level L2: add 2 to 4 (or from `least`) more objects that stand about; L1 gets none."""
    if level == "L1":
        return
    for _ in range(int(random.integers(least, 5))):
        shape = pick(random, STANDING)
        for _ in range(30):
            other = stand(shape, palette.next() if palette.left else "", spot(random, 1.3), random.uniform(0, 6.28))
            if free(np.array(other.centre[:2]), other.radius, things):
                things.append(other)
                break
            palette.left.append(other.colour)


def arrow_words(along: bool) -> str:
    """How the question says where the mover moves."""
    return "in the direction of the arrow" if along else "opposite to the direction of the arrow"


def choose_along(random: Random) -> bool:
    """Two of three arrows point as the mover moves."""
    return bool(random.uniform() < 0.67)


def push(heading: float, speed: float, up: float = 0.0) -> tuple[float, float, float]:
    """A velocity (m/s) along a heading on the floor."""
    return (float(np.cos(heading) * speed), float(np.sin(heading) * speed), float(up))


def off_target(random: Random, near: float) -> float:
    """An angle in radians, either sign, that clears a target which fills `near` radians to each side."""
    wide = random.uniform(0.2, 0.6) if random.uniform() < 0.5 else random.uniform(0.6, 2.4)
    return float((near + wide) * random.choice([-1, 1]))


def hits_target(draft: Draft, run: Run) -> int | None:
    """Yes if the mover touches the target by 1.8 s and nothing else before; No if it stays clear of it."""
    mover, target = draft.world.mover, draft.target
    contact = run.first(mover, target)
    if contact is None:
        return 1 if run.gaps[target] >= draft.clear_gap else None
    things = {t.name for t in draft.world.things}
    earlier = [c for c in run.contacts if c.time <= contact.time and mover in {c.a, c.b} and {c.a, c.b} <= things]
    alone = all({c.a, c.b} == {mover, target} for c in earlier)
    return 0 if alone and contact.time < 1.8 else None
