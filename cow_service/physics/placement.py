"""What becomes of a body that was put somewhere: in, on, over, beside, or fallen off, in each world of an ensemble.

The rule for `into`, by where things come to rest. What is wider than the opening, or whose lower end lies no more than
a tenth of the container's depth below the rim, is `on-the-rim`: it is held up there. What has gone through the opening
`sticks-out` where its upper end is higher above the rim than the container is deep, and else is `inside`. A thing fits
in the worlds in which it ends as it was meant to: inside; on top; or, beside others, without overlapping them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cow_service.physics.draws import COLUMN
from cow_service.physics.engine import BOX_SIDES, Hollow, Meeting, RigidShape, WorldRun, hollow_of, run_worlds
from cow_service.records import PlacementResult, PlaceRelation
from cow_service.vision.masks import Floats, Mask
from cow_service.vision.openings import SeenOpening

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


STICKS_OUT = 1.0  # of the container's depth: how far the upper end is above the rim
GONE_IN = 0.1  # of the container's depth: how far below the rim the lower end of what is inside is
TIPPED = math.cos(math.radians(45))  # upright component of an axis that was upright
SUNK = 0.1  # of the smaller half height: how far below a top the lower end of what lies on it may seem to be
OVERLAPPING = 0.02  # of the half width: so much too close, bodies are taken to touch, not to overlap

STAYING: tuple[PlacementResult, ...] = ("inside", "sticks-out", "on-the-rim", "on-top", "beside")
Turn = Floats  # [4] quaternion x, y, z, w


@dataclass(frozen=True)
class Placements:
    """Per draw [K], how a body ends where it was put."""

    relation: PlaceRelation
    results: tuple[PlacementResult, ...]
    clearance: Floats  # [K]: width of the opening or gap less that of the body, as a share of it; nan without one
    above_rim: Floats  # [K]: share of the body's height above the rim; nan but for `into` a container
    let_go: float  # s

    @property
    def fits(self) -> Mask:
        """[K]: whether it ends as it was meant to."""
        return np.array([result == meant(self.relation) for result in self.results])

    @property
    def stays(self) -> Mask:
        """[K]: whether it comes to rest where it was put, if not as it was meant to."""
        return np.array([result in STAYING for result in self.results])

    @property
    def times(self) -> Floats:
        """[K] s: when it is let go where it stays as it was meant to; infinite where it does not."""
        return np.where(self.fits, self.let_go, math.inf)


def meant(relation: PlaceRelation) -> PlacementResult:
    """The result that a body is put somewhere for."""
    return "inside" if relation == "into" else "on-top" if relation == "onto" else "beside"


def classify(
    put: Put, let_go: Sequence[RigidShape], run: WorldRun, lying: Sequence[RigidShape]
) -> tuple[PlacementResult, float, float]:
    """Result, clearance and share above the rim in one world.

    `let_go` are its bodies as one is let go, `lying` as they were before; `run` is what they did from then on.
    """
    target, body = put.targets[0], put.body
    if put.relation in ("into", "onto"):
        tipped = _upright(run.turns[target, -1]) < TIPPED
        if let_go[target].hollow is not None and put.relation == "into":
            return _into(put, let_go, run, tipped)
        return _onto(put, let_go, run, tipped), math.nan, math.nan
    clearance = gap(put, let_go) if put.relation == "between" else math.nan
    overlaps = (not math.isnan(clearance) and clearance < 0) or _overlaps_any(body, let_go, lying)
    tips = let_go[body].shape != "sphere" and _upright(run.turns[body, -1]) < TIPPED
    return ("overlaps" if overlaps else "tips" if tips else "beside"), clearance, math.nan


def _into(put: Put, let_go: Sequence[RigidShape], run: WorldRun, tipped: bool) -> tuple[PlacementResult, float, float]:
    body, container = let_go[put.body], let_go[put.targets[0]]
    hollow = container.hollow
    assert hollow is not None  # the caller has looked
    clearance = 1 - width_through(body, hollow) / hollow.opening
    there, middle = run.positions[put.body, -1], run.positions[put.targets[0], -1]
    rim, tall = middle[1] + container.half_height, extent(body, run.turns[put.body, -1])
    low, high = there[1] - tall, there[1] + tall
    above = float(np.clip((high - rim) / max(high - low, 1e-9), 0.0, 1.0))
    off = math.hypot(there[0] - middle[0], there[2] - middle[2])
    if off > container.half_width and low < rim:
        return ("tips" if tipped else "falls-off"), clearance, above
    if tipped:
        return "tips", clearance, above
    if clearance <= 0 or rim - low < GONE_IN * hollow.depth:
        return "on-the-rim", clearance, above
    return ("sticks-out" if high - rim > STICKS_OUT * hollow.depth else "inside"), clearance, above


def _onto(put: Put, let_go: Sequence[RigidShape], run: WorldRun, tipped: bool) -> PlacementResult:
    index = put.targets[0]
    body, target = let_go[put.body], let_go[index]
    there, middle, turn = run.positions[put.body, -1], run.positions[index, -1], run.turns[put.body, -1]
    low = there[1] - extent(body, turn)
    top = middle[1] + extent(target, run.turns[index, -1])
    off = math.hypot(there[0] - middle[0], there[2] - middle[2])
    if low < top - SUNK * min(body.half_height, target.half_height) or off > target.half_width + body.half_width:
        return "tips" if tipped and target.shape != "sphere" else "falls-off"
    if (tipped and target.shape != "sphere") or (body.shape != "sphere" and _upright(turn) < TIPPED):
        return "tips"
    return "on-top"


def width_through(body: RigidShape, hollow: Hollow) -> float:
    """Half of the width (m) with which a body goes through an opening: of a box through a round one, its diagonal."""
    if body.shape != "box":
        return body.half_width
    return (
        max(body.half_width, body.half_depth)
        if hollow.sides == BOX_SIDES
        else math.hypot(body.half_width, body.half_depth)
    )


def gap(put: Put, bodies: Sequence[RigidShape]) -> float:
    """How much of the gap between two bodies another leaves, as a share of it; negative where it is too wide."""
    first, second = (bodies[i] for i in put.targets)
    way = np.array(second.position) - np.array(first.position)
    free = math.hypot(way[0], way[2]) - first.half_width - second.half_width
    half = bodies[put.body].half_width
    return (free - 2 * half) / max(free, 1e-3 * half)


def extent(body: RigidShape, turn: Turn) -> float:
    """Half the height (m) of a body turned by a quaternion [4]."""
    if body.shape == "sphere":
        return body.half_width
    upright = abs(_upright(turn))
    if body.shape == "box":
        x, y, z, w = (float(v) for v in turn)
        across, along = 2 * (x * y + w * z), 2 * (y * z - w * x)  # how far the other two axes point up
        return upright * body.half_height + abs(across) * body.half_width + abs(along) * body.half_depth
    return upright * body.half_height + math.sqrt(max(0.0, 1 - upright**2)) * body.half_width


def _upright(turn: Turn) -> float:
    """Upright component of a body's axis."""
    x, _, z, _ = (float(v) for v in turn)
    return 1 - 2 * (x * x + z * z)


def _overlaps_any(body: int, bodies: Sequence[RigidShape], lying: Sequence[RigidShape]) -> bool:
    """Whether a body is put where another one is."""
    mover = bodies[body]
    for other in (*lying[:body], *lying[body + 1 :]):
        away = math.hypot(*(mover.position[i] - other.position[i] for i in (0, 2)))
        level = abs(mover.position[1] - other.position[1]) < mover.half_height + other.half_height
        if level and away < mover.half_width + other.half_width - OVERLAPPING * mover.half_width:
            return True
    return False


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
