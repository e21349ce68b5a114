"""Trajectory: a ball hits a second one, which may hit a third."""

import numpy as np

from ..world import Run, World
from .base import (
    Draft,
    Form,
    Palette,
    Random,
    add_others,
    arrow_words,
    choose_along,
    push,
    spot,
    stand,
    unit,
)  # fmt: skip

RADIUS = 0.15


def draw(random: Random, level: str, want: int) -> Draft:
    """Three balls without friction; the second leaves along the line of centres at the touch."""
    palette = Palette(random)
    second, leave = spot(random, 0.5), random.uniform(0, 2 * np.pi)
    cut = random.uniform(-0.35, 0.35)
    touch = second - 2 * RADIUS * unit(leave)
    heading = leave + cut
    first = touch - random.uniform(0.35, 0.7) * unit(heading)
    miss = random.choice([-1, 1]) * random.uniform(0.6, 2.2) if want == 1 else random.uniform(-0.08, 0.08)
    third = second + random.uniform(0.6, 0.95) * unit(leave + miss)
    things = [stand("ball", palette.next(), at) for at in (first, second, third)]
    balls = [t.name for t in things]
    add_others(random, palette, things, level)
    along = choose_along(random)
    question = f"If the {balls[0]} moves {arrow_words(along)}, will the {balls[1]} hit the {balls[2]}?"
    world = World(tuple(things), balls[0], push(heading, random.uniform(1.3, 1.8)), frictionless=frozenset(balls))
    return Draft("billiards", "linear", world, balls[2], question, arrow=True, along=along, via=balls[1])


def judge(draft: Draft, run: Run) -> int | None:
    """Whether the second ball touches the third by 1.8 s; the first has to reach the second and no other before."""
    mover, via, target = draft.world.mover, draft.via or "", draft.target
    start, chain = run.first(mover, via), run.first(via, target)
    if start is None or run.first(mover, target) is not None:
        return None
    others = [c for c in run.contacts if not {c.a, c.b} <= {mover, via, target, "floor"}]
    if chain is None:
        radii = draft.world.thing(via).radius + draft.world.thing(target).radius
        apart = np.linalg.norm(run.centres[via] - run.centres[target], axis=1).min() - radii
        return 1 if apart >= draft.clear_gap else None
    return 0 if chain.time < 1.8 and not any(c.time < chain.time for c in others) else None


BILLIARDS = Form(draw, judge, ((-1.0, 1.0), (1.0, 1.0), (0.0, 0.95), (0.0, 1.05)))
