"""Paths that no contact changes: the paper's constant velocity plus gravity, or points that a request gives.

They lie in the plane of the first depth unless the motion leads out of it, as the paper has it: there is no floor.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cow_service.media.types import Floats, Mask
from cow_service.physics.camera import FOCAL_WIDTHS
from cow_service.records import Grounding, Motion, Vector
from cow_service.requests import TrajectoryRequest

GRAVITY = 9.81  # m/s^2
DEFAULT_SPEED = 0.26  # image widths per second
DEFAULT_SCENE_WIDTH = 3.0  # m across the image at the object's depth, where nothing tells the scale
COURSE_TIME = 5.0  # s: of a motion of several legs whose lengths are not told, whatever the clip shows of it
NEAREST_FREE = 0.08  # of the first depth: closer than this the object has passed the camera


@dataclass(frozen=True)
class Camera:
    """A camera at the origin: x right, y down, z depth. Its scale is fixed by the first depth of the object."""

    width: int  # px
    height: int  # px
    metres_per_pixel: float  # at the object's first depth

    @property
    def focal(self) -> float:
        """Focal length, px."""
        return FOCAL_WIDTHS * self.width

    @property
    def depth(self) -> float:
        """Depth of the object at the first frame, m."""
        return self.focal * self.metres_per_pixel

    def lift(self, point: tuple[float, float]) -> Floats:
        """Position [3] (m) of an image point (px) at the object's first depth."""
        x, y = point[0] - self.width / 2, point[1] - self.height / 2
        return np.array([x * self.metres_per_pixel, y * self.metres_per_pixel, self.depth])

    def project(self, positions: Floats) -> tuple[Floats, Floats]:
        """Image points [F, 2] (px) and apparent sizes [F] (1 at the first depth) of positions [F, 3] (m).

        Positions nearer than `NEAREST_FREE` are projected as if they were there: behind the camera there is no image.
        """
        z = np.maximum(positions[:, 2], NEAREST_FREE * self.depth)
        points = positions[:, :2] * (self.focal / z)[:, None] + np.array([self.width / 2, self.height / 2])
        return points, self.depth / z


def has_passed(depths: Floats, first: Floats | float) -> Mask:
    """Which of the depths [F] of an object are so small, against its first one, that the camera has been passed."""
    return depths <= NEAREST_FREE * first


def roll_out(position: Floats, velocity: Floats, acceleration: Floats, times: Floats) -> Floats:
    """States [F, 6] at the given times [F] (s), from position [3] (m), velocity [3] (m/s), acceleration [3] (m/s^2).

    Closed form, so that a state does not depend on how finely the clip is sampled.
    """
    t = times[:, None]
    return np.hstack([position + velocity * t + 0.5 * acceleration * t * t, velocity + acceleration * t])


@dataclass(frozen=True)
class Leg:
    """One part of a course."""

    duration: float  # s; infinite: it goes on
    velocity: tuple[float, float, float]  # m/s


@dataclass(frozen=True)
class Course:
    """What a body does until it meets another. After the last leg it is at rest."""

    legs: tuple[Leg, ...]
    halts: bool = False  # it is stopped where it first meets a body

    @cached_property
    def ends(self) -> tuple[float, ...]:
        """When each leg ends, s."""
        return tuple(itertools.accumulate(leg.duration for leg in self.legs))

    @property
    def end(self) -> float:
        """When the last leg ends, s."""
        return self.ends[-1]

    def changes(self, start: float, end: float) -> bool:
        """Whether a leg ends between two times (s)."""
        return any(start < at < end for at in self.ends)

    def mean_velocity(self, start: float, end: float) -> Floats:
        """[3] m/s, between two times (s): with it, steps of any length lead to the same places."""
        moved, at = np.zeros(3), 0.0
        for leg in self.legs:
            inside = min(end, at + leg.duration) - max(start, at)
            if inside > 0:
                moved += inside * np.array(leg.velocity)
            at += leg.duration
        return moved / (end - start)


