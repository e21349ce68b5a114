"""Collision: an object slides over the floor, along an arrow or, as a toy car, along its front."""

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
    hits_target,
    off_target,
    pick,
    push,
    spot,
    stand,
    unit,
)  # fmt: skip

PUSHES = ((-3.0, 1.0), (3.0, 1.0), (0.0, 0.93), (0.0, 1.07))


def pair(random: Random, palette: Palette, mover_shape: str, want: int) -> tuple[list, float, float]:
    """A mover and a target, the mover's heading (radians) and its speed (m/s)."""
    start = spot(random, 1.0)
    away, heading = random.uniform(0.85, 1.6), random.uniform(0, 2 * np.pi)
    mover = stand(mover_shape, palette.next(), start, random.uniform(0, 2 * np.pi))
    target = stand(pick(random, STANDING), palette.next(), start + away * unit(heading), random.uniform(0, 2 * np.pi))
    if want == 1:
        heading += off_target(random, float(np.arcsin(min(1.0, (mover.radius + target.radius) / away))))
    else:
        heading += random.uniform(-0.25, 0.25) * min(mover.radius, target.radius) / away
    return [mover, target], heading, max(random.uniform(0.9, 1.5), away / 1.3)


def draw_slide(random: Random, level: str, want: int) -> Draft:
    """An object with an arrow and a target."""
    palette = Palette(random)
    things, heading, speed = pair(random, palette, pick(random, SLIDING), want)
    along = choose_along(random)
    add_others(random, palette, things, level)
    mover, target = things[0].name, things[1].name
    world = World(tuple(things), mover, push(heading, speed), frictionless=frozenset({mover}))
    question = f"If the {mover} moves {arrow_words(along)}, will it hit the {target}?"
    return Draft("slide", "linear", world, target, question, arrow=True, along=along)


def draw_car(random: Random, level: str, want: int) -> Draft:
    """A toy car that moves along its front; nothing is drawn."""
    palette = Palette(random)
    things, heading, speed = pair(random, palette, "toy car", want)
    things[0] = stand("toy car", things[0].colour, np.array(things[0].centre[:2]), heading)
    add_others(random, palette, things, level)
    mover, target = things[0].name, things[1].name
    world = World(tuple(things), mover, push(heading, speed), frictionless=frozenset({mover}))
    return Draft("car", "linear", world, target, f"If the {mover} moves forward, will it hit the {target}?")


def draw_first(random: Random, level: str, want: int) -> Draft:
    """Three named objects; the mover hits one of them first, and another one may be behind it."""
    palette = Palette(random)
    things, heading, speed = pair(random, palette, pick(random, SLIDING), 0)
    start = np.array(things[0].centre[:2])
    for k in range(2):
        turn = 0.0 if k == 0 and random.uniform() < 0.5 else random.choice([-1, 1]) * random.uniform(0.5, 1.0)
        at = start + random.uniform(0.7, 1.9) * unit(heading + turn)
        things.append(stand(pick(random, STANDING), palette.next(), at, random.uniform(0, 2 * np.pi)))
    named = [t.name for t in things[2:]]
    named.insert(want, things[1].name)
    add_others(random, palette, things, level, least=1)
    mover, along = things[0].name, choose_along(random)
    world = World(tuple(things[:6]), mover, push(heading, speed), frictionless=frozenset({mover}))
    question = f"If the {mover} moves {arrow_words(along)}, which object will it hit first?"
    return Draft("first", "linear", world, things[1].name, question, (*named, "Not sure"), arrow=True, along=along)


def judge_first(draft: Draft, run: Run) -> int | None:
    """The option that the mover touches first; it has to be the target, and alone for two samples."""
    mover = draft.world.mover
    names = {t.name for t in draft.world.things}
    touches = [c for c in run.contacts if mover in {c.a, c.b} and {c.a, c.b} <= names]
    if not touches or draft.target not in {touches[0].a, touches[0].b} or touches[0].time > 1.8:
        return None
    others = [c for c in touches if draft.target not in {c.a, c.b}]
    return None if others and others[0].sample < touches[0].sample + 2 else draft.options.index(draft.target)


def draw_remove(random: Random, level: str, want: int) -> Draft:
    """One object stands in the mover's way and is taken away before the motion."""
    palette = Palette(random)
    start, heading, away = spot(random, 1.0), random.uniform(0, 2 * np.pi), random.uniform(1.3, 1.8)
    mover = stand(pick(random, SLIDING), palette.next(), start, random.uniform(0, 2 * np.pi))
    barrier_at = start + random.uniform(0.4, 0.55) * away * unit(heading)
    barrier = stand(pick(random, STANDING), palette.next(), barrier_at, random.uniform(0, 2 * np.pi))
    turn = off_target(random, 0.35) if want == 1 else 0.0
    at = start + away * unit(heading + turn)
    target = stand(pick(random, STANDING), palette.next(), at, random.uniform(0, 2 * np.pi))
    things, along = [mover, barrier, target], choose_along(random)
    add_others(random, palette, things, level)
    world = World(
        tuple(things), mover.name, push(heading, max(random.uniform(1.1, 1.5), away / 1.4)),
        frictionless=frozenset({mover.name}), removed=barrier.name,
    )  # fmt: skip
    words = f"If the {barrier.name} is removed and the {mover.name} moves {arrow_words(along)}"
    question = f"{words}, will it hit the {target.name}?"
    return Draft("remove", "linear", world, target.name, question, arrow=True, along=along)


SLIDE = Form(draw_slide, hits_target, PUSHES)
CAR = Form(draw_car, hits_target, PUSHES)
FIRST = Form(draw_first, judge_first, PUSHES)
REMOVE = Form(draw_remove, hits_target, PUSHES)
