"""Compatibility: something falls onto an object or beside it, or is put into a bowl."""

import numpy as np

from ..catalogue import BOWL_OPENING, RADIUS
from ..world import Run, World
from .base import Draft, Form, Palette, Random, add_others, pick, spot, stand, unit

TOPS = {"cube": 0.15, "cylinder": 0.14}
"""Metres: half the width of what can be landed on; what falls into a mug or bowl does not clearly land on it."""


def draw_fall(random: Random, level: str, want: int) -> Draft:
    """A ball or cube above an object, or well beside it."""
    palette = Palette(random)
    at, shape = spot(random, 0.6), pick(random, tuple(TOPS))
    target = stand(shape, palette.next(), at, random.uniform(0, 2 * np.pi))
    faller_shape, scale = pick(random, ("ball", "cube")), random.uniform(0.6, 0.85)
    half = RADIUS[faller_shape] * scale
    beside = random.uniform(0, 0.25) * TOPS[shape] if want == 0 else target.radius + half + random.uniform(0.18, 0.5)
    over = at + beside * unit(random.uniform(0, 2 * np.pi))
    lift = target.height + random.uniform(0.3, 0.55)
    things = [stand(faller_shape, palette.next(), over, target.yaw, scale, lift), target]
    add_others(random, palette, things, level)
    faller = things[0].name
    question = f"If the {faller} falls freely from its current position, will it land on the {target.name}?"
    return Draft("fall", "fall", World(tuple(things), faller), target.name, question)


def judge_fall(draft: Draft, run: Run) -> int | None:
    """Yes if the first touch is with the target, No if it is not and the target stays clear."""
    mover = draft.world.mover
    touched = [({c.a, c.b} - {mover}).pop() for c in run.contacts if mover in {c.a, c.b}]
    if not touched:
        return None
    if touched[0] == draft.target:
        return 0
    return 1 if run.gaps[draft.target] >= draft.clear_gap else None


def draw_place(random: Random, level: str, want: int) -> Draft:
    """A ball or cube beside a bowl whose opening is clearly wider, or clearly narrower."""
    palette = Palette(random)
    at, size = spot(random, 0.6), random.uniform(0.9, 1.2)
    bowl = stand("bowl", palette.next(), at, scale=size)
    shape = pick(random, ("ball", "cube"))
    # A ball has to be narrower across, a cube along its diagonal to go in and along its side to stay out.
    if want == 0:
        scale = random.uniform(0.45, 0.72) * BOWL_OPENING * size / RADIUS[shape]
    else:
        scale = random.uniform(1.22, 1.4) * BOWL_OPENING * size / 0.15
    reach = bowl.radius + RADIUS[shape] * scale
    start = at + (reach + random.uniform(0.15, 0.5)) * unit(random.uniform(0, 2 * np.pi))
    mover = stand(shape, palette.next(), start, random.uniform(0, 2 * np.pi), scale)
    things = [mover, bowl]
    add_others(random, palette, things, level)
    above = (float(at[0]), float(at[1]), bowl.height + mover.height / 2 + 0.08)
    question = f"If I put the {mover.name} into the {bowl.name}, will it fit inside?"
    return Draft("place", "fall", World(tuple(things), mover.name, carry_to=above), bowl.name, question)


def judge_place(draft: Draft, run: Run) -> int | None:
    """Yes if it rests in the opening with half of its height or more below the rim, No if it rests on the rim."""
    mover, bowl = draft.world.thing(draft.world.mover), draft.world.thing(draft.target)
    end, rest = run.centres[mover.name][-1], run.centres[bowl.name][-1]
    if any(not {c.a, c.b} <= {mover.name, bowl.name, "floor"} for c in run.contacts):
        return None
    aside = float(np.hypot(*(end - rest)[:2]))
    depth = rest[2] + bowl.height / 2 - (end[2] - mover.height / 2)
    inner = BOWL_OPENING * bowl.scale
    if mover.radius < 0.75 * inner:
        return 0 if aside < inner - mover.radius * 0.7 and depth > 0.5 * mover.height else None
    return 1 if depth < 0.75 * bowl.height and end[2] > rest[2] + bowl.height / 2 else None


FALL = Form(draw_fall, judge_fall)
PLACE = Form(draw_place, judge_place)
