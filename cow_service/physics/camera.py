"""The pinhole camera that turns pixels into metres and back, with the stated guesses where an image tells nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cow_service.vision.types import Floats

FOCAL_WIDTHS = 1.0  # focal length in image widths: a horizontal field of view of 53 degrees
PITCH = math.radians(30)  # how far the camera looks down on a floor, for motion towards or away from it
NEAREST = 0.08  # of the first depth: closer than this the object has passed the camera


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

        Positions nearer than `NEAREST` are projected as if they were there: behind the camera there is no image.
        """
        z = np.maximum(positions[:, 2], NEAREST * self.depth)
        points = positions[:, :2] * (self.focal / z)[:, None] + np.array([self.width / 2, self.height / 2])
        return points, self.depth / z

    def has_passed(self, positions: Floats) -> NDArray[np.bool_]:
        """Which of the positions [F, 3] lie at or behind the camera."""
        return has_passed(positions[:, 2], self.depth)


def has_passed(depths: Floats, first: float) -> NDArray[np.bool_]:
    """Which of the depths [F] of an object are so small, against its first one, that the camera has been passed."""
    return depths <= NEAREST * first


def depth_motion(sense: float) -> tuple[tuple[float, float], float]:
    """Image direction and `Motion.depth` of what moves on the floor straight away (+1) or towards (-1) the camera."""
    return (0.0, -1.0 if sense > 0 else 1.0), math.copysign(math.cos(PITCH), sense)
