"""A world: bodies on a floor, set in motion, and run under one of the two laws, for many draws at once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from cow_service.media.masks import pieces_of
from cow_service.media.types import Floats, Mask
from cow_service.physics.ballistic import course_of
from cow_service.physics.bodies import SeenBody
from cow_service.physics.camera import CameraFit
from cow_service.physics.draws import COLUMN
from cow_service.physics.engine import RigidShape, WorldRun, run_worlds
from cow_service.physics.geometry import Measurement
from cow_service.physics.layout import BOX_SIDE, FARTHEST, VEHICLE_WIDTH, Layout, lay_out
from cow_service.physics.lift import speed_factors
from cow_service.physics.placement import (
    PLACING,
    PlacementGoal,
    Placements,
    Settled,
    carry,
    new_supports,
    settle,
)
from cow_service.records import FALLING_KINDS, BBox, DepthEstimate, Motion, Shape

FRICTION, FRICTION_SIGMA = 0.5, 0.5  # of a body; one standard deviation of the logarithm
RESTITUTION, RESTITUTION_SIGMA = 0.5, 0.15
CONE_MIDDLE, MIDDLE_SIGMA = 0.25, 0.12  # of a body's height: its centre of mass; and how uncertain any is
RAISED = 0.05  # of its height: what engines with other contacts knock over, this one does at such a centre of mass
LOWEST_MIDDLE, HIGHEST_MIDDLE = 0.15, 0.75
# Share of the visible base on which an object really stands, as edges are round; and its log deviation.
BASE, BASE_SIGMA = 0.85, 0.15
LEAST_BASE, WHOLE_BASE = 0.3, 0.95  # of the width: from so much on it stands on all of it
WEIGHT_SIGMA = 0.5  # of the logarithm: how heavy the mover is against the others
YAW_SIGMA = 0.4  # radians: how a box is turned about the vertical
CLOCK = 16.0  # frames per second at which worlds of an ensemble run, so that no answer depends on the clip
HORIZON, LONGEST = 6.0, 60.0  # s for which worlds are followed unless they rest before: in general, and of slow things
CROSSING = 1.25  # of the image's width: the way that a slow thing is given the time for
LEFT_BY = 0.2  # of the image's width: so far outside, what goes on outwards does not come back
LOOK_AHEAD = 0.01  # s
LEAST_HALF, MOST_HALF = 0.02, 60.0  # half widths and heights of bodies, in those of the mover


@dataclass(frozen=True)
class PrescribedMotion:
    """A given path, at the rate of the clip: from the foot of a standing object, else from its positions."""

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
    prescribed: PrescribedMotion | None = None  # the mover follows it, through everything
    lasts: float = 0.0  # s, of a path that is given
    others: Mapping[int, Motion] = field(default_factory=dict[int, Motion])  # of other bodies, by their places
    removed: tuple[SeenBody, ...] = ()  # placed with the others, then taken away before anything moves
    turns_wanted: bool = False  # how bodies turn is recorded of an ensemble, too
    placement: PlacementGoal | None = None  # the mover is carried somewhere and released
    placed_before: tuple[PlacementGoal, ...] = ()  # what is put somewhere before anything moves, in this order
    level: float | None = None  # px: height in the image of the floor of a drawing that is seen from the side
    measured: Measurement | None = None  # by a depth map, of `bodies` and then of `removed`
    depth: DepthEstimate | None = None  # of the map that was given
    faint: tuple[BBox, ...] = ()  # px: where the image may show things, but not for certain

    @property
    def horizon(self) -> float:
        """Seconds for which it is followed unless it rests before, whatever the clip shows of it."""
        motion, seconds = self.motion, max(HORIZON, self.lasts)
        if motion.kind == "linear" and motion.speed > 0:
            legs = [each.duration or (each.distance or 0.0) / motion.speed for each in (motion, *motion.steps)]
            seconds += sum(legs) if motion.steps else 0.0
        slow = [each.speed for each in (motion, *self.others.values()) if each.kind == "linear" and each.speed > 0]
        seconds = max(seconds, CROSSING * self.size[0] / min(slow, default=math.inf))
        return min(LONGEST, seconds)

    @property
    def frames(self) -> int:
        """Frames of the clip, and of what happens until the horizon."""
        return max(self.num_frames, math.ceil(self.horizon * self.fps) + 1)

    def as_it_is(self) -> WorldInput:
        """With nothing put elsewhere and nothing taken away: those things are then the last bodies."""
        return replace(self, bodies=(*self.bodies, *self.removed), removed=(), placed_before=())


@dataclass(frozen=True)
class Worlds:
    """Worlds that were run: where bodies were placed, and what they did."""

    layout: Layout
    shapes: tuple[tuple[RigidShape, ...], ...]  # per draw
    runs: tuple[WorldRun, ...]  # per draw
    every: int  # frames between recorded ones
    fps: float  # of the frames
    horizon: float  # s: what happens later does not count
    placements: Placements | None = None  # where the mover is put somewhere
    before: tuple[Placements, ...] = ()  # of what is put somewhere before anything moves
    seen: tuple[tuple[RigidShape, ...], ...] | None = None  # per draw, then: bodies as the image shows them

    def joined(self, other: Worlds, layout: Layout) -> Worlds:
        """With those of more draws, and the layout of all of them; where the others' rest begins later, until then."""
        frames = max(each.runs[0].positions.shape[1] for each in (self, other))
        placements = None
        if self.placements is not None and other.placements is not None:
            placements = self.placements.joined(other.placements)
        return replace(
            self,
            layout=layout,
            shapes=(*self.shapes, *other.shapes),
            runs=(*self.cut(frames).runs, *other.cut(frames).runs),
            placements=placements,
            before=tuple(one.joined(more) for one, more in zip(self.before, other.before, strict=True)),
            seen=None if self.seen is None or other.seen is None else (*self.seen, *other.seen),
        )

    def cut(self, frames: int, until: float = math.inf) -> Worlds:
        """With this number of recorded frames, the last one repeated as needed, and the meetings up to a time (s)."""
        return replace(self, runs=tuple(run.cut(frames, until) for run in self.runs))

    @property
    def within_horizon(self) -> Worlds:
        """Without what happens after the horizon."""
        most = math.ceil(self.horizon * self.fps / self.every) + 1
        return self.cut(min(most, self.runs[0].positions.shape[1]), self.horizon)


