"""What happens to a body that was put somewhere: in, on, over, beside, or fallen off, in each world of an ensemble.

The rule for `into`, by where things come to rest. What is wider than the opening, or whose lower end lies no more than
a tenth of the container's depth below the rim, is `on-the-rim`: it is held up there. What has gone through the opening
`sticks-out` where its upper end is higher above the rim than the container is deep, and else is `inside`. A thing fits
in the worlds in which it ends as it was meant to: inside; on top; or, beside others, without overlapping them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from cow_service.media.types import Floats, Mask
from cow_service.physics.bodies import SeenOpening
from cow_service.physics.draws import COLUMN
from cow_service.physics.engine import BOX_SIDES, ROUND_SIDES, TIPPED, Hollow, RigidShape, WorldRun, run_worlds
from cow_service.records import PlacementResult, PlaceRelation


class Placing(NamedTuple):
    """How things are put somewhere, and what counts as being there."""

    carried: float = 1.0  # s that it takes, at most
    most_carried: float = 0.5  # of the clip
    settles: float = 2.0  # s, at least, for which what is released is followed, whatever the clip shows
    drop: float = 0.06  # of its half width: from so high it is released
    beside_gap: float = 0.5  # of its half width: the gap to the object that it is put next to
    width_sigma: float = 0.08  # of the logarithm of a body's width against that of an opening
    turned_sigma: float = 0.25
    aim_sigma: float = 0.03  # of its half width, along and across: where it is released
    aim_off: float = 0.01  # of its half width, to the right
    off_top: float = 0.1  # the same on a ball or a tip: nothing is put there so exactly that it stays
    hidden_height: float = 0.5  # of a container's width: its height at least, where its foot is hidden
    clearance: float = 0.5  # of its half width: the height at which it passes over objects
    least_rise: float = 0.3  # of the way that it is carried
    sticks_out: float = 1.0  # of the container's depth: how far the upper end is above the rim
    gone_in: float = 0.1  # of the container's depth: how far below the rim the lower end of what is inside is
    sunk: float = 0.1  # of the smaller half height: how far below a top the lower end of what lies on it may seem to be
    thinnest: float = 0.03  # of the half width: a thinner wall would let fast things through
    least_opening: float = 0.3  # of the half width
    floor_share: float = 0.08  # of the height: how thick the floor of a container is
    narrowest: float = 0.3  # of the opening: its floor
    overlapping: float = 0.02  # of the half width: bodies that overlap less than this are taken to touch


PLACING = Placing()


STAYING: tuple[PlacementResult, ...] = ("inside", "sticks-out", "on-the-rim", "on-top", "beside")
Shapes = tuple[RigidShape, ...]  # the bodies of one world


@dataclass(frozen=True)
class PlacementGoal:
    """To what a body is put, and how."""

    relation: PlaceRelation
    targets: tuple[int, ...]  # which of the bodies: two for `between`, else one
    opening: SeenOpening | None = None  # of the target, where the body is put into it
    side: int = 1  # of `next-to`: 1 to the right as the camera sees it, -1 to the left
    body: int = 0  # which of the bodies is put there
    by_heading: bool = False  # the target sets out: in front of it is where it goes
    place: str = ""  # in words, such as "between the bowl and the cone"

    @property
    def meant(self) -> PlacementResult:
        """The result that the body is put there for."""
        return "inside" if self.relation == "into" else "on-top" if self.relation == "onto" else "beside"


@dataclass(frozen=True)
class Placements:
    """Per draw [K], how a body ends where it was put."""

    meant: PlacementResult
    results: tuple[PlacementResult, ...]
    clearance: Floats  # [K]: width of the opening or gap less that of the body, as a share of it; nan without one
    above_rim: Floats  # [K]: share of the body's height above the rim; nan but for `into` a container
    released: float  # s

    def joined(self, other: Placements) -> Placements:
        """With those of more draws."""
        clearance, above = (
            np.concatenate(both) for both in ((self.clearance, other.clearance), (self.above_rim, other.above_rim))
        )
        return replace(self, results=(*self.results, *other.results), clearance=clearance, above_rim=above)

    @property
    def fits(self) -> Mask:
        """[K]: whether it ends as it was meant to."""
        return np.array([result == self.meant for result in self.results])

    @property
    def stays(self) -> Mask:
        """[K]: whether it comes to rest where it was put, if not as it was meant to."""
        return np.array([result in STAYING for result in self.results])

    @property
    def times(self) -> Floats:
        """[K] s: when it is released where it stays as it was meant to; infinite where it does not."""
        return np.where(self.fits, self.released, math.inf)


@dataclass(frozen=True)
class Settled:
    """Worlds in which bodies were put somewhere, as the motion begins."""

    shapes: tuple[Shapes, ...]  # per draw
    placements: tuple[Placements, ...]  # per put body, in their order


def carry(
    goal: PlacementGoal,
    shapes: Sequence[Shapes],
    draws: Floats,
    seconds: float,
    num_frames: int,
    fps: float,
    every: int,
) -> tuple[tuple[Shapes, ...], tuple[WorldRun, ...], Placements]:
    """Runs worlds of draws [K, P] in which a body is carried to its goal and released there: there the engine begins.

    The way takes about so many seconds.
    The bodies as they are when the clip begins, what they do in it, and what becomes of the one that is carried.
    """
    # An even number of frames, as worlds are recorded every second frame.
    carried = 2 * max(1, int(seconds * fps / 2))
    to_run, rows = max(num_frames - carried, math.ceil(PLACING.settles * fps)) + 2, len(range(0, num_frames, every))
    released = [_released(goal, bodies, row) for bodies, row in zip(shapes, draws, strict=True)]
    settled = run_worlds(released, to_run, fps, every, turns_wanted=True)
    found = [classify(goal, *each) for each in zip(released, settled, shapes, strict=True)]
    share = (np.arange(0, carried, every) / carried)[:, None]
    share, step = share * share * (3 - 2 * share), every / fps  # it sets out and arrives at rest
    shown, last = min(len(share), rows), (rows - 1) * step + 1e-9

    def after_way(values: Floats, still: Floats) -> Floats:
        """Values [B, F, D] with those of the way before them."""
        return np.concatenate([np.repeat(still[:, None], len(share), axis=1), values], axis=1)[:, :rows]

    runs: list[WorldRun] = []
    for bodies, then, run in zip(shapes, released, settled, strict=True):
        body = then[goal.body]
        # A Bezier curve up, over and down that leaves and arrives upright and passes over the objects on the way.
        start, end = np.array(bodies[goal.body].position), np.array(body.position)
        top = max(then[i].position[1] + then[i].half_height for i in goal.targets)
        over = top + body.half_height + PLACING.clearance * body.half_width - (start[1] + end[1]) / 2
        rise = max(over, PLACING.least_rise * math.hypot(end[0] - start[0], end[2] - start[2]), 1e-6) * 4 / 3
        high, rest = np.array([0.0, rise, 0.0]), 1 - share
        way = (
            rest**3 * start + 3 * rest**2 * share * (start + high) + 3 * rest * share**2 * (end + high) + share**3 * end
        )
        positions = after_way(run.positions, run.positions[:, 0])
        velocities = after_way(run.velocities, np.zeros_like(run.velocities[:, 0]))
        positions[goal.body, :shown] = way[:shown]
        velocities[goal.body, :shown] = np.gradient(way, step, axis=0)[:shown] if len(way) > 1 else 0.0
        meetings = [replace(each, time=carried / fps + each.time) for each in run.meetings]
        turns = after_way(run.turns, run.turns[:, 0])
        runs.append(WorldRun(positions, velocities, turns, [m for m in meetings if m.time <= last], run.moved))
    begun = tuple((before[0], *then[1:]) for before, then in zip(shapes, released, strict=True))
    results, clearance, above = zip(*found, strict=True)
    return begun, tuple(runs), Placements(goal.meant, results, np.array(clearance), np.array(above), carried / fps)


def settle(
    goals: Sequence[PlacementGoal], shapes: Sequence[Shapes], draws: Floats, fps: float, flying: Collection[int] = ()
) -> Settled:
    """Releases one body after the other in the worlds of draws [K, P]; nothing else moves until all are at rest.

    What is `flying` hangs in the air meanwhile. A body that reaches beyond its middle overlaps it; above one that does
    not it makes room, so that nothing begins inside another thing.
    """
    frames = math.ceil(PLACING.settles * fps) + 2
    still = {"starts": False, "glides": False, "course": None, "follows": None}
    current: list[Shapes] = [
        tuple(
            replace(body, **still, ghost=i in flying, falls=body.falls and i not in flying)
            for i, body in enumerate(bodies)
        )
        for bodies in shapes
    ]
    placements, free = list[Placements](), [i for i in flying if shapes[0][i].follows is None]
    for goal in goals:
        released = [_released(goal, bodies, row) for bodies, row in zip(current, draws, strict=True)]
        runs = run_worlds(released, frames, fps, frames - 1, turns_wanted=True)
        found = [classify(goal, *each) for each in zip(released, runs, current, strict=True)]
        current = [_at_rest(bodies, run) for bodies, run in zip(released, runs, strict=True)]
        ends, clearance, above = zip(*found, strict=True)
        results: tuple[PlacementResult, ...] = tuple(
            "overlaps" if any(bodies[goal.body].holds_middle_of(bodies[i]) for i in flying) else end
            for bodies, end in zip(current, ends, strict=True)
        )
        current = [_made_room(bodies, goal.body, free) for bodies in current]
        placements.append(Placements(goal.meant, results, np.array(clearance), np.array(above), 0.0))
    put_bodies = {goal.body for goal in goals}
    begun = (_settled(*pair, put_bodies) for pair in zip(shapes, current, strict=True))
    return Settled(tuple(begun), tuple(placements))


def _settled(bodies: Shapes, resting: Shapes, put: Collection[int]) -> Shapes:
    """Bodies as they set out, where they have come to rest, and as large and hollow as they are there."""
    names = ("position", "turn", "half_width", "half_depth", "half_height", "hollow")
    changes = [{name: getattr(rest, name) for name in names} for rest in resting]
    pairs = enumerate(zip(bodies, changes, strict=True))
    return tuple(replace(body, falls=i in put or body.falls, **change) for i, (body, change) in pairs)


def new_supports(goals: Sequence[PlacementGoal], supports: Sequence[int | None]) -> Mapping[int, int | None]:
    """The support of each put body at its new place: its target, or the target's support if it is put next to that."""
    found: dict[int, int | None] = {}
    for goal in goals:
        target = goal.targets[0]
        under = found.get(target, supports[target])
        found[goal.body] = target if goal.relation in ("into", "onto") else None if under == goal.body else under
    return found


