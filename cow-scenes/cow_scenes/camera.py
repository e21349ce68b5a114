"""A pinhole camera: x right, y down, z forward (as OpenCV); world z up, floor at 0, metres."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Camera:
    """Focal length in pixels, picture size in pixels, pose (4, 4) that takes camera to world coordinates."""

    focal: float
    width: int
    height: int
    pose: np.ndarray

    @property
    def matrix(self) -> np.ndarray:
        """K (3, 3); the principal point is the middle of the picture."""
        return np.array([[self.focal, 0, self.width / 2], [0, self.focal, self.height / 2], [0, 0, 1.0]])

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) in camera coordinates."""
        return (np.asarray(points, float) - self.pose[:3, 3]) @ self.pose[:3, :3]

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) as pixels (..., 2); they have to be in front of the camera."""
        p = self.to_camera(points)
        return p[..., :2] / p[..., 2:] * self.focal + np.array([self.width / 2, self.height / 2])

    def ray(self, pixels: np.ndarray) -> np.ndarray:
        """Directions (..., 3) in the world, one unit of depth long, through pixels (..., 2)."""
        p = (np.asarray(pixels, float) - np.array([self.width / 2, self.height / 2])) / self.focal
        return np.concatenate([p, np.ones((*p.shape[:-1], 1))], -1) @ self.pose[:3, :3].T

    def at_width(self, width: int, height: int) -> "Camera":
        """The same camera with a picture of another size."""
        return Camera(self.focal * width / self.width, width, height, self.pose)


def look_at(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Pose (4, 4) of a camera without roll that looks from a point to another."""
    forward = target - position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
    pose[:3, 3] = position
    return pose


def draw_camera(
    random: np.random.Generator, width: int, height: int, around: np.ndarray, side: float | None = None
) -> Camera:
    """A camera that looks at a point from any (or a given) side: pitch 20 to 36 degrees, 2.6 to 3.7 m away."""
    yaw, pitch = random.uniform(0, 2 * np.pi), np.radians(random.uniform(20, 36))
    yaw = yaw if side is None else side
    away = random.uniform(2.6, 3.7)
    back = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    return Camera(random.uniform(745, 930) * width / 832, width, height, look_at(around + back * away, around))
