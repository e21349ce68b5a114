"""Runs worlds of rigid bodies on a floor with Rapier: bounces, pushes, rolling, tipping, coming to rest.

Many worlds run in one engine, side by side on one floor and apart, because a step of the engine costs less than
reading its results: those are kept as they come, and made arrays of every few frames. Coordinates are metres right,
above the floor and ahead. Inside the engine lengths are scaled so that bodies have the size for which its tolerances
are made; gravity is scaled alike, so that times stay seconds.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import rapier3d as rapier
from numpy.typing import NDArray

from cow_service.concurrency import on_one_core
from cow_service.media.types import Floats, Mask
from cow_service.physics.ballistic import GRAVITY, Course
from cow_service.records import Shape

ROUND_SIDES = 16  # wall segments of a round container: the opening is wider by at most 2% at their joints
BOX_SIDES = 4


@dataclass(frozen=True)
class Hollow:
    """The space inside a body. Its outer sizes are those of the body, at its rim."""

    opening: float  # m: inner radius at the rim; of a box half the inner side
    bottom: float  # m: the same at the floor
    depth: float  # m: from the rim down to the floor
    sides: int = ROUND_SIDES


RESTS = 0.3  # of the lower body's half height: how far apart the ends of two bodies may be that stand on each other


@dataclass(frozen=True)
class RigidShape:
    """A body of one world at its start. Of a pair that touches, restitution and friction are the products."""

    shape: Shape
    half_width: float  # m: the radius of a sphere, cylinder or cone, half the length of a box
    half_depth: float  # m: half the breadth of a box, else the half width
    half_height: float  # m: of a sphere, its radius
    position: tuple[float, float, float]  # of its centre
    yaw: float = 0.0  # radians about the vertical
    turn: tuple[float, float, float, float] | None = None  # quaternion x, y, z, w, where it is not turned by yaw alone
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s
    density: float = 1.0  # against that of the others
    friction: float = 0.5
    restitution: float = 0.5
    starts: bool = False  # it is set in motion or released; others sleep until they are touched
    glides: bool = False  # keeps its velocity, without friction, until it meets another body
    falls: bool = True  # gravity acts on it
    ghost: bool = False  # passes through everything, but its meetings are recorded
    course: Course | None = None  # of what glides: its legs, and where it stops
    hollow: Hollow | None = None  # it is an open container
    middle: float | None = None  # height of a solid body's centre of mass, of its height; None: as of one stuff
    base: float = 1.0  # width on which a cylinder stands, of its width
    waist: float = 0.0  # height up to which it is that narrow, of its height
    fixed: bool = False  # nothing moves it
    absent: bool = False  # it was taken away: nothing meets it
    pieces: tuple[Floats, ...] = ()  # corners [N, 2] of its convex parts, m right of its centre and above it
    follows: Floats | None = field(default=None, compare=False)  # [F, 3] m: it is led along these positions

    @property
    def is_active(self) -> bool:
        """Whether it moves by itself."""
        return self.starts or self.follows is not None

    @property
    def is_ghostly(self) -> bool:
        """Whether it passes through everything."""
        return self.ghost or self.follows is not None

    @property
    def slow(self) -> float:
        """The speed (m/s) below which it is at rest; what glides slowly from the start is not."""
        glides = math.hypot(*self.velocity) if self.glides else 0.0
        return min(AT_REST * self.half_width, glides / 2) if glides else AT_REST * self.half_width

    @property
    def rotation(self) -> tuple[float, float, float]:
        """Its axis times its angle, radians."""
        if self.turn is None:
            return 0.0, self.yaw, 0.0
        a, b, c, w = self.turn
        length = math.sqrt(a * a + b * b + c * c)
        angle = 2 * math.atan2(length, w) / max(length, 1e-12)
        return a * angle, b * angle, c * angle

    def stands_on(self, other: RigidShape) -> bool:
        """Whether its lower end is, at the start, about where the upper end of another body is."""
        low, top = self.position[1] - self.half_height, other.position[1] + other.half_height
        return abs(low - top) < RESTS * min(self.half_height, other.half_height)

    def holds_middle_of(self, other: RigidShape) -> bool:
        """Whether the middle of another body lies inside it, if it stands upright."""
        right, up, ahead = (there - here for there, here in zip(other.position, self.position, strict=True))
        return abs(up) < self.half_height and math.hypot(right, ahead) < self.half_width


ENGINE_SIZE = 0.15  # m inside the engine: half the width of the first body of the first world
SPACING = 24.0  # m inside the engine, between worlds
COLOURS = 5  # worlds this many places apart, along and across, share a collision group
REACH = 0.9 * COLOURS * SPACING / 2  # m inside the engine: what would get further away is taken out
CHECKED = 4  # recorded frames after which it is asked what is far away, finished, or at rest
LEAST_STEPS, LEAST_STEPS_OF_MANY = 60.0, 30.0  # steps per second, at least, of a world alone and of many
FLOOR_RESTITUTION, FLOOR_FRICTION = 0.5, 0.5
MOST_GRAVITY = 500.0  # m/s^2 inside the engine: what is smaller than 3 mm would sink into the floor between two steps
FORESEEN = 10.0  # m inside the engine, at most: contacts are found that far ahead of what is fast
GAP = 1e-3  # m inside the engine: height above its support at which a body starts
FLOOR = (-1, -1)  # its owner
LEAST_WAIST = 0.05  # of the height: a thinner foot would let its edge through the floor
AT_REST = 0.05  # of a body's half width, per second: what moves more slowly is at rest
TIPPED = math.cos(math.radians(45))  # upright component of an axis: with less it has tipped over
AT_START = 0.1  # s: what stands on a body meets it then, which is no end of gliding over it


@dataclass(frozen=True)
class Meeting:
    """Two bodies of one world begin to touch; `b` is None for the floor."""

    time: float  # s
    a: int
    b: int | None
    impulse: float  # m/s: the change of the velocity of `a` by it


@dataclass
class WorldRun:
    """What the bodies of one world did, per recorded frame."""

    positions: Floats  # [B, F, 3] m
    velocities: Floats  # [B, F, 3] m/s
    turns: Floats  # [B, F, 4] quaternions x, y, z, w
    meetings: list[Meeting]
    moved: set[int]  # bodies that did not stay where they were

    def cut(self, frames: int, until: float = math.inf) -> WorldRun:
        """So many recorded frames of it, the last one repeated as needed, with the meetings up to a time (s)."""
        rows = np.minimum(np.arange(frames), self.positions.shape[1] - 1)
        met = [each for each in self.meetings if each.time <= until]
        return WorldRun(self.positions[:, rows], self.velocities[:, rows], self.turns[:, rows], met, self.moved)


Finished = Callable[[Floats, Floats], Mask]
"""Which worlds [K] may stop now, by positions and velocities [K, 3] (m, m/s) of their first bodies."""


def run_worlds(
    worlds: Sequence[Sequence[RigidShape]],
    num_frames: int,
    fps: float,
    every: int = 1,
    finished: Finished | None = None,
    turns_wanted: bool = False,
    until_rest: bool = False,
    path_fps: float | None = None,
) -> list[WorldRun]:
    """Runs worlds for a number of frames, recording every `every`-th. All have the same number of bodies.

    With more than one world, impulses are not recorded, nor turns where they are not wanted, and worlds that are
    finished go on in a straight line. `until_rest`: fewer frames are recorded where from some frame on nothing moves
    that is not finished. `path_fps` is the rate of the positions that bodies follow, by default that of the frames.

    The same input gives the same output, bit by bit.
    """
    with on_one_core():  # steps run in a thread of the engine: to wake it on another core takes longer than a step
        return _Engine(worlds, num_frames, fps, every, finished, turns_wanted, path_fps or fps).run(until_rest)


class _Engine:
    """One run. Bodies are named by their world and their place in it."""

    def __init__(
        self,
        worlds: Sequence[Sequence[RigidShape]],
        num_frames: int,
        fps: float,
        every: int,
        finished: Finished | None,
        turns_wanted: bool,
        path_fps: float,
    ) -> None:
        self.worlds, self.fps, self.every, self.finished, self.path_fps = worlds, fps, every, finished, path_fps
        self.is_alone = len(worlds) == 1
        self.records_turns = turns_wanted or self.is_alone
        self.frames = range(0, num_frames, every)
        self.substeps = max(1, math.ceil((LEAST_STEPS if self.is_alone else LEAST_STEPS_OF_MANY) / fps))
        self.scale = ENGINE_SIZE / worlds[0][0].half_width
        self.world = _empty_world(self.scale, 1 / (fps * self.substeps))
        self.collector = rapier.ChannelEventCollector()
        self.world.event_handler = self.collector  # pyright: ignore[reportAttributeAccessIssue]
        self.owner: dict[int, tuple[int, int]] = {}  # world and body by the collider's index
        self.cells = _Cells.of(worlds, self.scale)
        everything = {(k, i): body for k, bodies in enumerate(worlds) for i, body in enumerate(bodies)}
        steps = (np.arange((num_frames - 1) * self.substeps) + 1) / (fps * self.substeps)  # s, at their ends
        self.followers = {
            (k, i): _along(body.follows, steps * path_fps) * self.scale + self.cells.origin[k]
            for (k, i), body in everything.items()
            if body.follows is not None
        }
        self.courses = {which: body.course for which, body in everything.items() if body.course is not None}
        self.turns_of_courses = sorted({time for course in self.courses.values() for time in course.ends})
        self.bodies = [[self.add(k, i, body) for i, body in enumerate(bodies)] for k, bodies in enumerate(worlds)]
        shape = len(worlds), len(worlds[0]), len(self.frames)
        self.positions, self.velocities, self.turns = (np.zeros((*shape, size)) for size in (3, 3, 4))
        self.meetings: dict[int, list[Meeting]] = defaultdict(list)  # by world
        self.awake = [{i for i, body in enumerate(bodies) if body.is_active} for bodies in worlds]
        slow = np.array([body.slow for body in everything.values()])
        self.slow = slow.reshape(shape[:2])  # [K, B] m/s: less is at rest
        self.drift = np.zeros(shape[:2], bool)  # taken out: they go on in a straight line
        self.touching: dict[tuple[int, int], set[int]] = defaultdict(set)  # by world and body: its others
        self.joined = Counter[frozenset[tuple[int, int]]]()  # pairs of colliders that touch, per pair of bodies
        self.recorded: _Recorded | None = None  # None: another body moves since the last frame
        self.kept: list[_Frame] = []  # what was recorded since the last check

    def run(self, until_rest: bool) -> list[WorldRun]:
        self.record(_Recorded.of(self.bodies, [set(range(len(bodies))) for bodies in self.worlds], self.drift))
        self.check(0)
        row, last, checked = 0, len(self.frames) - 1, 0
        while row < last:
            self.advance(self.frames[row])
            row += 1
            if self.recorded is None:
                self.recorded = _Recorded.of(self.bodies, self.awake, self.drift)
            self.record(self.recorded)
            if row - checked == CHECKED or row == last:
                self.check(row)
                checked = row
                if until_rest and self.is_at_rest(row):
                    break
        positions, velocities, turns = (v[:, :, : row + 1] for v in (self.positions, self.velocities, self.turns))
        return [
            WorldRun(positions[k], velocities[k], turns[k], self.meetings[k], set(self.awake[k]))
            for k in range(len(self.worlds))
        ]

    def is_at_rest(self, row: int) -> bool:
        """Whether nothing moves that is not taken out, and nothing will set out any more."""
        if self.followers or self.courses or row < 2:
            return False
        still = np.linalg.norm(self.velocities[:, :, row], axis=2) < self.slow
        still &= np.linalg.norm(self.velocities[:, :, row - 1], axis=2) < self.slow
        return bool((still | self.drift).all())

    def add(self, k: int, i: int, body: RigidShape) -> rapier.RigidBody:
        """Adds a body; what neither moves nor is touched costs nothing."""
        x, y, z = (np.array(body.position) * self.scale + self.cells.origin[k]).tolist()
        builder = rapier.RigidBody.fixed() if body.fixed else rapier.RigidBody.dynamic()
        if body.follows is not None:
            builder = rapier.RigidBody.kinematic_position_based()
        lift = GAP if body.falls and not body.ghost else 0.0
        builder = builder.translation((x, y + lift, z)).rotation(body.rotation)
        builder = builder.gravity_scale(1.0 if body.falls else 0.0).enabled(not body.absent)
        if body.is_active:
            x, y, z = (v * self.scale for v in body.velocity)
            builder = builder.linvel((x, y, z)).ccd_enabled(not body.ghost).soft_ccd_prediction(FORESEEN)
            builder = builder.can_sleep(not body.glides)  # what glides slowly would stop
            if body.glides and body.shape == "sphere":  # it rolls
                radius = body.half_width * self.scale
                builder = builder.angvel((z / radius, 0.0, -x / radius))
        else:
            builder = builder.sleeping(True)
        group = rapier.InteractionGroups(self.cells.groups[k], self.cells.groups[k])
        colliders: list[rapier.Collider | rapier.ColliderBuilder] = [
            _combined(part.friction(0.0 if body.glides else body.friction))
            .restitution(body.restitution)
            .sensor(body.is_ghostly)
            .collision_groups(group)
            .active_events(rapier.ActiveEvents.COLLISION_EVENTS)
            for part in _colliders(body, self.scale)
        ]
        if body.middle is not None and body.hollow is None:
            builder = builder.additional_mass_properties(_mass_properties(body, self.scale))
        handle = self.world.add_body(builder, colliders=colliders)
        added = self.world.rigid_bodies[handle]
        self.owner.update({collider.index: (k, i) for collider in added.colliders})
        return added

    def advance(self, frame: int) -> None:
        """From one recorded frame to the next."""
        world, drain, step = self.world, self.collector.drain_collision_events, 1 / (self.fps * self.substeps)
        for number in range(frame * self.substeps, (frame + self.every) * self.substeps):
            time = number * step
            self.steer(number, step)
            # Velocities before the step, from which the change at a meeting is computed.
            before = {(0, i): self.bodies[0][i].linvel for i in self.awake[0]} if self.is_alone else {}
            world.step()
            for event in drain():
                first, second = event.collider1.index, event.collider2.index
                # Containers have many colliders: bodies begin to touch with the first pair of them.
                pair = frozenset((self.owner.get(first, FLOOR), self.owner.get(second, FLOOR)))
                touching = self.joined[pair]
                self.joined[pair] = touching + 1 if event.started else max(0, touching - 1)
                if event.started and touching == 0:
                    self.meet(time, first, second, before)

    def steer(self, number: int, step: float) -> None:
        """Has bodies follow their paths and courses for one step (s) by its number."""
        for (k, i), path in self.followers.items():
            self.bodies[k][i].set_next_kinematic_translation(tuple(path[number].tolist()))
        time = number * step
        while self.turns_of_courses and self.turns_of_courses[0] <= time - 1.5 * step:
            del self.turns_of_courses[0]
        if not self.turns_of_courses or self.turns_of_courses[0] >= time + step:
            return
        for (k, i), course in list(self.courses.items()):
            if course.changes(time - 1.5 * step, time + step):
                body, shape = self.bodies[k][i], self.worlds[k][i]
                x, y, z = (course.mean_velocity(time, time + step) * self.scale).tolist()
                body.linvel = rapier.Vec3(x, body.linvel.y if shape.falls else y, z)
                if shape.shape == "sphere" and shape.falls:  # on the floor it rolls
                    radius = shape.half_width * self.scale
                    body.angvel = rapier.Vec3(z / radius, 0.0, -x / radius)
            if course.end <= time:
                self.release(k, i)

    def release(self, k: int, i: int) -> None:
        """A body stops gliding: from now on it is subject to friction."""
        self.courses.pop((k, i), None)
        for collider in self.bodies[k][i].colliders:
            self.world.colliders[collider].friction = self.worlds[k][i].friction

    def meet(self, time: float, first: int, second: int, before: dict[tuple[int, int], rapier.Vec3]) -> None:
        """Notes that two colliders begin to touch. The lower body comes first, the floor last."""
        met = sorted(self.owner[index] for index in (first, second) if index in self.owner)
        if not met:
            return
        (k, a), b = met[0], met[1][1] if len(met) > 1 else None
        impulse = 0.0
        if (k, a) in before:
            impulse = math.dist(self.bodies[k][a].linvel.to_tuple(), before[k, a].to_tuple()) / self.scale
        self.meetings[k].append(Meeting(time, a, b, impulse))
        if b is None or self.worlds[k][a].is_ghostly or self.worlds[k][b].is_ghostly:
            return
        self.touching[k, a].add(b)
        self.touching[k, b].add(a)
        if not {a, b} & self.awake[k]:  # bodies that stand close together touch when nothing moves
            return
        self.wake(k, {a, b})
        one, other = self.worlds[k][a], self.worlds[k][b]
        if time >= AT_START or not (one.stands_on(other) or other.stands_on(one)):
            self.end_gliding(k, (a, b))

    def end_gliding(self, k: int, met: tuple[int, int]) -> None:
        """Of two bodies that meet, releases what glides; where its course ends at a contact, both stop."""
        for i in met:
            if self.worlds[k][i].glides:
                course = self.courses.get((k, i))
                self.release(k, i)
                if course is not None and course.halts:
                    for stopped in (self.bodies[k][each] for each in met):
                        stopped.linvel = stopped.angvel = rapier.Vec3(0.0, 0.0, 0.0)

    def wake(self, k: int, bodies: set[int]) -> None:
        """Has bodies recorded from now on, and what they have touched: it stands on them or leans against them."""
        waiting = list(bodies)
        while waiting:
            i = waiting.pop()
            self.awake[k].add(i)
            self.recorded = None
            waiting += self.touching[k, i] - self.awake[k]

    def record(self, which: _Recorded) -> None:
        """Keeps where some bodies are."""
        bodies = which.bodies
        turns = [body.rotation for body in bodies] if self.records_turns else []
        self.kept.append((which, [body.translation for body in bodies], [body.linvel for body in bodies], turns))

    def check(self, row: int) -> None:
        """Writes down what was recorded up to a row, and takes out what is far away or finished."""
        for at, (which, *moving_points, turns) in enumerate(self.kept, row + 1 - len(self.kept)):
            for moving in (self.positions, self.velocities, self.turns):
                moving[:, :, at] = moving[:, :, max(0, at - 1)]
            self.positions[:, :, at] += self.drift[..., None] * self.velocities[:, :, at] * (self.every / self.fps)
            if not which.bodies:
                continue
            k, i = which.places
            positions, velocities = (np.array([value.to_tuple() for value in values]) for values in moving_points)
            self.positions[k, i, at] = (positions - self.cells.origin[k]) / self.scale
            self.velocities[k, i, at] = velocities / self.scale
            if self.records_turns:
                self.turns[k, i, at] = np.array([(turn.i, turn.j, turn.k, turn.w) for turn in turns])
        self.kept.clear()
        ahead = self.velocities[:, :, row] * (CHECKED * self.every / self.fps)  # until the next check
        away = (self.positions[:, :, row] + ahead) * self.scale - self.cells.middle[:, None]
        far = (np.abs(away[..., [0, 2]]).max(axis=2) > REACH) & ~self.drift
        for k, i in np.argwhere(far).tolist():
            if i in self.awake[k]:
                self.take_out(k, i, row)
        if self.finished is not None and row:
            for k in np.nonzero(self.finished(self.positions[:, 0, row], self.velocities[:, 0, row]))[0].tolist():
                self.take_out(k, 0, row)

    def take_out(self, k: int, i: int, row: int) -> None:
        """Leaves a body out of what is computed from now on: it keeps its last velocity over the floor."""
        if not self.drift[k, i]:
            self.bodies[k][i].is_enabled = False
            self.drift[k, i], self.recorded = True, None
            self.velocities[k, i, row, 1] = 0.0


@dataclass(frozen=True)
class _Cells:
    """Where worlds stand side by side inside the engine, each with its first body in the middle."""

    origin: Floats  # [K, 3] m inside the engine
    middle: Floats  # [K, 3] m inside the engine, from the origin: small bodies are far away from the camera
    groups: tuple[rapier.Group, ...]  # of collisions

    @staticmethod
    def of(worlds: Sequence[Sequence[RigidShape]], scale: float) -> _Cells:
        """In a square."""
        side = math.ceil(math.sqrt(len(worlds)))
        places = [(k % side, k // side) for k in range(len(worlds))]
        origin = np.array([[x * SPACING, 0.0, z * SPACING] for x, z in places])
        origin -= np.array([1.0, 0.0, 1.0]) * (side - 1) / 2 * SPACING
        middle = np.array([bodies[0].position for bodies in worlds]) * [scale, 0.0, scale]
        groups = tuple(rapier.Group(1 << (x % COLOURS * COLOURS + z % COLOURS)) for x, z in places)
        return _Cells(origin - middle, middle, groups)


def _empty_world(scale: float, step: float) -> rapier.PhysicsWorld:
    """A floor under gravity, in steps of so many seconds."""
    world = rapier.PhysicsWorld(gravity=(0.0, -min(GRAVITY * scale, MOST_GRAVITY), 0.0))
    world.set_num_threads(1)
    world.integration_parameters.dt = step
    world.integration_parameters.normalized_max_corrective_velocity = 1.0  # m/s: bodies that overlap part slowly
    floor = rapier.Collider.halfspace((0.0, 1.0, 0.0)).friction(FLOOR_FRICTION).restitution(FLOOR_RESTITUTION)
    world.add_collider(_combined(floor))
    return world


@dataclass(frozen=True)
class _Recorded:
    """The bodies that are recorded as long as no other begins to move and none is taken out."""

    bodies: list[rapier.RigidBody]
    places: tuple[NDArray[np.int64], NDArray[np.int64]]  # [N] each: their worlds, and their places in these

    @staticmethod
    def of(bodies: Sequence[Sequence[rapier.RigidBody]], awake: Sequence[set[int]], drift: Mask) -> _Recorded:
        """Those that are awake and not taken out."""
        which = [(k, i) for k, moving in enumerate(awake) for i in sorted(moving) if not drift[k, i]]
        k, i = np.array(which, np.int64).reshape(-1, 2).T
        return _Recorded([bodies[k][i] for k, i in which], (k, i))


_Frame = tuple[_Recorded, list[rapier.Vec3], list[rapier.Vec3], list[rapier.Rotation3]]
"""Positions, velocities and rotations of bodies."""


def _along(path: Floats, at: Floats) -> Floats:
    """Positions [N, 3] along a path [F, 3], at frames of it [N] that need not be whole; at rest after its end."""
    at = np.minimum(at, len(path) - 1.0)
    low = np.minimum(at.astype(np.int64), len(path) - 2)
    return path[low] + (at - low)[:, None] * (path[low + 1] - path[low])


def _combined(collider: rapier.ColliderBuilder) -> rapier.ColliderBuilder:
    rule = rapier.CoefficientCombineRule.MULTIPLY
    return collider.friction_combine_rule(rule).restitution_combine_rule(rule)


def _mass_properties(body: RigidShape, scale: float) -> rapier.MassProperties:
    """Of a solid body whose centre of mass is not in its middle: as heavy as if it were of one stuff."""
    width, depth, height = (half * scale for half in (body.half_width, body.half_depth, body.half_height))
    share = {"box": 8.0, "cylinder": 2 * math.pi, "cone": 2 * math.pi / 3, "sphere": 4 * math.pi / 3}[body.shape]
    mass = body.density * share * width * depth * height
    # Half widths squared, about the axes, of a box; what is round has less of it far out.
    w, d, h = width**2, depth**2, height**2
    spread = 3 if body.shape == "box" else 4
    inertia = (mass * (d / spread + h / 3), mass * (w + d) / spread, mass * (w / spread + h / 3))
    return rapier.MassProperties((0.0, (2 * (body.middle or 0.0) - 1) * height, 0.0), mass, inertia)


def _colliders(body: RigidShape, scale: float) -> list[rapier.ColliderBuilder]:
    """Of one solid piece, of the convex pieces of a drawing, or of a container."""
    if body.pieces:
        ends = np.array([-1.0, 1.0]) * body.half_depth
        solids = [[(x, y, z) for x, y in corners.tolist() for z in ends] for corners in body.pieces]
        return [rapier.Collider.convex_hull(np.array(each) * scale).density(body.density) for each in solids]
    if body.hollow is not None:
        return _walls(body, body.hollow, scale)
    width, height = body.half_width * scale, body.half_height * scale
    if body.shape == "sphere":
        solids = [rapier.Collider.ball(width)]
    elif body.shape == "box":
        solids = [rapier.Collider.cuboid(width, height, body.half_depth * scale)]
    elif body.shape == "cone":
        solids = [rapier.Collider.cone(height, width)]
    elif body.base < 1:
        low = max(body.waist, LEAST_WAIST) * height
        foot = rapier.Collider.cylinder(low, body.base * width).translation((0.0, low - height, 0.0))
        solids = [foot, rapier.Collider.cylinder(height - low, width).translation((0.0, low, 0.0))]
    else:
        solids = [rapier.Collider.cylinder(height, width)]
    return [solid.density(0.0 if body.middle is not None else body.density) for solid in solids]


def _walls(body: RigidShape, hollow: Hollow, scale: float) -> list[rapier.ColliderBuilder]:
    """A container's floor and the convex segments of the wall that stands on it."""
    half_width, half_height = body.half_width, body.half_height
    foot = hollow.bottom + half_width - hollow.opening  # m: outer radius of the floor, or half its side
    turn = math.pi / hollow.sides
    angles = turn + 2 * turn * np.arange(hollow.sides + 1)
    circle = np.stack([np.cos(angles), np.zeros_like(angles), np.sin(angles)], axis=1)
    circle = np.asarray(circle / math.cos(turn), np.float64)
    rings: list[Floats] = []
    levels = ((half_width, hollow.opening, half_height), (foot, hollow.bottom, half_height - hollow.depth))
    for outer, inner, level in levels:
        rings += [circle * radius + np.array([0.0, level, 0.0]) for radius in (outer, inner)]
    half, radius = (2 * half_height - hollow.depth) / 2 * scale, foot * scale
    # A flat cylinder stands on the floor as a hull of its corners does not: that sinks into it.
    floor = (
        rapier.Collider.cylinder(half, radius)
        if hollow.sides > BOX_SIDES
        else rapier.Collider.cuboid(radius, half, radius)
    )
    parts = [floor.translation((0.0, half - half_height * scale, 0.0))]
    for i in range(hollow.sides):
        parts.append(rapier.Collider.convex_hull(np.concatenate([ring[i : i + 2] for ring in rings]) * scale))
    # As heavy as a solid body of its outline: things that hold others are made of heavier stuff than balls and blocks
    # of their size, and the thickness of their walls is not seen and must not decide what tips them.
    outline = 2 * half_height * (foot**2 + foot * half_width + half_width**2) / 3
    space = hollow.depth * (hollow.bottom**2 + hollow.bottom * hollow.opening + hollow.opening**2) / 3
    density = body.density * (outline / max(outline - space, 0.02 * outline))
    return [part.density(density) for part in parts]