def run_world(given: WorldInput, draws: Floats, every: int = 1) -> Worlds:
    """Places and runs the worlds of draws [K, P], recording every `every`-th frame.

    One world alone runs at the clip's frame rate and covers the clip; many run at a rate of their own.
    """
    return DrawnWorlds.of(given, draws, every).run(slice(0, len(draws)))


@dataclass(frozen=True)
class DrawnWorlds:
    """The worlds of draws [K, P], placed as the image shows them and not yet run."""

    given: WorldInput
    layout: Layout
    draws: Floats
    every: int

    @staticmethod
    def of(given: WorldInput, draws: Floats, every: int) -> DrawnWorlds:
        """Places all bodies, what is taken away included."""
        bodies, goals = (*given.bodies, *given.removed), given.placed_before
        layout = lay_out(bodies, given.motion, given.fit, given.size, draws, given.others, given.level, given.measured)
        layout = layout.first(len(given.bodies))
        return DrawnWorlds(
            given, layout.rearranged(new_supports(goals, layout.supports)) if goals else layout, draws, every
        )

    def without(self, body: int) -> DrawnWorlds:
        """The same worlds with one body taken away."""
        return replace(self, layout=self.layout.without((body,)))

    def shapes(self, part: slice) -> tuple[tuple[RigidShape, ...], ...]:
        """The bodies of some draws at the start."""
        layout, draws = self.layout.of(part), self.draws[part]
        return tuple(_Draw(self.given, layout, draws, k).shapes() for k in range(len(draws)))

    def run(self, part: slice) -> Worlds:
        """Runs those of some draws."""
        given, every, goals = self.given, self.every, self.given.placed_before
        layout, draws = self.layout.of(part), self.draws[part]
        fps, frames = CLOCK, math.ceil(given.horizon * CLOCK) + 1
        if len(self.draws) == 1:
            fps, frames = given.fps, given.frames
        seen = self.shapes(part)
        settled = Settled(seen, ())
        if goals:
            flying = [i for i, body in enumerate(layout.bodies) if not body.stands]
            settled = settle(goals, seen, draws, fps, flying)
        shapes, placements = settled.shapes, None
        if given.placement is not None:
            carried = min(PLACING.carried, PLACING.most_carried * (given.num_frames - 1) / given.fps)
            shapes, runs, placements = carry(given.placement, shapes, draws, carried, frames, fps, every)
        else:

            def has_left(positions: Floats, velocities: Floats) -> Mask:
                """Which movers [K] have left the image sideways and go on that way, or lie behind the camera."""
                (points, depth), width = layout.cameras.project(positions), given.size[0]
                x = points[:, 0]
                step = layout.cameras.project(positions + velocities * LOOK_AHEAD)[0][:, 0] - x
                return ((x < -LEFT_BY * width) & (step < 0)) | ((x > (1 + LEFT_BY) * width) & (step > 0)) | (depth < 0)

            finished = None if len(self.draws) == 1 or given.motion.steps or given.others else has_left
            runs = run_worlds(shapes, frames, fps, every, finished, given.turns_wanted, True, given.fps)
        before, shown = settled.placements, seen if goals else None
        return Worlds(layout, shapes, tuple(runs), every, fps, given.horizon, placements, before, shown)