def hollow_of(seen: SeenOpening, half_width: float, half_height: float, row: Floats) -> Hollow:
    """The space inside a body of outer half width and height (m), as a draw [P] has the width of the opening."""
    drawn = seen.inner * math.exp(seen.deviation * float(row[COLUMN["opening"]]))
    opening = half_width * min(max(drawn, PLACING.least_opening), 1 - PLACING.thinnest)
    wall = half_width - opening
    bottom = min(opening, max(PLACING.narrowest * opening, seen.bottom * half_width - wall))
    sides = BOX_SIDES if seen.square else ROUND_SIDES
    return Hollow(opening, bottom, 2 * half_height * (1 - PLACING.floor_share), sides)


def _released(goal: PlacementGoal, shapes: Shapes, row: Floats) -> Shapes:
    """The bodies of one world at the moment at which one is released; `row` [P] is the draw of the world.

    A container that it is put into becomes hollow.
    """
    bodies = list(shapes)
    if goal.opening is not None:
        target = bodies[goal.targets[0]]
        # A container whose foot is hidden is at least as high as common ones of its width.
        least = PLACING.hidden_height * target.half_width if goal.opening.foot_hidden else 0.0
        half, (x, y, z) = max(target.half_height, least), target.position
        hollow = hollow_of(goal.opening, target.half_width, half, row)
        whole = replace(target, half_height=half, position=(x, y + half - target.half_height, z), hollow=hollow)
        bodies[goal.targets[0]] = whole
    body = bodies[goal.body]
    if goal.opening is not None:
        # Its width relative to the opening is measured by two outlines at two depths, for a box by a corner that turns.
        sigma = PLACING.turned_sigma if body.shape == "box" and not goal.opening.square else PLACING.width_sigma
        wider = math.exp(sigma * float(row[COLUMN["outline"]]))
        sides = {name: wider * getattr(body, name) for name in ("half_width", "half_depth")}
        round_too = {"half_height": wider * body.half_height} if body.shape == "sphere" else {}
        bodies[goal.body] = body = replace(body, **sides, **round_too)
    x, y, z = _place_of_release(goal, bodies)
    aim = body.half_width * PLACING.aim_sigma
    tip = goal.relation == "onto" and bodies[goal.targets[0]].shape in ("sphere", "cone")
    x += body.half_width * (PLACING.off_top if tip else PLACING.aim_off) + aim * float(row[COLUMN["let_go_right"]])
    z += aim * float(row[COLUMN["let_go_ahead"]])
    still = (0.0, 0.0, 0.0)
    bodies[goal.body] = replace(body, position=(x, y, z), velocity=still, starts=True, falls=True, glides=False)
    return tuple(bodies)


