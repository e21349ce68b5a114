"""Occlusion: an object slides past a target, in front of it or not."""

import numpy as np

from ..catalogue import SLIDING, STANDING
from ..world import Run, World
from .base import (
    Draft,
    Form,
    Palette,
    Random,
    add_others,
    arrow_words,
    choose_along,
    pick,
    push,
    spot,
    stand,
    unit,
)


def draw(random: Random, level: str, want: int) -> Draft:
    """The mover crosses the line of sight in front of the target, or behind it, or leaves."""
    palette = Palette(random)
    view, at = random.uniform(0, 2 * np.pi), spot(random, 0.5)
    target = stand(pick(random, STANDING), palette.next(), at, random.uniform(0, 2 * np.pi))
    shape = pick(random, SLIDING)
    side = random.choice([-1, 1])
    heading = view + side * (np.pi / 2 + random.uniform(-0.6, 0.6))
    behind = want == 1 and random.uniform() < 0.5
    cross = at + random.uniform(0.45, 0.9) * (-1 if behind else 1) * unit(view)
    start = cross - random.uniform(0.6, 1.0) * unit(heading)
    if want == 1 and not behind:
        heading += np.pi + random.uniform(-0.5, 0.5)
    things = [stand(shape, palette.next(), start, random.uniform(0, 2 * np.pi)), target]
    add_others(random, palette, things, level)
    mover, along = things[0].name, choose_along(random)
    question = f"If the {mover} moves {arrow_words(along)}, will the {target.name} be occluded at some moment?"
    world = World(tuple(things), mover, push(heading, random.uniform(0.8, 1.3)), frictionless=frozenset({mover}))
    return Draft("slide-occlude", "linear", world, target.name, question, arrow=True, along=along, view_yaw=float(view))


def judge(draft: Draft, run: Run) -> int | None:
    """Only whether the motion is free of touches (-1); the answer is read from the silhouettes."""
    mover = draft.world.mover
    touched = any(mover in {c.a, c.b} and "floor" not in {c.a, c.b} for c in run.contacts)
    return None if touched or run.gaps[draft.target] < draft.clear_gap else -1


OCCLUDE = Form(draw, judge)