@dataclass(frozen=True)
class _Draw:
    """One draw of a world."""

    given: WorldInput
    layout: Layout
    draws: Floats  # [K, P]
    k: int  # which of them

    def shapes(self) -> tuple[RigidShape, ...]:
        """Its bodies at the start."""
        given, layout, k, row = self.given, self.layout, self.k, self.draws[self.k]
        bodies = [self.shape(index) for index in range(len(given.bodies))]
        weight = math.exp(WEIGHT_SIGMA * float(row[COLUMN["weight"]]))
        bodies[0] = replace(bodies[0], density=bodies[0].density * weight)
        velocities = [legs[k] for legs in (layout.velocity, *layout.further)]
        bodies[0] = self.set_going(0, bodies[0], given.motion, velocities, "speed")
        for loose in layout.unsupported:
            bodies[loose] = replace(bodies[loose], starts=True)
        for i, motion in given.others.items():
            if i < len(bodies) and i not in layout.absent:  # else it is taken away
                bodies[i] = self.set_going(i, bodies[i], motion, [layout.others[i][k]], "other_speed")
        for taken in layout.absent:
            bodies[taken] = replace(bodies[taken], absent=True)
        return tuple(bodies)

    def shape(self, index: int) -> RigidShape:
        """A body where it stands or hangs, before it is set going."""
        given, k, row = self.given, self.k, self.draws[self.k]
        seen, body, unit = given.bodies[index], self.layout.bodies[index], float(self.layout.bodies[0].half_width[k])
        low, high = LEAST_HALF * unit, MOST_HALF * unit
        half = float(np.clip(body.half_width[k], low, high))
        tall = half if body.shape == "sphere" else float(np.clip(body.half_height[k], low, high))
        x, y, z = body.centre[k].tolist()
        shape, side = body.shape, half if body.shape != "box" else BOX_SIDE * half
        if given.placement is not None and shape == "box" and seen.equal_sided:
            side = min(max(tall, half / math.sqrt(2)), half)  # it is seen between its face's width and its diagonal
        deep, turn = side, 0.0
        along = half * float(np.broadcast_to(body.depth_share, len(self.draws))[k])
        if body.yaw is not None:
            side, deep, turn = half, along, -body.yaw
        elif not seen.is_depth_known:  # it shows its width, which nothing says is that of something round
            shape, side, deep, turn = "box", half, along, math.atan2(x, z)
        elif shape == "box" and not seen.elongated:
            turn = YAW_SIGMA * float(row[COLUMN["yaw"]])
        rigid = RigidShape(
            shape=shape,
            half_width=side,
            half_depth=deep,
            half_height=tall,
            position=(x, y, z),
            yaw=turn,
            # What its outline would turn to about its axis, of the volume of the cylinder around it.
            density=float(np.mean(seen.widths**2)) if shape == "cylinder" else 1.0,
            friction=FRICTION * math.exp(FRICTION_SIGMA * row[COLUMN["friction"]]),
            restitution=min(1.0, max(0.0, RESTITUTION + RESTITUTION_SIGMA * row[COLUMN["restitution"]])),
            falls=body.stands,
            **self.balance(seen, shape, tall, (x, y, z)),
        )
        if given.level is None:
            return rigid
        # In a drawing all are as deep, and what hangs, or is cut off by the border, stays.
        fixed = index > 0 and (not body.stands or self.is_cut(seen))
        return replace(rigid, half_depth=unit, yaw=0.0, middle=None, pieces=self.pieces(seen), fixed=fixed)

    def pieces(self, seen: SeenBody) -> tuple[Floats, ...]:
        """A body of a drawing as convex pieces: corners [N, 2] each, m right of its middle and above it."""
        x0, y0, x1, y1 = seen.bbox
        unit = self.given.motion.metres_per_pixel.value * np.array([1.0, -1.0])
        if seen.shape == "sphere":
            return ()
        return tuple((corners - np.array([(x0 + x1) / 2, (y0 + y1) / 2])) * unit for corners in pieces_of(seen.mask))

    def is_cut(self, seen: SeenBody) -> bool:
        """Whether the border of the image cuts a body off."""
        x0, y0, x1, y1 = seen.bbox
        return x0 <= 0 or y0 <= 0 or x1 >= self.given.size[0] or y1 >= self.given.size[1]

    def balance(self, seen: SeenBody, shape: Shape, tall: float, centre: tuple[float, float, float]) -> dict[str, Any]:
        """The base of a body and its centre of mass, as fields of its shape; empty for a body that cannot tip."""
        if shape == "sphere":
            return {}
        row = self.draws[self.k]
        middle = {"cone": CONE_MIDDLE, "cylinder": seen.middle}.get(shape, 0.5)
        middle += RAISED + MIDDLE_SIGMA * float(row[COLUMN["middle"]])
        found = {"middle": min(max(middle, LOWEST_MIDDLE), HIGHEST_MIDDLE)}
        if shape == "cylinder":
            x, y, z = centre
            above = float(self.layout.cameras.height[self.k]) - y + tall
            base, waist = seen.stance(max(0.0, above) / math.hypot(x, above, z))
            base = max(LEAST_BASE, BASE * base * math.exp(BASE_SIGMA * float(row[COLUMN["base"]])))
            found |= {"base": base, "waist": waist} if base < WHOLE_BASE else {}
        return found

    def set_going(
        self, index: int, body: RigidShape, motion: Motion, velocities: Sequence[Floats], speed: str
    ) -> RigidShape:
        """A body that is thrown, released, moves by itself, or follows a path; velocities [3] are those of its legs."""
        given, seen, velocity = self.given, self.given.bodies[index], velocities[0]
        changes: dict[str, Any] = {"velocity": tuple(velocity.tolist()), "starts": motion.kind != "static"}
        if index == 0 and given.prescribed is not None:
            changes |= {"follows": self.along_path(given.prescribed), "falls": False}
        else:
            changes["falls"] = motion.kind in FALLING_KINDS or not (motion.rises or seen.flies(motion))
            changes["glides"] = motion.kind == "linear"
            if motion.kind == "linear":
                factor = float(speed_factors(motion, self.draws[self.k : self.k + 1], speed)[0])
                changes["course"] = course_of(motion, velocities, motion.speed * factor)
        fast = float(np.hypot(velocity[0], velocity[2]))
        # A vehicle is longer along its heading than its visible width across.
        is_measured = self.layout.bodies[index].yaw is not None
        if seen.elongated and fast > 0 and given.level is None and not is_measured:
            placed, k = self.layout.bodies[index], self.k
            sight = placed.centre[k, [0, 2]] / np.linalg.norm(placed.centre[k, [0, 2]])
            along = abs(float(velocity[[0, 2]] @ sight)) / fast
            length = float(placed.half_width[k]) / (math.sqrt(max(0.0, 1 - along**2)) + VEHICLE_WIDTH * along)
            yaw = -math.atan2(velocity[2], velocity[0])
            changes |= {"shape": "box", "half_width": length, "half_depth": VEHICLE_WIDTH * length, "yaw": yaw}
        return replace(body, **changes)

    def along_path(self, path: PrescribedMotion) -> Floats:
        """Positions [F, 3] along a path: on the floor for a standing object whose foot is below the horizon."""
        mover, cameras, k = self.layout.bodies[0], self.layout.cameras, self.k
        height = float(cameras.height[k])
        if not mover.stands:
            return path.positions @ cameras.axes[k].T + np.array([0.0, height, 0.0])
        count = len(path.feet)
        rays = cameras.repeated(count, k).rays(path.feet)
        drop = height - mover.centre[k, 1] + mover.half_height[k]
        nearest = drop / (FARTHEST * float(np.linalg.norm(mover.centre[k, [0, 2]])))
        near = rays[:, [0, 2]] * (drop / np.maximum(-rays[:, 1], nearest))[:, None]
        way = near / np.maximum(np.linalg.norm(near, axis=1), 1e-9)[:, None]
        deep = float(np.broadcast_to(mover.depth_share, len(self.draws))[k])
        middle = near + way * float(mover.half_width[k]) * deep
        return np.stack([middle[:, 0], np.full(count, mover.centre[k, 1]), middle[:, 1]], axis=1)
