"""From worlds that were run back to the image: points, apparent size, turns, and how far they spread."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cow_service.physics.world import Worlds
from cow_service.vision.types import Floats, Mask

UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # quaternion x, y, z, w
MOST_LEAN = np.radians(25)
PASSED = 0.08  # of its first depth: closer than this, a body has passed the camera


@dataclass(frozen=True)
class SeenPaths:
    """What one body does in the image, for draws [K] and recorded frames [F]."""

    points: Floats  # [K, F, 2] px
    depth: Floats  # [K, F] m
    scale: Floats  # [K, F]: apparent size, 1 as the image shows it
    passed: Mask  # [K, F]: it is at or behind the camera
    before: Floats | None = None  # [K, 2] px: where the image shows it, if it begins elsewhere

    @property
    def seen(self) -> Floats:
        """Points [K, 2] (px) at which the image shows it."""
        return self.points[:, 0] if self.before is None else self.before


def seen_paths(worlds: Worlds, body: int) -> SeenPaths:
    """A body's path in the image of every draw."""
    positions = np.stack([run.positions[body] for run in worlds.runs])
    points, depth = worlds.scene.cameras.project(positions)
    before, first = None, depth[:, :1]
    if worlds.seen is not None:
        shown = np.array([bodies[body].position for bodies in worlds.seen])
        before, first = worlds.scene.cameras.project(shown[:, None])
        before = before[:, 0]
    first = np.maximum(first, 1e-9)
    return SeenPaths(points, depth, first / np.maximum(depth, PASSED * first), depth <= PASSED * first, before)


def states(worlds: Worlds, body: int) -> Floats:
    """[F, 6] metres and m/s in the frame of the camera, of the first draw."""
    cameras, run = worlds.scene.cameras, worlds.runs[0]
    position = run.positions[body] - np.array([0.0, cameras.height[0], 0.0])
    return np.hstack([position @ cameras.axes[0], run.velocities[body] @ cameras.axes[0]])


def rotation(worlds: Worlds, body: int) -> Floats:
    """Degrees [F] that a body of the first draw has turned in the image, clockwise, since the first frame.

    A sphere turns by its spin about the line of sight. Of anything else the upright axis is followed: what turns about
    it looks the same.
    """
    run, cameras = worlds.runs[0], worlds.scene.cameras
    turns = run.turns[body]
    if worlds.shapes[0][body].shape == "sphere":
        sight = run.positions[body] - np.array([0.0, cameras.height[0], 0.0])
        sight = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-9)[:, None]
        # Right, up and ahead are a left-handed frame: there a positive turn about the line of sight is anticlockwise.
        about = -np.einsum("fi,fi->f", _steps(turns), sight[1:])
        return np.concatenate([[0.0], np.degrees(np.cumsum(about))])
    return _leaned(worlds, run.positions[body], turns)


def rotation_where_put(worlds: Worlds, body: int) -> float:
    """Degrees, clockwise, that a body of the first draw is turned at its first frame against how the image shows it.

    A sphere looks the same wherever it is put.
    """
    if worlds.seen is None or worlds.shapes[0][body].shape == "sphere":
        return 0.0
    positions = np.array([worlds.seen[0][body].position, worlds.shapes[0][body].position])
    turn = worlds.shapes[0][body].turn
    return float(_leaned(worlds, positions, np.array([UPRIGHT, UPRIGHT if turn is None else turn]))[1])


def _leaned(worlds: Worlds, positions: Floats, turns: Floats) -> Floats:
    """Degrees [F], clockwise, that an upright axis has leaned since the first of positions [F, 3] and turns [F, 4]."""
    upright = np.tile(np.array([0.0, 1.0, 0.0]), (len(turns), 1))
    leaning, plumb = (np.unwrap(_lean(worlds, positions, axis)) for axis in (turned(turns, upright[0]), upright))
    angle = np.unwrap(leaning - plumb)
    # Verticals lean in the image as they come to its side; close to the camera they lean without bounds.
    return np.degrees(angle - angle[0] + np.clip(plumb - plumb[0], -MOST_LEAN, MOST_LEAN))


def _lean(worlds: Worlds, positions: Floats, axis: Floats) -> Floats:
    """Radians [F] by which directions [F, 3] at positions [F, 3] lean to the right in the image of the first draw."""
    step = 1e-3 * float(worlds.scene.cameras.height[0])
    points, _ = worlds.scene.cameras.part(slice(0, 1)).project((positions + np.stack([axis, -axis]) * step)[None])
    way = points[0, 0] - points[0, 1]
    return np.arctan2(way[:, 0], -way[:, 1])


def _steps(turns: Floats) -> Floats:
    """Rotation vectors [F - 1, 3] that lead from each quaternion of [F, 4] (x, y, z, w) to the next."""
    before, after = turns[:-1], turns[1:]
    axis = before[:, 3:] * after[:, :3] - after[:, 3:] * before[:, :3] + np.cross(before[:, :3], after[:, :3])
    half = np.einsum("fi,fi->f", before, after)
    axis = axis * np.where(half < 0, -1.0, 1.0)[:, None]
    length = np.linalg.norm(axis, axis=1)
    return axis * (2 * np.arctan2(length, np.abs(half)) / np.maximum(length, 1e-12))[:, None]


def turned(turns: Floats, vector: Floats) -> Floats:
    """A vector [3] turned by quaternions [F, 4]."""
    axis, w = turns[:, :3], turns[:, 3:]
    across = np.cross(axis, vector)
    return vector + 2 * (w * across + np.cross(axis, across))
