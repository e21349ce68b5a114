"""Where bodies are above the floor of the estimated camera, what lies beneath them, and which of two is in front."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.physics.camera import NEAREST, FloorCamera
from cow_service.records import BBox, Body
from cow_service.vision.masks import Floats

TOUCHING = 0.25  # of the smaller height: how deep one body may seem to stand in the one beneath it


@dataclass(frozen=True)
class Placed:
    """A body at one frame."""

    bbox: BBox  # [x0, y0, x1, y1], px of the image
    airborne: bool  # the image does not say how far away it is
    depth: float | None = None  # m from the camera, along its axis; None where no camera is known
    bottom: float = 0.0  # m above the floor
    top: float = 0.0

    def in_front_of(self, other: Placed, eye: float) -> bool:
        """Whether it covers the other one in the image; `eye` is the camera's height above the floor (m).

        What is wholly above another's top is in front where the camera looks down on that top. Else the nearer one is;
        without a camera the one that stands lower in the image.
        """
        if self.depth is None or other.depth is None:
            return self.airborne or (not other.airborne and self.bbox[3] >= other.bbox[3])
        slack = TOUCHING * min(self.top - self.bottom, other.top - other.bottom)
        if self.bottom >= other.top - slack and eye > other.top:
            return True
        if other.bottom >= self.top - slack and eye > self.top:
            return False
        return self.depth <= other.depth


@dataclass(frozen=True)
class Surface:
    """What lies beneath a body."""

    height: float  # m above the floor
    body: int | None  # whose top it is, of `Trajectory.bodies`; None for the floor


@dataclass(frozen=True)
class Ground:
    """The floor and what stands still on it, seen by the camera; image points are px of the clip."""

    camera: FloorCamera
    factor: float  # clip px per image px
    bodies: tuple[Body, ...]
    still: tuple[int, ...]  # which of the bodies never move

    @staticmethod
    def of(given: GeneratorInput, factor: float) -> Ground | None:
        """None where the trajectory has no camera."""
        trajectory, scene = given.trajectory, given.scene
        if trajectory.camera is None or not trajectory.bodies:
            return None
        moving = {path.body for path in trajectory.paths}
        still = tuple(index for index in range(len(trajectory.bodies)) if index not in moving)
        return Ground(FloorCamera.of(trajectory.camera, scene.width, scene.height), factor, trajectory.bodies, still)

    def height(self, position: Floats) -> float:
        """Metres above the floor of a position [3]."""
        return float(self.camera.above_floor(position[None])[0])

    def foot(self, position: Floats, height: float) -> Floats:
        """The position [3] at a height above the floor (m), straight below or above another one."""
        return position + (height - self.height(position)) * self.camera.up

    def project(self, position: Floats) -> Floats:
        """The image point [2] of a position [3]."""
        return self.factor * self.camera.project(position[None])[0]

    def depth(self, position: Floats) -> float:
        """Metres along the camera's axis, of what can be projected."""
        return max(float(position[2]), NEAREST * self.camera.height)

    def shape_on_floor(self, position: Floats) -> Floats:
        """Matrix [2, 2]: px right and down per metre right and ahead over the floor, at a position [3]."""
        x, y, z = position[0], position[1], self.depth(position)
        steps = np.stack([self.camera.right, self.camera.ahead], axis=1)
        slope = np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]])
        return self.factor * self.camera.focal * slope @ steps

    def support_of(self, body: int) -> int | None:
        """The still body that a body stands on at the first frame; None for the floor and in the air."""
        named = [index for index in self.still if self.bodies[index].object == self.bodies[body].support]
        return named[0] if named else None

    def lower_end(self, body: int) -> float:
        """Metres above the floor of a body's lower end, at the first frame."""
        it = self.bodies[body]
        return 0.0 if it.support == "floor" else self.height(np.array(it.position)) - it.size[1] / 2

    def surface_below(self, position: Floats, bottom: float, size: float) -> Surface:
        """The highest top of a still body, or else the floor, below a body of a size (m) with its lower end there."""
        best = Surface(0.0, None)
        over = self.camera.to_floor(position[None])[0]
        for index in self.still:
            it = self.bodies[index]
            below = self.camera.to_floor(np.array([it.position]))[0]
            top = float(below[1]) + it.size[1] / 2
            beside = float(np.hypot(over[0] - below[0], over[2] - below[2]))
            if beside < max(it.size[0], it.size[2]) / 2 and best.height < top <= bottom + TOUCHING * size:
                best = Surface(top, index)
        return best