def _place_of_release(goal: PlacementGoal, bodies: Sequence[RigidShape]) -> tuple[float, float, float]:
    """Where the middle of a body is released (m)."""
    body, target = bodies[goal.body], bodies[goal.targets[0]]
    up = body.half_height + PLACING.drop * body.half_width
    x, y, z = target.position
    if goal.relation in ("into", "onto"):
        return x, y + target.half_height + up, z
    bottom = max(0.0, y - target.half_height)
    if goal.relation == "between":
        other = bodies[goal.targets[1]].position
        return (x + other[0]) / 2, bottom + up, (z + other[2]) / 2
    # The side of the target, as a unit vector right and ahead: as the camera sees it, or as the target goes.
    speed, distance = math.hypot(target.velocity[0], target.velocity[2]), max(math.hypot(x, z), 1e-9)
    sign = {"in-front-of": -1.0, "behind": 1.0, "left-of": -1.0, "right-of": 1.0}.get(goal.relation, float(goal.side))
    if goal.by_heading and speed > 0:
        right, ahead = -sign * target.velocity[0] / speed, -sign * target.velocity[2] / speed
    elif goal.relation in ("in-front-of", "behind"):
        right, ahead = sign * (x / distance), sign * (z / distance)
    else:
        right, ahead = sign * (z / distance), sign * (-x / distance)
    away = _reach(target, right, ahead) + _reach(body, right, ahead) + PLACING.beside_gap * body.half_width
    return x + away * right, bottom + up, z + away * ahead


