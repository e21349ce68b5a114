"""The pinhole camera above a floor: rays, floor points and projection.

Positions are metres in the frame of the camera: x right, y down, z ahead, its centre the origin. The ray of a pixel is
((x - cx) / f, (y - cy) / f, 1). With pitch p and roll 0, up is (0, -cos p, -sin p) and ahead over the floor is
(0, -sin p, cos p).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cow_service.records import CameraEstimate
from cow_service.vision.types import Floats

NEAREST = 1e-3  # of the camera's height: depths below it project as if they were there
HORIZON = 0.02  # sine of the angle below the horizon from which a ray meets the floor at a sane distance


@dataclass(frozen=True)
class FloorCamera:
    """Focal length (px), pitch and roll (radians), height above the floor (m) and the image's size (px)."""

    width: int
    height_px: int
    focal: float
    pitch: float  # positive: it looks down
    roll: float  # positive: the vertical leans to the left in the image
    height: float

    @staticmethod
    def of(estimate: CameraEstimate, width: int, height_px: int) -> FloorCamera:
        """The camera of a record, for an image of a size in px."""
        pitch, roll = math.radians(estimate.pitch), math.radians(estimate.roll)
        return FloorCamera(width, height_px, estimate.focal, pitch, roll, estimate.height)

    @cached_property
    def axes(self) -> Floats:
        """Rows: right, up and ahead over the floor [3, 3], unit vectors in the frame of the camera."""
        return axes_of(np.array([self.pitch]), np.array([self.roll]))[0]

    @property
    def right(self) -> Floats:
        """Unit vector [3] over the floor."""
        return self.axes[0]

    @property
    def up(self) -> Floats:
        """Unit vector [3]."""
        return self.axes[1]

    @property
    def ahead(self) -> Floats:
        """Unit vector [3] over the floor, away from the camera."""
        return self.axes[2]

    def rays(self, points: Floats) -> Floats:
        """Rays [N, 3] of depth 1 through image points [N, 2] (px)."""
        across = (points - np.array([self.width / 2, self.height_px / 2])) / self.focal
        return np.column_stack([across, np.ones(len(points))])

    def project(self, positions: Floats) -> Floats:
        """Image points [N, 2] (px) of positions [N, 3] (m)."""
        z = np.maximum(positions[:, 2:], NEAREST * self.height)
        return positions[:, :2] * self.focal / z + np.array([self.width / 2, self.height_px / 2])

    def above_floor(self, positions: Floats) -> Floats:
        """Heights [N] (m) of positions [N, 3]."""
        return positions @ self.up + self.height

    def floor_points(self, points: Floats) -> Floats:
        """Positions [N, 3] (m) on the floor under image points [N, 2] (px); nan at and above the horizon."""
        rays = self.rays(points)
        sink = -rays @ self.up
        length = np.linalg.norm(rays, axis=1)
        depth = np.where(sink > HORIZON * length, self.height / np.where(sink > 0, sink, 1.0), np.nan)
        return rays * depth[:, None]

    def to_floor(self, positions: Floats) -> Floats:
        """Coordinates [N, 3] (m) right, above the floor and ahead, of positions [N, 3] in the frame of the camera."""
        return positions @ self.axes.T + np.array([0.0, self.height, 0.0])

    def from_floor(self, coordinates: Floats) -> Floats:
        """Positions [N, 3] (m) in the frame of the camera, of coordinates [N, 3] right, above the floor and ahead."""
        return (coordinates - np.array([0.0, self.height, 0.0])) @ self.axes


def axes_of(pitch: Floats, roll: Floats) -> Floats:
    """Unit vectors right, up and ahead over the floor [K, 3, 3] in the frames of cameras, from radians [K] each."""
    sine, cosine, zero = np.sin(pitch), np.cos(pitch), np.zeros(len(pitch))
    s, c = np.sin(roll), np.cos(roll)
    # A roll turns the image about the optical axis: up leans to the left where it is positive.
    right = np.stack([c, -s, zero], axis=1)
    up = np.stack([-s * cosine, -c * cosine, -sine], axis=1)
    ahead = np.stack([-s * sine, -c * sine, cosine], axis=1)
    return np.stack([right, up, ahead], axis=1)
