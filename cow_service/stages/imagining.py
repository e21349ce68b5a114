"""Runs the world of a scene: the ensemble, what the question comes to in it, and the world that is shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cow_service.physics.draws import ensemble, likeliest
from cow_service.physics.events import Events, find_events
from cow_service.physics.outcome import Decided, agrees, decide
from cow_service.physics.world import WorldInput, Worlds, run_world
from cow_service.records import Asked
from cow_service.vision.types import Floats

EVERY = 2  # frames between those that are recorded of the ensemble
TRIES = 4  # worlds that are tried for one that shows what most of the ensemble does


@dataclass(frozen=True)
class Imagined:
    """The world that is shown, and what an ensemble around it says."""

    shown: Worlds
    events: Events  # of the shown world
    around: Worlds | None  # the ensemble's
    around_events: Events | None
    decided: Decided | None  # null where nothing is asked, or there is no ensemble


def imagine(world: WorldInput, asked: Asked | None, target: int | None, size: int) -> Imagined:
    """Runs the likeliest world and an ensemble of `size` worlds around it.

    What is shown must not contradict what is answered: where the answer is sure and the likeliest world differs from
    it, the likeliest world of those that agree is shown.
    """
    shown, events = _run(world, likeliest())
    if size == 0:
        return Imagined(shown, events, None, None, None)
    rows = ensemble(size)
    around, around_events = _run(world, rows, EVERY)
    if asked is None:
        return Imagined(shown, events, around, around_events, None)
    decided = decide(asked, target, around_events, rows)
    if decided.sure:
        shown, events = _agreeing(world, asked, target, rows, around_events, shown, events)
    return Imagined(shown, events, around, around_events, decided)


def _agreeing(
    world: WorldInput, asked: Asked, target: int | None, rows: Floats, around: Events, shown: Worlds, events: Events
) -> tuple[Worlds, Events]:
    """The likeliest world that shows what most of the ensemble does."""
    same = agrees(asked, target, events, around)
    if same[-1]:
        return shown, events
    nearest = np.argsort(np.linalg.norm(rows, axis=1))
    for row in [int(k) for k in nearest if same[k]][:TRIES]:
        tried, tried_events = _run(world, rows[row : row + 1])
        if agrees(asked, target, tried_events, around)[-1]:
            return tried, tried_events
    return shown, events


def _run(world: WorldInput, draws: Floats, every: int = 1) -> tuple[Worlds, Events]:
    worlds = run_world(world, draws, every)
    return worlds, find_events(worlds, world.bodies, world.fps, draws)