def _reach(body: RigidShape, right: float, ahead: float) -> float:
    """Half the extent of a body over the floor along a unit vector."""
    if body.shape != "box":
        return body.half_width
    cosine, sine = math.cos(body.yaw), math.sin(body.yaw)
    along, across = cosine * right - sine * ahead, sine * right + cosine * ahead
    return abs(along) * body.half_width + abs(across) * body.half_depth


def classify(
    goal: PlacementGoal, released: Sequence[RigidShape], run: WorldRun, lying: Sequence[RigidShape]
) -> tuple[PlacementResult, float, float]:
    """Result, clearance and share above the rim in one world.

    `released` are its bodies as one is released, `lying` as they were before; `run` is what they did from then on.
    """
    if goal.relation in ("into", "onto"):
        return _on_target(goal, released, run)
    body = goal.body
    clearance = math.nan
    if goal.relation == "between":
        first, second = (released[i] for i in goal.targets)
        way, half = np.array(second.position) - np.array(first.position), released[body].half_width
        free = math.hypot(way[0], way[2]) - first.half_width - second.half_width
        clearance = (free - 2 * half) / max(free, 1e-3 * half)
    here, overlaps = released[body], clearance < 0
    for other in (*lying[:body], *lying[body + 1 :]):
        right, ahead = (here.position[i] - other.position[i] for i in (0, 2))
        away = max(math.hypot(right, ahead), 1e-9)
        reach = _reach(here, right / away, ahead / away) + _reach(other, right / away, ahead / away)
        level = abs(here.position[1] - other.position[1]) < here.half_height + other.half_height
        overlaps |= level and away < reach - PLACING.overlapping * here.half_width
    if overlaps:
        return "overlaps", clearance, math.nan
    tips = released[body].shape != "sphere" and _upright(run.turns[body, -1]) < TIPPED
    return ("tips" if tips else "beside"), clearance, math.nan


