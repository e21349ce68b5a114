"""A toy car of boxes and wheels, drawn as labels: what an image should show of a vehicle that faces a given way.

Its own frame: x ahead, y to the left, z up, lengths in those of a car of 0.58 with its wheels on the floor. The
bonnet is longer than the boot, glass is in front of and beside the cabin, and lamps are at the front.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.physics.camera import FloorCamera
from cow_service.records import BBox
from cow_service.vision.masks import Floats

PAINT, DARK, OTHER = 1, 2, 3  # labels of pixels, 0 beside it: the body's colour, tyres, and glass and lamps
Labels = NDArray[np.uint8]

_SUBPIXEL_BITS = 4  # of the coordinates that OpenCV draws
_FOOT = 0.65  # of the box's height: where the middle of its foot is taken to be
_FITS = 2  # rounds in which the model's size is fitted to the box


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Floats:
    """Corners [8, 3]."""
    return np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)], np.float64)


def _wheel(x: float, y: float) -> Floats:
    """Both rims [24, 3] of a wheel that stands on the floor."""
    turns, radius = np.linspace(0, 2 * np.pi, 12, endpoint=False), 0.078
    rim = np.column_stack([x + radius * np.cos(turns), np.full(12, y), radius + radius * np.sin(turns)])
    return np.concatenate([rim + np.array([0.0, side, 0.0]) for side in (-0.03, 0.03)])


_BODY = _box((-0.29, -0.15, 0.05), (0.29, 0.15, 0.20))
_CABIN = _box((-0.21, -0.13, 0.20), (0.10, 0.13, 0.34))
_WHEELS = {side: tuple(_wheel(x, 0.14 * side) for x in (-0.17, 0.17)) for side in (-1, 1)}
_WINDSCREEN = _box((0.10, -0.115, 0.215), (0.10, 0.115, 0.32))
_WINDOWS = {side: _box((-0.17, 0.13 * side, 0.225), (0.06, 0.13 * side, 0.315)) for side in (-1, 1)}
_LAMPS = tuple(_box((0.29, y - 0.03, 0.12), (0.29, y + 0.03, 0.17)) for y in (-0.10, 0.10))
_ALL = np.concatenate([_BODY, _CABIN, *_WHEELS[-1], *_WHEELS[1]])
_AXIS = np.array([[-0.05, 0.0, 0.17], [0.05, 0.0, 0.17]])  # about its middle


@dataclass(frozen=True)
class VehicleModel:
    """The car before a camera: it stands at a floor point (m), is as large as the box it is fitted to, and turned."""

    camera: FloorCamera
    foot: Floats  # [3] right, up and ahead
    yaw: float  # radians from right towards ahead
    scale: float
    shift: Floats  # [2] px: what centres it in its box

    @staticmethod
    def fitted(camera: FloorCamera, bbox: BBox, yaw: float) -> VehicleModel | None:
        """The car that is turned so and fills a box [x0, y0, x1, y1] (px) best; None where there is no floor."""
        x0, y0, x1, y1 = bbox
        points = camera.floor_points(np.array([[(x0 + x1) / 2, y0 + _FOOT * (y1 - y0)]]))
        if np.isnan(points).any():
            return None
        foot = camera.to_floor(points)[0]
        size = float(np.hypot(foot[0], foot[2])) * (x1 - x0) / camera.focal
        model = VehicleModel(camera, foot, yaw, size, np.zeros(2))
        for _ in range(_FITS):
            low, high = model._extent()
            size *= math.sqrt((x1 - x0) * (y1 - y0) / max(1e-6, float(np.prod(high - low))))
            model = VehicleModel(camera, foot, yaw, size, np.zeros(2))
        low, high = model._extent()
        return VehicleModel(camera, foot, yaw, model.scale, np.array([x0 + x1, y0 + y1]) / 2 - (low + high) / 2)

    @property
    def ahead(self) -> Floats:
        """Unit vector [2] (px) in the image of the way that it faces."""
        start, end = self._project(_AXIS)
        return (end - start) / max(1e-9, float(np.linalg.norm(end - start)))

    def drawn(self, corner: tuple[int, int], scale: float, shape: tuple[int, int]) -> Labels:
        """Labels [h, w] of a window of the image from a corner [x, y] (px) on, resized by a scale."""
        labels = np.zeros(shape, np.uint8)
        ahead, left = self._eye()
        near = 1 if left > 0 else -1
        parts = [(part, DARK) for part in _WHEELS[-near]] + [(_BODY, PAINT)]
        parts += [(part, OTHER) for part in _LAMPS if ahead > _BODY[:, 0].max()]
        parts.append((_CABIN, PAINT))
        if ahead > _CABIN[:, 0].max():
            parts.append((_WINDSCREEN, OTHER))
        parts += [(part, OTHER) for side, part in _WINDOWS.items() if side * left > _CABIN[:, 1].max()]
        parts += [(part, DARK) for part in _WHEELS[near]]
        for part, label in parts:
            points = (self._project(part) - np.array(corner)) * scale * 2**_SUBPIXEL_BITS
            hull = cv2.convexHull(points.astype(np.int32))
            cv2.fillConvexPoly(labels, hull, label, shift=_SUBPIXEL_BITS)
        return labels

    def _extent(self) -> tuple[Floats, Floats]:
        points = self._project(_ALL)
        return points.min(axis=0), points.max(axis=0)

    def _project(self, points: Floats) -> Floats:
        """Image points [N, 2] (px) of points [N, 3] of the car."""
        ahead, left, up = (points * self.scale).T
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        floor = np.column_stack([cosine * ahead - sine * left, up, sine * ahead + cosine * left])
        return self.camera.project(self.camera.from_floor(floor + self.foot)) + self.shift

    def _eye(self) -> tuple[float, float]:
        """Where the camera is in the car's frame: ahead of and to the left of its middle."""
        right, ahead = -self.foot[0], -self.foot[2]
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        return (cosine * right + sine * ahead) / self.scale, (cosine * ahead - sine * right) / self.scale
