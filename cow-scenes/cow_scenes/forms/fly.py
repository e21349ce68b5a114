"""Trajectory: a ball is thrown, flies on along its trail, or rolls off a table."""

import numpy as np

from ..catalogue import STANDING
from ..world import Table, World
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

GRAVITY = 9.81
TRAIL_TIMES = (0.1, 0.2, 0.3)
PUSHES = ((-2.5, 1.0), (2.5, 1.0), (0.0, 0.96), (0.0, 1.04))


def flight(random: Random, palette: Palette, want: int) -> tuple[list, tuple[float, float, float]]:
    """A ball in the air, a target on the floor, and the velocity (m/s) that hits or misses it."""
    start, heading, away = spot(random, 0.9), random.uniform(0, 2 * np.pi), random.uniform(0.8, 1.5)
    ball = stand("ball", palette.next(), start, lift=random.uniform(0.3, 0.8))
    target = stand(pick(random, STANDING), palette.next(), start + away * unit(heading), random.uniform(0, 2 * np.pi))
    time = random.uniform(0.4, 0.7)
    drop = target.centre[2] + random.uniform(-0.2, 0.2) * target.height - ball.centre[2]
    up = drop / time + GRAVITY * time / 2
    if want == 1:
        heading += off_target(random, float(np.arcsin((ball.radius + target.radius) / away)))
    return [ball, target], push(heading, away / time, up)


def draw_throw(random: Random, level: str, want: int) -> Draft:
    """A ball in the air with an arrow."""
    palette = Palette(random)
    things, velocity = flight(random, palette, want)
    add_others(random, palette, things, level)
    ball, target, along = things[0].name, things[1].name, choose_along(random)
    question = f"If the {ball} is thrown {arrow_words(along)}, will it hit the {target}?"
    world = World(tuple(things), ball, velocity)
    return Draft("throw", "projectile", world, target, question, arrow=True, along=along)


def draw_trail(random: Random, level: str, want: int) -> Draft:
    """A ball in flight with three earlier positions; the shown position nearest to the target is the last."""
    palette = Palette(random)
    things, velocity = flight(random, palette, want)
    add_others(random, palette, things, level)
    ball, target = things[0].name, things[1].name
    question = (
        f"If the {ball} flies on along the trail of positions that is shown, the last of which is the one nearest to"
        f" the {target}, will it hit the {target}?"
    )
    return Draft("trail", "projectile", World(tuple(things), ball, velocity), target, question, trail_times=TRAIL_TIMES)


def draw_table(random: Random, level: str, want: int) -> Draft:
    """A ball rolls over a table and off it."""
    palette = Palette(random)
    centre, heading, speed = spot(random, 0.5), random.uniform(0, 2 * np.pi), random.uniform(1.0, 1.6)
    table = Table((float(centre[0]), float(centre[1])), float(random.uniform(0.3, 0.45)), random.uniform(0, 2 * np.pi))
    ball = stand("ball", palette.next(), centre, lift=table.height)
    turn = off_target(random, 0.3) if want == 1 else 0.0
    at = centre + random.uniform(0.85, 1.35) * unit(heading + turn)
    target = stand(pick(random, STANDING), palette.next(), at, random.uniform(0, 2 * np.pi))
    # A stand-in for the table keeps the others off it; it is no object of the world.
    block = stand("ball", "table", centre, scale=table.side * 0.72 / 0.15)
    things = [ball, target, block]
    add_others(random, palette, things, level)
    things.remove(block)
    v, along = push(heading, speed), choose_along(random)
    spin = (-v[1] / 0.15, v[0] / 0.15, 0.0)
    question = f"If the {ball.name} rolls {arrow_words(along)}, will it hit the {target.name}?"
    world = World(tuple(things), ball.name, v, spin, table=table)
    return Draft("table", "linear", world, target.name, question, arrow=True, along=along)


THROW = Form(draw_throw, hits_target, PUSHES)
TRAIL = Form(draw_trail, hits_target, PUSHES)
TABLE = Form(draw_table, hits_target, PUSHES)