def _on_target(
    goal: PlacementGoal, released: Sequence[RigidShape], run: WorldRun
) -> tuple[PlacementResult, float, float]:
    """As `classify`, for bodies put into or onto something."""
    body, target = released[goal.body], released[goal.targets[0]]
    (there, turn), (middle, lean) = ((run.positions[i, -1], run.turns[i, -1]) for i in (goal.body, goal.targets[0]))
    tall, tipped = _half_height(body, turn), _upright(lean) < TIPPED
    low, high = there[1] - tall, there[1] + tall
    off = math.hypot(there[0] - middle[0], there[2] - middle[2])
    if target.hollow is not None and goal.relation == "into":
        rim = middle[1] + target.half_height
        clearance, above = 1 - _half_across(body, target.hollow) / target.hollow.opening, (high - rim) / (high - low)
        result = _in_container(target, tipped, clearance, low - rim, high - rim, off)
        return result, clearance, float(np.clip(above, 0.0, 1.0))
    tipped &= target.shape != "sphere"
    sunk = low < middle[1] + _half_height(target, lean) - PLACING.sunk * min(body.half_height, target.half_height)
    if sunk or off > target.half_width + body.half_width:
        return ("tips" if tipped else "falls-off"), math.nan, math.nan
    tipped |= body.shape != "sphere" and _upright(turn) < TIPPED
    return ("tips" if tipped else "on-top"), math.nan, math.nan


def _half_across(body: RigidShape, hollow: Hollow) -> float:
    """Half the width with which a body goes through an opening: of a box through a round one, its diagonal."""
    if body.shape != "box":
        return body.half_width
    is_square = hollow.sides == BOX_SIDES
    return max(body.half_width, body.half_depth) if is_square else math.hypot(body.half_width, body.half_depth)


def _in_container(
    target: RigidShape, is_tipped: bool, clearance: float, low: float, high: float, off: float
) -> PlacementResult:
    """What becomes of a body whose ends are so far above the rim of a container, and so far off its axis (m)."""
    depth = 0.0 if target.hollow is None else target.hollow.depth
    if is_tipped:
        return "tips"
    if off > target.half_width and low < 0:
        return "falls-off"
    if clearance <= 0 or -low < PLACING.gone_in * depth:
        return "on-the-rim"
    return "sticks-out" if high > PLACING.sticks_out * depth else "inside"


def _half_height(body: RigidShape, turn: Floats) -> float:
    """Half the height (m) of a body turned by a quaternion [4] (x, y, z, w)."""
    if body.shape == "sphere":
        return body.half_width
    upright = abs(_upright(turn))
    if body.shape == "box":
        x, y, z, w = (float(v) for v in turn)
        across, along = 2 * (x * y + w * z), 2 * (y * z - w * x)  # how far the other two axes point up
        return upright * body.half_height + abs(across) * body.half_width + abs(along) * body.half_depth
    return upright * body.half_height + math.sqrt(max(0.0, 1 - upright**2)) * body.half_width


def _upright(turn: Floats) -> float:
    """Upright component of a body's axis."""
    x, _, z, _ = (float(v) for v in turn)
    return 1 - 2 * (x * x + z * z)


def _at_rest(bodies: Shapes, run: WorldRun) -> Shapes:
    """Bodies where they are at the end of a run."""
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
