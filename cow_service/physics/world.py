"""A world: bodies placed on a floor, set going, and run under one of the two laws, for many draws at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from cow_service.physics.ballistic import course_of
from cow_service.physics.bodies import SeenBody
from cow_service.physics.camera import CameraFit
from cow_service.physics.draws import COLUMN
from cow_service.physics.engine import RigidShape, WorldRun, run_worlds
from cow_service.physics.lift import BOX_SIDE, FARTHEST, Cameras, Placed
from cow_service.physics.placement import (
    Placements,
    Put,
    arc,
    carried,
    classify,
    frames_carried,
    frames_to_run,
    height_over,
    let_go,
    settle,
    standing_on,
)
from cow_service.physics.placing import VEHICLE_WIDTH, PlacedScene, flies, place, speed_factors
from cow_service.records import FALLING_KINDS, Motion
from cow_service.vision.masks import Floats, Mask

FRICTION, FRICTION_SIGMA = 0.5, 0.3  # of a body; one standard deviation of the logarithm
RESTITUTION, RESTITUTION_SIGMA = 0.5, 0.15
YAW_SIGMA = 0.4  # radians: how a box is turned about the vertical
LEFT_BY = 0.2  # of the image's width: so far outside, what goes on outwards does not come back
LOOK_AHEAD = 0.01  # s
LEAST_HALF, MOST_HALF = 0.02, 60.0  # half widths and heights of bodies, in those of the mover


@dataclass(frozen=True)
class Led:
    """A path that is given, per frame of the clip: of what stands by its foot in the image, else by its positions."""

    positions: Floats  # [F, 3] m in the frame of the camera
    feet: Floats  # [F, 2] px


@dataclass(frozen=True)
class WorldInput:
    """What a world is made of. `bodies[0]` moves."""

    bodies: tuple[SeenBody, ...]
    motion: Motion
    fit: CameraFit
    size: tuple[int, int]  # px, of the image: width and height
    num_frames: int
    fps: float
    asked: int | None = None  # the body that the question is about
    led: Led | None = None  # the mover is led along a path, through everything
    others: Mapping[int, Motion] = field(default_factory=dict[int, Motion])  # of other bodies, by their places
    taken: tuple[SeenBody, ...] = ()  # placed with the others, then taken away before anything moves
    turns_wanted: bool = False  # how bodies turn is recorded of an ensemble, too
    put: Put | None = None  # the mover is carried somewhere and let go
    put_before: tuple[Put, ...] = ()  # what is put somewhere before anything moves, in this order

    @property
    def is_changed(self) -> bool:
        """Whether something is taken away, or put somewhere before anything moves."""
        return bool(self.taken or self.put_before)

    def as_it_is(self) -> WorldInput:
        """With nothing put elsewhere and nothing taken away: those things are then the last bodies."""
        return replace(self, bodies=(*self.bodies, *self.taken), taken=(), put_before=())


@dataclass(frozen=True)
class Worlds:
    """Worlds that were run: where bodies were placed, and what they did."""

    scene: PlacedScene
    shapes: tuple[tuple[RigidShape, ...], ...]  # per draw
    runs: tuple[WorldRun, ...]  # per draw
    every: int  # frames between recorded ones
    fps: float  # of the clip
    placements: Placements | None = None  # where the mover is put somewhere
    before: tuple[Placements, ...] = ()  # of what is put somewhere before anything moves
    seen: tuple[tuple[RigidShape, ...], ...] | None = None  # per draw, then: bodies as the image shows them


def run_world(given: WorldInput, draws: Floats, every: int = 1) -> Worlds:
    """Places and runs the worlds of draws [K, P], recording every `every`-th frame."""
    bodies = (*given.bodies, *given.taken)
    everything = place(bodies, given.motion, given.fit, given.size, draws, given.asked, given.others)
    scene = everything.first(len(given.bodies))
    if not given.put_before:
        return _run(given, scene, tuple(_rigid_bodies(given, scene, draws, k) for k in range(len(draws))), draws, every)
    scene = scene.rearranged(standing_on(given.put_before, scene.supports))
    seen = tuple(_rigid_bodies(given, scene, draws, k) for k in range(len(draws)))
    flying = [i for i, body in enumerate(scene.bodies) if not body.stands]
    settled = settle(given.put_before, seen, draws, given.fps, flying)
    run = _run(given, scene, settled.shapes, draws, every)
    return replace(run, before=settled.placements, seen=seen)


def _run(
    given: WorldInput, scene: PlacedScene, shapes: tuple[tuple[RigidShape, ...], ...], draws: Floats, every: int
) -> Worlds:
    """Runs worlds from where their bodies are."""
    if given.put is not None:
        return _run_put(given, given.put, scene, shapes, draws, every)
    left = partial(_has_left, scene.cameras, given.size[0])
    finished = None if len(draws) == 1 or given.motion.steps or given.others else left
    runs = run_worlds(shapes, given.num_frames, given.fps, every, finished, given.turns_wanted)
    return Worlds(scene, shapes, tuple(runs), every, given.fps)


def _run_put(
    given: WorldInput,
    put: Put,
    scene: PlacedScene,
    shapes: tuple[tuple[RigidShape, ...], ...],
    draws: Floats,
    every: int,
) -> Worlds:
    """Worlds in which the mover is carried somewhere and let go; there the engine begins."""
    count, rows = frames_carried(given.num_frames, given.fps), len(range(0, given.num_frames, every))
    ready = tuple(let_go(put, bodies, row) for bodies, row in zip(shapes, draws, strict=True))
    settled = run_worlds(ready, frames_to_run(given.num_frames, given.fps), given.fps, every, turns_wanted=True)
    found = [classify(put, *each) for each in zip(ready, settled, shapes, strict=True)]
    runs: list[WorldRun] = []
    for bodies, then, run in zip(shapes, ready, settled, strict=True):
        start, end = np.array(bodies[0].position), np.array(then[0].position)
        path = arc(start, end, height_over(then, put.targets), count, every)
        runs.append(carried(run, path, count, rows, given.fps, every))
    results, clearance, above = zip(*found, strict=True)
    told = Placements(put.relation, results, np.array(clearance), np.array(above), count / given.fps)
    hollow = tuple((before[0], *then[1:]) for before, then in zip(shapes, ready, strict=True))
    return Worlds(scene, hollow, tuple(runs), every, given.fps, told)


def _has_left(cameras: Cameras, width: int, positions: Floats, velocities: Floats) -> Mask:
    """Which movers [K] have left the image to the left or the right, and go on that way."""
    x = cameras.project(positions)[0][:, 0]
    step = cameras.project(positions + velocities * LOOK_AHEAD)[0][:, 0] - x
    return ((x < -LEFT_BY * width) & (step < 0)) | ((x > (1 + LEFT_BY) * width) & (step > 0))


def _rigid_bodies(given: WorldInput, scene: PlacedScene, draws: Floats, k: int) -> tuple[RigidShape, ...]:
    row = draws[k]
    friction = FRICTION * math.exp(FRICTION_SIGMA * row[COLUMN["friction"]])
    restitution = min(1.0, max(0.0, RESTITUTION + RESTITUTION_SIGMA * row[COLUMN["restitution"]]))
    yaw = YAW_SIGMA * float(row[COLUMN["yaw"]])
    unit = float(scene.bodies[0].half_width[k])
    low, high = LEAST_HALF * unit, MOST_HALF * unit
    bodies: list[RigidShape] = []
    for seen, placed in zip(given.bodies, scene.bodies, strict=True):
        half = float(np.clip(placed.half_width[k], low, high))
        tall = half if placed.shape == "sphere" else float(np.clip(placed.half_height[k], low, high))
        side = half if placed.shape != "box" else BOX_SIDE * half
        if given.put is not None and placed.shape == "box" and seen.equal_sided:
            side = min(max(tall, half / math.sqrt(2)), half)  # it is seen between its face's width and its diagonal
        position = placed.centre[k].tolist()
        bodies.append(
            RigidShape(
                shape=placed.shape,
                half_width=side,
                half_depth=side,
                half_height=tall,
                position=(position[0], position[1], position[2]),
                yaw=yaw if placed.shape == "box" and not seen.elongated else 0.0,
                density=seen.fullness if placed.shape == "cylinder" else 1.0,
                friction=friction,
                restitution=restitution,
                falls=placed.stands,
            )
        )
    bodies[0] = _set_going(given, scene, draws, k, bodies[0])
    for loose in scene.unsupported:
        bodies[loose] = replace(bodies[loose], starts=True)
    for i, motion in given.others.items():
        if i >= len(bodies):  # it is taken away
            continue
        factor = float(speed_factors(motion, draws[k : k + 1], "other_speed")[0])
        bodies[i] = replace(bodies[i], **_moving(given, scene, k, i, motion, (scene.others[i][k],), factor, bodies[i]))
    return tuple(bodies)


def _set_going(given: WorldInput, scene: PlacedScene, draws: Floats, k: int, body: RigidShape) -> RigidShape:
    """The mover: thrown, let go, moving by itself, or led along a path."""
    if given.led is not None:
        changes: dict[str, Any] = {"follows": _led_along(given.led, scene, k), "falls": False}
        changes |= {"velocity": tuple(scene.velocity[k].tolist()), "starts": given.motion.kind != "static"}
        return replace(body, **changes | _turned(given.bodies[0], scene.bodies[0], k, scene.velocity[k]))
    velocities = (scene.velocity[k], *(further[k] for further in scene.further))
    factor = float(speed_factors(given.motion, draws[k : k + 1])[0])
    return replace(body, **_moving(given, scene, k, 0, given.motion, velocities, factor, body))


def _moving(
    given: WorldInput,
    scene: PlacedScene,
    k: int,
    index: int,
    motion: Motion,
    velocities: Sequence[Floats],
    factor: float,
    body: RigidShape,
) -> dict[str, Any]:
    """What sets a body going: the velocities [3] of its legs, and whether it falls or glides."""
    seen, velocity = given.bodies[index], velocities[0]
    glides = motion.kind == "linear"
    changes: dict[str, Any] = {
        "velocity": tuple(velocity.tolist()),
        "starts": motion.kind != "static",
        "falls": motion.kind in FALLING_KINDS or not flies(seen, motion),
        "glides": glides,
    }
    if glides:
        changes["course"] = course_of(motion, velocities, motion.speed * factor, given.num_frames / given.fps)
    return changes | _turned(seen, scene.bodies[index], k, velocity)


def _led_along(led: Led, scene: PlacedScene, k: int) -> Floats:
    """Positions [F, 3] along a given path: on the floor for what stands there, if its foot is below the horizon."""
    mover, cameras = scene.bodies[0], scene.cameras
    height = float(cameras.height[k])
    if not mover.stands:
        return led.positions @ cameras.axes[k].T + np.array([0.0, height, 0.0])
    count = len(led.feet)
    rays = cameras.repeated(count, k).rays(led.feet)
    drop = height - mover.centre[k, 1] + mover.half_height[k]
    nearest = drop / (FARTHEST * float(np.linalg.norm(mover.centre[k, [0, 2]])))
    near = rays[:, [0, 2]] * (drop / np.maximum(-rays[:, 1], nearest))[:, None]
    way = near / np.maximum(np.linalg.norm(near, axis=1), 1e-9)[:, None]
    middle = near + way * float(mover.half_width[k]) * mover.depth_share
    return np.stack([middle[:, 0], np.full(count, mover.centre[k, 1]), middle[:, 1]], axis=1)


def _turned(seen: SeenBody, placed: Placed, k: int, velocity: Floats) -> dict[str, Any]:
    """A vehicle is a box, longer along its heading than across, as wide as it is seen; the rest is not turned."""
    if not seen.elongated or float(np.hypot(velocity[0], velocity[2])) == 0:
        return {}
    sight = placed.centre[k, [0, 2]] / np.linalg.norm(placed.centre[k, [0, 2]])
    along = abs(float(velocity[[0, 2]] @ sight)) / float(np.hypot(velocity[0], velocity[2]))
    across = math.sqrt(max(0.0, 1 - along**2))
    length = float(placed.half_width[k]) / (across + VEHICLE_WIDTH * along)
    yaw = -math.atan2(velocity[2], velocity[0])
    return {"shape": "box", "half_width": length, "half_depth": VEHICLE_WIDTH * length, "yaw": yaw}
