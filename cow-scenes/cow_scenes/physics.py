"""Runs a world in Bullet: 240 steps and 30 samples per second for 2 s."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import numpy as np
import pybullet as bullet

from .pieces import pieces_of
from .stepping import ContactLog, Touch, carried
from .world import FPS, GONE, SAMPLES, SUBSTEPS, Run, Thing, World

FRICTION, FLOOR_FRICTION, RESTITUTION, MASS = 0.5, 0.3, 0.5, 1.0
GAP_REACH = 2.0
"""Metres within which the closest approach is measured."""


@cache
def hull_file(shape: str) -> str:
    """A file with the convex pieces of a shape, one group each, as Bullet's loader wants a compound."""
    lines, first = [], 1
    for i, piece in enumerate(pieces_of(shape)):
        lines.append(f"o piece{i}")
        lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in piece]
        # The loader takes a group's corners from its faces, so every corner has to be in one.
        lines += [f"f {first} {first + k} {first + k + 1}" for k in range(1, len(piece) - 1)]
        first += len(piece)
    path = Path(hull_folder().name) / f"{shape.replace(' ', '_')}.obj"
    path.write_text("\n".join(lines) + "\n")
    return str(path)


@cache
def hull_folder() -> "tempfile.TemporaryDirectory[str]":
    """The folder of those files; it goes with the process."""
    return tempfile.TemporaryDirectory(prefix="cow-scenes-")


def shape_in(client: int, thing: Thing) -> int:
    """Bullet's collision shape of an object."""
    half = thing.height / 2
    if thing.shape == "ball":
        return bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=half, physicsClientId=client)
    if thing.shape == "cube":
        return bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[half] * 3, physicsClientId=client)
    return bullet.createCollisionShape(
        bullet.GEOM_MESH, fileName=hull_file(thing.shape), meshScale=[thing.scale] * 3, physicsClientId=client
    )


def add_box(client: int, half: list[float], centre: list[float], yaw: float, friction: float) -> int:
    """A fixed box: the floor or the table."""
    shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
    body = bullet.createMultiBody(
        0, shape, -1, centre, bullet.getQuaternionFromEuler([0, 0, yaw]), physicsClientId=client
    )
    bullet.changeDynamics(body, -1, lateralFriction=friction, restitution=RESTITUTION, physicsClientId=client)
    return body


def add_thing(client: int, thing: Thing, frictionless: bool) -> int:
    """A free object."""
    turn = bullet.getQuaternionFromEuler([0, 0, thing.yaw])
    body = bullet.createMultiBody(MASS, shape_in(client, thing), -1, list(thing.centre), turn, physicsClientId=client)
    bullet.changeDynamics(
        body, -1, lateralFriction=0.0 if frictionless else FRICTION, restitution=RESTITUTION, linearDamping=0,
        angularDamping=0, physicsClientId=client,
    )  # fmt: skip
    return body


@contextmanager
def engine() -> Iterator[int]:
    """A Bullet world of its own with gravity; closed at the end."""
    client = bullet.connect(bullet.DIRECT)
    try:
        bullet.setGravity(0, 0, -9.81, physicsClientId=client)
        bullet.setPhysicsEngineParameter(
            fixedTimeStep=1 / (FPS * SUBSTEPS), numSolverIterations=50, deterministicOverlappingPairs=1,
            restitutionVelocityThreshold=0.05, physicsClientId=client,
        )  # fmt: skip
        yield client
    finally:
        bullet.disconnect(client)


def populate(client: int, world: World) -> dict[int, str]:
    """Put everything into the engine; the name of each body by its number."""
    names = {add_box(client, [50, 50, 1], [0, 0, -1], 0, FLOOR_FRICTION): "floor"}
    if world.table:
        t = world.table
        half = [t.side / 2, t.side / 2, t.height / 2]
        names[add_box(client, half, [*t.centre, t.height / 2], t.yaw, FRICTION)] = "table"
    for thing in world.things:
        if thing.name == world.removed:
            continue
        body = add_thing(client, thing, thing.name in world.frictionless)
        names[body] = thing.name
        if thing.name == world.mover:
            bullet.resetBaseVelocity(body, list(world.velocity), list(world.spin), physicsClientId=client)
    return names


def touches_now(client: int, names: dict[int, str]) -> Iterator[Touch]:
    """What touches after a step."""
    for point in bullet.getContactPoints(physicsClientId=client):
        if point[8] <= 0.001:
            yield names[point[1]], names[point[2]], point[9], point[5]


def gaps_now(client: int, names: dict[int, str], mover: int) -> dict[str, float]:
    """The mover's distance to each object, in metres."""
    found = {}
    for body, name in names.items():
        if body != mover and name not in {"floor", "table"}:
            near = bullet.getClosestPoints(mover, body, GAP_REACH, physicsClientId=client)
            found[name] = max(0.0, min((p[8] for p in near), default=GAP_REACH))
    return found


def simulate(world: World) -> Run:
    """Run a world for 2 s; the same world gives the same numbers."""
    with engine() as client:
        names = populate(client, world)
        bodies = {name: body for body, name in names.items()}
        things = [t.name for t in world.things]
        centres = {n: np.tile(np.array(GONE), (SAMPLES, 1)) for n in things}
        turns = {n: np.tile(np.array([0.0, 0, 0, 1]), (SAMPLES, 1)) for n in things}
        log, gaps = ContactLog(FPS * SUBSTEPS), dict.fromkeys((n for n in things if n != world.mover), GAP_REACH)
        for sample in range(SAMPLES):
            for k in range(SUBSTEPS if sample else 0):
                step = (sample - 1) * SUBSTEPS + k + 1
                hand = carried(world, step / (FPS * SUBSTEPS))
                if hand:
                    turn = bullet.getQuaternionFromEuler([0, 0, world.thing(world.mover).yaw])
                    bullet.resetBasePositionAndOrientation(bodies[world.mover], hand, turn, physicsClientId=client)
                    bullet.resetBaseVelocity(bodies[world.mover], [0] * 3, [0] * 3, physicsClientId=client)
                bullet.stepSimulation(physicsClientId=client)
                log.step(touches_now(client, names), step)
            for name in things:
                if name in bodies:
                    at, turn = bullet.getBasePositionAndOrientation(bodies[name], physicsClientId=client)
                    centres[name][sample], turns[name][sample] = at, turn
            for name, gap in gaps_now(client, names, bodies[world.mover]).items():
                gaps[name] = min(gaps[name], gap)
        return Run(centres, turns, log.contacts(), gaps)
