"""The course of a body that keeps its velocity: legs of given length, a stop at their end or at the first contact."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.records import Motion
from cow_service.vision.types import Floats


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

    @property
    def end(self) -> float:
        """When the last leg ends, s."""
        return sum(leg.duration for leg in self.legs)

    def changes(self, start: float, end: float) -> bool:
        """Whether a leg ends between two times (s)."""
        at = 0.0
        for leg in self.legs:
            at += leg.duration
            if start < at < end:
                return True
        return False

    def mean_velocity(self, start: float, end: float) -> Floats:
        """[3] m/s, between two times (s): with it, steps of any length lead to the same places."""
        moved, at = np.zeros(3), 0.0
        for leg in self.legs:
            inside = min(end, at + leg.duration) - max(start, at)
            if inside > 0:
                moved += inside * np.array(leg.velocity)
            at += leg.duration
        return moved / (end - start)


def course_of(motion: Motion, velocities: Sequence[Floats], speed: float, clip: float) -> Course | None:
    """The course with the velocity [3] (m/s) of each leg, at a speed in px/s; None where it just goes on.

    Legs before the last that have no length of their own share what is left of the clip's seconds.
    """
    extents = [(motion.distance, motion.duration), *((step.distance, step.duration) for step in motion.steps)]
    seconds = [_seconds(distance, duration, speed) for distance, duration in extents]
    if seconds == [math.inf] and motion.until != "contact":
        return None
    if not all(map(math.isfinite, seconds[:-1])):
        open_ones = sum(not math.isfinite(each) for each in seconds)
        share = max(0.0, clip - sum(filter(math.isfinite, seconds))) / open_ones
        seconds = [*(each if math.isfinite(each) else share for each in seconds[:-1]), seconds[-1]]
    legs = [Leg(length, _triple(velocity)) for length, velocity in zip(seconds, velocities, strict=True)]
    return Course(tuple(legs), motion.until == "contact")


def _seconds(distance: float | None, duration: float | None, speed: float) -> float:
    """How long a leg takes; infinite where nothing limits it."""
    for_distance = math.inf if distance is None or speed <= 0 else distance / speed
    return min(for_distance, math.inf if duration is None else duration)


def _triple(velocity: Floats) -> tuple[float, float, float]:
    x, y, z = velocity.tolist()
    return x, y, z
