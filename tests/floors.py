"""A camera above a floor with known truth, written without the project's geometry: where things are seen, and boxes.

Places are metres right of the camera, above the floor and ahead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.physics.camera import CameraFit

Floats = NDArray[np.float64]
Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class TrueCamera:
    """Angles in degrees; a positive roll leans the vertical to the left in the image."""

    pitch: float = 28.0
    roll: float = 0.0
    focal: float = 640.0  # px
    height: float = 1.5  # m above the floor
    size: tuple[int, int] = (640, 400)  # px

    def positions(self, places: Floats) -> Floats:
        """Places [N, 3] as x right, y down and z ahead of the camera."""
        right, above, ahead = np.asarray(places, float).T
        pitch, roll = np.radians(self.pitch), np.radians(self.roll)
        drop = self.height - above
        level = np.stack([right, drop * np.cos(pitch) - ahead * np.sin(pitch)], axis=1)
        depth = ahead * np.cos(pitch) + drop * np.sin(pitch)
        turn = np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
        return np.column_stack([level @ turn.T, depth])

    def seen(self, places: Floats) -> Floats:
        """Image points [N, 2] (px)."""
        position = self.positions(places)
        return position[:, :2] * self.focal / position[:, 2:] + np.array(self.size) / 2

    def _rays(self, x: Floats | float, y: Floats | float) -> tuple[Floats, Floats, Floats]:
        """How far to the right, down and ahead the rays of image points (px) go, per metre of depth."""
        u, v = (x - self.size[0] / 2) / self.focal, (y - self.size[1] / 2) / self.focal
        roll, pitch = np.radians(self.roll), np.radians(self.pitch)
        right, down = u * np.cos(roll) - v * np.sin(roll), u * np.sin(roll) + v * np.cos(roll)
        return right, down * np.cos(pitch) + np.sin(pitch), np.cos(pitch) - down * np.sin(pitch)

    def on_floor(self, point: tuple[float, float]) -> tuple[float, float] | None:
        """Where on the floor (right, ahead) an image point (px) lies; None above the horizon and far away."""
        right, sink, ahead = self._rays(*point)
        if sink < 0.12:
            return None
        return float(right / sink * self.height), float(ahead / sink * self.height)

    def depth(self, boxes: Sequence[Box] = ()) -> Floats:
        """Depth [H, W] (m) along the optical axis of the floor, nan above the horizon, and of upright boards in boxes.

        A board (px) faces the camera and stands at the middle of its lower edge.
        """
        width, height = self.size
        _, sink, ahead = self._rays(*np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))
        depth = np.where(sink > 0.02, self.height / np.where(sink > 0.02, sink, 1.0), np.nan)
        for x0, y0, x1, y1 in ((round(edge) for edge in box) for box in boxes):
            at = min(height - 1, y1), min(width - 1, (x0 + x1) // 2)
            board = slice(y0, y1), slice(x0, x1)
            depth[board] = depth[at] * ahead[at] / ahead[board]
        return depth

    def floor_places(self) -> Floats:
        """Where on the floor [H, W, 3] each pixel looks; nan above the horizon."""
        depth, (width, height) = self.depth(), self.size
        right, _, ahead = self._rays(*np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5))
        return np.stack([right * depth, 0 * depth, ahead * depth], axis=-1)

    def shadow_rim(self, ball: tuple[float, float, float], light: tuple[float, float]) -> Floats:
        """Image points [360, 2] (px) around the shadow of a ball of radius 1, lit from far away.

        `light`: how far a shadow goes right and ahead per unit of height.
        """
        slant, turns = np.array(light), np.linspace(0, 2 * np.pi, 360, endpoint=False)
        circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        along = slant / max(float(np.hypot(*slant)), 1e-9)
        rim = circle + np.outer(circle @ along, along) * (math.sqrt(1 + slant @ slant) - 1)
        rim += np.array([ball[0], ball[2]]) + ball[1] * slant
        return self.seen(np.column_stack([rim[:, 0], np.zeros(len(rim)), rim[:, 1]]))

    def away(self, place: tuple[float, float]) -> float:
        """Distance (m) of a place on the floor from the camera."""
        return math.hypot(*place, self.height)

    def box(self, places: Floats) -> Box:
        """The box (px) around the image of places."""
        points = self.seen(places)
        return _box(points)

    def sphere_box(self, centre: tuple[float, float, float], radius: float) -> Box:
        """The box (px) of a sphere: planes through the camera that touch it."""
        x, y, z = self.positions(np.array([centre]))[0]
        edges = []
        for across in (x, y):
            root = radius * np.sqrt(across**2 + z**2 - radius**2)
            edges.append((across * z + np.array([-root, root])) / (z**2 - radius**2))
        points = np.stack(edges, axis=1) * self.focal + np.array(self.size) / 2
        return _box(points)


def _box(points: Floats) -> Box:
    (x0, y0), (x1, y1) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return x0, y0, x1, y1


def outline(shape: str, foot: tuple[float, float], half_width: float, height: float, yaw: float = 0.0) -> Floats:
    """Places [N, 3] on the rims of a cylinder, cone or box that stands with the middle of its base at a foot."""
    if shape == "box":
        turns = yaw + np.pi / 4 + np.arange(4) * np.pi / 2
        reach = half_width * np.sqrt(2)
    else:
        turns, reach = np.linspace(0, 2 * np.pi, 64, endpoint=False), half_width
    rim = np.array(foot) + reach * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    top = np.array([foot]) if shape == "cone" else rim
    raised = [np.column_stack([ring[:, 0], np.full(len(ring), h), ring[:, 1]]) for ring, h in ((rim, 0), (top, height))]
    return np.concatenate(raised)


def known(camera: TrueCamera, deviation: float = 1e-8) -> CameraFit:
    """What a fit says that knows a camera; of the height above the floor and the light it knows nothing."""
    mean = np.array([math.radians(camera.pitch), math.log(camera.focal / camera.size[0]), math.log(5), 0.0, 0.1])
    sigma = np.array([deviation, deviation, 0.6, 0.5, 0.45])
    return CameraFit(mean, np.diag(sigma**2), math.radians(camera.roll), 0.0, "prior")


def depth_png(depth: Floats, scale: float = 0.001) -> bytes:
    """The PNG of 16 bits of a depth [H, W] (m), in units of a scale (m)."""
    encoded, data = cv2.imencode(".png", np.nan_to_num(depth / scale).clip(0, 65535).round().astype(np.uint16))
    assert encoded
    return data.tobytes()
