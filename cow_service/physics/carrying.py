"""Where a body is put and let go; the mover is carried there in an arc, through everything."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cow_service.physics.containers import hollow_of
from cow_service.physics.draws import COLUMN
from cow_service.physics.engine import Meeting, WorldRun
from cow_service.physics.rigid import RigidShape
from cow_service.records import PlaceRelation
from cow_service.vision.openings import SeenOpening
from cow_service.vision.types import Floats

CARRIED = 1.0  # s that it takes, at most
MOST_CARRIED = 0.5  # of the clip
SETTLES = 2.0  # s, at least, for which what is let go is followed, whatever the clip shows
DROP = 0.06  # of its half width: from so high it is let go
BESIDE_GAP = 0.5  # of its half width: between it and what it is put beside
AIM_SIGMA = 0.03  # of its half width, along and across: where it is let go
AIM_OFF = 0.01  # of its half width, to the right
OFF_TOP = 0.1  # the same on a ball or a tip: nothing is put there so exactly that it stays
HIDDEN_HEIGHT = 0.5  # of a container's width: its height at least, where its foot is hidden
CLEARANCE = 0.5  # of its half width: so high it passes over what it is carried over
LEAST_RISE = 0.3  # of the way that it is carried


@dataclass(frozen=True)
class Put:
    """To what a body is put, and how."""

    relation: PlaceRelation
    targets: tuple[int, ...]  # which of the bodies: two for `between`, else one
    opening: SeenOpening | None = None  # of the target, where the body is put into it
    side: int = 1  # of `next-to`: 1 to the right as the camera sees it, -1 to the left
    body: int = 0  # which of the bodies is put there
    by_heading: bool = False  # the target sets out: in front of it is where it goes


def frames_carried(num_frames: int, fps: float) -> int:
    """Frames of a clip in which a body is carried: an even number, as worlds are recorded every second frame."""
    return 2 * max(1, int(min(CARRIED * fps, MOST_CARRIED * (num_frames - 1)) / 2))


def frames_to_run(num_frames: int, fps: float) -> int:
    """Frames for which the engine runs after that: those of the clip, and until what was let go has settled."""
    return max(num_frames - frames_carried(num_frames, fps), math.ceil(SETTLES * fps)) + 2


def let_go(put: Put, shapes: Sequence[RigidShape], row: Floats) -> tuple[RigidShape, ...]:
    """The bodies of one world at the moment at which one is let go; `row` [P] is the draw of the world.

    A container that it is put into becomes hollow.
    """
    bodies = list(shapes)
    if put.opening is not None:
        target = _whole(bodies[put.targets[0]], put.opening)
        hollow = hollow_of(put.opening, target.half_width, target.half_height, row)
        bodies[put.targets[0]] = replace(target, hollow=hollow)
    mover = bodies[put.body]
    x, y, z = _end(put, bodies)
    aim = mover.half_width * AIM_SIGMA
    tip = put.relation == "onto" and bodies[put.targets[0]].shape in ("sphere", "cone")
    x += mover.half_width * (OFF_TOP if tip else AIM_OFF) + aim * float(row[COLUMN["let_go_right"]])
    z += aim * float(row[COLUMN["let_go_ahead"]])
    still = (0.0, 0.0, 0.0)
    bodies[put.body] = replace(mover, position=(x, y, z), velocity=still, starts=True, falls=True, glides=False)
    return tuple(bodies)


def _whole(target: RigidShape, seen: SeenOpening) -> RigidShape:
    """A container whose foot is hidden is at least as high as common ones of its width."""
    half = max(target.half_height, HIDDEN_HEIGHT * target.half_width) if seen.foot_hidden else target.half_height
    x, y, z = target.position
    return replace(target, half_height=half, position=(x, y + half - target.half_height, z))


def _end(put: Put, bodies: Sequence[RigidShape]) -> tuple[float, float, float]:
    """Where the middle of a body is let go (m)."""
    mover, target = bodies[put.body], bodies[put.targets[0]]
    up = mover.half_height + DROP * mover.half_width
    x, y, z = target.position
    if put.relation in ("into", "onto"):
        return x, y + target.half_height + up, z
    bottom = max(0.0, y - target.half_height)
    if put.relation == "between":
        other = bodies[put.targets[1]].position
        return (x + other[0]) / 2, bottom + up, (z + other[2]) / 2
    right, ahead = _side(put, target)
    away = _reach(target, right, ahead) + _reach(mover, right, ahead) + BESIDE_GAP * mover.half_width
    return x + away * right, bottom + up, z + away * ahead


def _side(put: Put, target: RigidShape) -> tuple[float, float]:
    """The unit vector right and ahead on which side of a target a body is put: as the camera sees it, or as it goes."""
    x, _, z = target.position
    speed = math.hypot(target.velocity[0], target.velocity[2])
    if put.by_heading and speed > 0:
        sign = 1.0 if put.relation == "in-front-of" else -1.0
        return sign * target.velocity[0] / speed, sign * target.velocity[2] / speed
    distance = max(math.hypot(x, z), 1e-9)
    sight, across = (x / distance, z / distance), (z / distance, -x / distance)
    if put.relation in ("in-front-of", "behind"):
        sign = -1.0 if put.relation == "in-front-of" else 1.0
        return sign * sight[0], sign * sight[1]
    sign = {"left-of": -1.0, "right-of": 1.0}.get(put.relation, float(put.side))
    return sign * across[0], sign * across[1]


def _reach(body: RigidShape, right: float, ahead: float) -> float:
    """Half the extent of a body over the floor along a unit vector."""
    if body.shape != "box":
        return body.half_width
    cosine, sine = math.cos(body.yaw), math.sin(body.yaw)
    along, across = cosine * right - sine * ahead, sine * right + cosine * ahead
    return abs(along) * body.half_width + abs(across) * body.half_depth


def arc(start: Floats, end: Floats, over: float, frames: int, every: int) -> Floats:
    """Positions [R, 3] of every `every`-th frame from one point [3] to another: up, over, and down.

    A Bezier curve that leaves and arrives upright and rises `over` a height (m) in its middle.
    """
    way = math.hypot(end[0] - start[0], end[2] - start[2])
    rise = max(over - (start[1] + end[1]) / 2, LEAST_RISE * way, 1e-6) * 4 / 3
    high = np.array([0.0, rise, 0.0])
    t = (np.arange(0, frames, every) / frames)[:, None]
    t = t * t * (3 - 2 * t)  # it sets out and arrives at rest
    return (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * (start + high) + 3 * (1 - t) * t**2 * (end + high) + t**3 * end


def height_over(bodies: Sequence[RigidShape], targets: Sequence[int]) -> float:
    """The height (m) at which the middle of the first body passes over its targets."""
    mover = bodies[0]
    top = max(bodies[i].position[1] + bodies[i].half_height for i in targets)
    return top + mover.half_height + CLEARANCE * mover.half_width


def carried(run: WorldRun, path: Floats, frames: int, rows: int, fps: float, every: int) -> WorldRun:
    """A run from the moment of letting go, with the way there [R, 3] before it, and `rows` recorded frames in all."""
    before = len(path)
    step = every / fps

    def after(values: Floats, still: Floats) -> Floats:
        lead = np.repeat(still[:, None], before, axis=1)
        return np.concatenate([lead, values], axis=1)[:, :rows]

    positions = after(run.positions, run.positions[:, 0])
    velocities = after(run.velocities, np.zeros_like(run.velocities[:, 0]))
    shown = min(before, rows)
    positions[0, :shown] = path[:shown]
    velocities[0, :shown] = np.gradient(path, step, axis=0)[:shown] if before > 1 else 0.0
    start = frames / fps
    meetings = [Meeting(start + each.time, each.a, each.b, each.impulse) for each in run.meetings]
    last = (rows - 1) * step
    shown_meetings = [each for each in meetings if each.time <= last + 1e-9]
    return WorldRun(positions, velocities, after(run.turns, run.turns[:, 0]), shown_meetings, run.moved)
