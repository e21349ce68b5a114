"""A body as the engine of rigid bodies takes it."""

from __future__ import annotations

from dataclasses import dataclass, field

from cow_service.physics.containers import Hollow
from cow_service.physics.course import Course
from cow_service.records import Shape
from cow_service.vision.types import Floats

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
    starts: bool = False  # it is set in motion or let go; what is not sleeps until it is touched
    glides: bool = False  # keeps its velocity, without friction, until it meets another body
    falls: bool = True  # gravity acts on it
    ghost: bool = False  # passes through everything; what it meets is told all the same
    course: Course | None = None  # of what glides: its legs, and where it stops
    hollow: Hollow | None = None  # it is an open container
    follows: Floats | None = field(default=None, compare=False)  # [F, 3] m: it is led along these positions

    def stands_on(self, other: RigidShape) -> bool:
        """Whether its lower end is, at the start, about where the upper end of another body is."""
        low, top = self.position[1] - self.half_height, other.position[1] + other.half_height
        return abs(low - top) < RESTS * min(self.half_height, other.half_height)