def course_of(motion: Motion, velocities: Sequence[Floats], speed: float) -> Course | None:
    """The course with the velocity [3] (m/s) of each leg, at a speed in px/s; None if it just goes on.

    Legs before the last that have no length of their own share what is left of `COURSE_TIME`.
    """
    extents = [(motion.distance, motion.duration), *((step.distance, step.duration) for step in motion.steps)]
    seconds: list[float] = []
    for distance, duration in extents:
        reached = math.inf if distance is None or speed <= 0 else distance / speed
        seconds.append(min(reached, math.inf if duration is None else duration))
    if seconds == [math.inf] and motion.until != "contact":
        return None
    if not all(map(math.isfinite, seconds[:-1])):
        open_ones = sum(not math.isfinite(each) for each in seconds)
        share = max(0.0, COURSE_TIME - sum(filter(math.isfinite, seconds))) / open_ones
        seconds = [*(each if math.isfinite(each) else share for each in seconds[:-1]), seconds[-1]]
    pairs = zip(seconds, (velocity.tolist() for velocity in velocities), strict=True)
    return Course(tuple(Leg(length, (x, y, z)) for length, (x, y, z) in pairs), motion.until == "contact")


@dataclass(frozen=True)
class FreePath:
    """A path per frame [F]."""

    states: Floats  # [F, 6] m and m/s in the frame of the camera
    points: Floats  # [F, 2] px
    scale: Floats  # [F]
    visible: Mask  # [F]

    def cut(self, frames: int) -> FreePath:
        """The first frames of it."""
        return FreePath(self.states[:frames], self.points[:frames], self.scale[:frames], self.visible[:frames])


def ballistic_path(camera: Camera, grounding: Grounding, motion: Motion, times: Floats) -> FreePath:
    """The path of the motion from the grounded point, at times [F] (s); along legs, where it has several or an end."""
    metres = motion.metres_per_pixel.value
    velocity = metres * motion.speed * _unit(motion.direction, motion.depth)
    start = camera.lift(grounding.point)
    legs = [velocity, *(metres * motion.speed * _unit(step.direction, step.depth) for step in motion.steps)]
    course = course_of(motion, legs, motion.speed)
    if course is not None and motion.kind == "linear":
        moved = np.array([course.mean_velocity(0.0, t) * t if t > 0 else np.zeros(3) for t in times])
        now = np.array([course.mean_velocity(t, t + 1e-6) for t in times])
        return _seen(camera, np.hstack([start + moved, now]))
    acceleration = metres * np.array([*motion.gravity, 0.0])
    return _seen(camera, roll_out(start, velocity, acceleration, times))


def _unit(direction: Vector | None, depth: float) -> Floats:
    """[3]: of a direction in the image and the sine of the angle out of its plane."""
    dx, dy = direction or (0.0, 0.0)
    across = float(np.sqrt(1 - depth**2))
    return np.array([across * dx, across * dy, depth])


def given_path(camera: Camera, given: TrajectoryRequest, times: Floats) -> FreePath:
    """Given points at the object's first depth, linear between them, at rest after the last, at times [F] (s).

    Where apparent sizes are given, the depths are those at which the object has them.
    """
    stamps = np.arange(len(given.points)) / given.fps
    path = np.array([camera.lift(point) for point in given.points])
    if given.scale is not None:
        path /= np.array(given.scale)[:, None]
    position = sampled(path, given.fps, times)
    step = np.minimum(np.searchsorted(stamps, times, side="right"), len(stamps) - 1)
    velocity = (path[step] - path[step - 1]) * given.fps
    velocity[times >= stamps[-1]] = 0.0
    found = _seen(camera, np.hstack([position, velocity]))
    if given.visible is not None:
        found.visible[:] &= np.array(given.visible)[latest(given, times)]
    return found


def sampled(path: Floats, fps: float, times: Floats) -> Floats:
    """A path [P, D] given at `fps`, at other times: linear between its points, at rest after the last."""
    stamps = np.arange(len(path)) / fps
    return np.stack([np.interp(times, stamps, path[:, axis]) for axis in range(path.shape[1])], axis=1)


def latest(given: TrajectoryRequest, times: Floats) -> list[int]:
    """The number of the given point that was reached last at each time."""
    # The small term keeps a frame that falls on a point from landing before it.
    return np.minimum((times * given.fps + 1e-6).astype(np.int64), len(given.points) - 1).tolist()


def _seen(camera: Camera, states: Floats) -> FreePath:
    points, scale = camera.project(states[:, :3])
    inside = np.all((points >= 0) & (points < [camera.width, camera.height]), axis=1)
    return FreePath(states, points, scale, inside & ~has_passed(states[:, 2], camera.depth))
