"""Puts bodies somewhere before anything moves: one after the other is let go, and rests there as the motion begins."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cow_service.physics.carrying import SETTLES, Put, let_go
from cow_service.physics.engine import WorldRun, run_worlds
from cow_service.physics.placement import Placements, classify
from cow_service.physics.rigid import RigidShape
from cow_service.records import PlacementResult
from cow_service.vision.types import Floats

Shapes = tuple[RigidShape, ...]  # the bodies of one world


@dataclass(frozen=True)
class Settled:
    """Worlds in which bodies were put somewhere, as the motion begins."""

    shapes: tuple[Shapes, ...]  # per draw
    placements: tuple[Placements, ...]  # per put body, in their order


def settle(
    puts: Sequence[Put], shapes: Sequence[Shapes], draws: Floats, fps: float, flying: Collection[int] = ()
) -> Settled:
    """Lets go of one body after the other in the worlds of draws [K, P]; nothing else moves until all are at rest.

    What is `flying` hangs in the air meanwhile. A body that reaches beyond its middle overlaps it; above one that does
    not it makes room, so that nothing begins inside another thing.
    """
    frames = math.ceil(SETTLES * fps) + 2
    current = [tuple(_at_rest(body, flies=i in flying) for i, body in enumerate(bodies)) for bodies in shapes]
    placements, free = list[Placements](), [i for i in flying if shapes[0][i].follows is None]
    for put in puts:
        ready = [let_go(put, bodies, row) for bodies, row in zip(current, draws, strict=True)]
        runs = run_worlds(ready, frames, fps, frames - 1, turns_wanted=True)
        found = [classify(put, *each) for each in zip(ready, runs, current, strict=True)]
        current = [_come_to_rest(bodies, run) for bodies, run in zip(ready, runs, strict=True)]
        ends, clearance, above = zip(*found, strict=True)
        meet = [any(_holds_middle(bodies[put.body], bodies[i]) for i in flying) for bodies in current]
        results: list[PlacementResult] = ["overlaps" if met else end for met, end in zip(meet, ends, strict=True)]
        current = [_made_room(bodies, put.body, free) for bodies in current]
        placements.append(Placements(put.relation, tuple(results), np.array(clearance), np.array(above), 0.0))
    put_bodies = {put.body for put in puts}
    begun = tuple(
        tuple(_set_going(*pair, falls=i in put_bodies) for i, pair in enumerate(zip(bodies, at_rest, strict=True)))
        for bodies, at_rest in zip(shapes, current, strict=True)
    )
    return Settled(begun, tuple(placements))


def standing_on(puts: Sequence[Put], supports: Sequence[int | None]) -> Mapping[int, int | None]:
    """What each put body stands on where it is put: its target, or beside that what the target stands on."""
    found: dict[int, int | None] = {}
    for put in puts:
        target = put.targets[0]
        under = found.get(target, supports[target])
        found[put.body] = target if put.relation in ("into", "onto") else None if under == put.body else under
    return found


def _at_rest(body: RigidShape, *, flies: bool) -> RigidShape:
    """Before anything moves. Its velocity, which tells where it goes, is none before it starts."""
    falls = body.falls and not flies
    return replace(body, starts=False, glides=False, course=None, follows=None, ghost=flies, falls=falls)


def _holds_middle(body: RigidShape, other: RigidShape) -> bool:
    """Whether the middle of another body lies inside a body that stands upright."""
    right, up, ahead = (there - here for there, here in zip(other.position, body.position, strict=True))
    return abs(up) < body.half_height and math.hypot(right, ahead) < body.half_width


def _come_to_rest(bodies: Shapes, run: WorldRun) -> Shapes:
    """Where they are in the end, at rest."""
    found = list(bodies)
    for i in run.moved:
        x, y, z = run.positions[i, -1].tolist()
        a, b, c, w = run.turns[i, -1].tolist()
        found[i] = replace(bodies[i], position=(x, y, z), turn=(a, b, c, w), starts=False)
    return tuple(found)


def _made_room(bodies: Shapes, put: int, flying: Collection[int]) -> Shapes:
    """With what is flying above a body that was put somewhere as high as to touch it at least."""
    below, found = bodies[put], list(bodies)
    top = below.position[1] + below.half_height
    for i in flying:
        x, y, z = bodies[i].position
        away = math.hypot(x - below.position[0], z - below.position[2])
        past = max(0.0, away - below.half_width)  # beyond the edge of the top
        under = bodies[i].half_height * math.sqrt(max(0.0, 1 - (past / bodies[i].half_width) ** 2))
        if past < bodies[i].half_width and below.position[1] < y < top + under:
            found[i] = replace(bodies[i], position=(x, top + under, z))
    return tuple(found)


def _set_going(body: RigidShape, at_rest: RigidShape, *, falls: bool) -> RigidShape:
    """A body as it was to be, from where it rests on."""
    return replace(
        body,
        position=at_rest.position,
        turn=at_rest.turn,
        half_height=at_rest.half_height,
        hollow=at_rest.hollow,
        falls=falls or body.falls,
    )
