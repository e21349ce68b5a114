"""The camera of a picture: where it is, and how pixels and points belong together."""

from dataclasses import dataclass

import numpy as np

from .meshes import Random
from .stage import HEIGHT, WIDTH, Stage, quaternion


@dataclass(frozen=True)
class View:
    """A camera at `eye`; the rows of `axes` (3, 3) are right, down and forward in the world; focal length in pixels."""

    eye: np.ndarray
    axes: np.ndarray
    focal: float
    distance: float

    def pixel(self, point: np.ndarray) -> np.ndarray | None:
        """Where a point is seen (x, y), None behind the camera."""
        x, y, z = self.axes @ (point - self.eye)
        return np.array([WIDTH / 2 + self.focal * x / z, HEIGHT / 2 + self.focal * y / z]) if z > 0.02 else None

    def on_level(self, x: float, y: float, level: float) -> np.ndarray | None:
        """The point of a horizontal plane that is seen at a pixel, None at or above its horizon."""
        ray = np.array([(x - WIDTH / 2) / self.focal, (y - HEIGHT / 2) / self.focal, 1]) @ self.axes
        if ray[2] > -1e-3:
            return None
        point = self.eye + ray * (level - self.eye[2]) / ray[2]
        return point if self.eye[2] > level else None


def draw_view(random: Random) -> View:
    """A view of what is near the origin: 3 to 66 degrees down, 25 to 65 degrees high."""
    steep = random.uniform(10, 66) if random.random() < 0.85 else random.uniform(3, 12)
    pitch, high, yaw = np.radians(steep), random.uniform(25, 65), random.uniform(0, 2 * np.pi)
    distance = np.exp(random.uniform(np.log(0.7), np.log(2.4))) * (45 / high) ** 0.8
    aim = np.array([*random.uniform(-0.1, 0.1, 2), random.uniform(0, 0.12)])
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    eye = aim - forward * distance
    eye[2] = max(eye[2], 0.07)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    down, roll = np.cross(forward, right), random.normal(0, 0.03)
    c, s = np.cos(roll), np.sin(roll)
    axes = np.stack([right * c + down * s, down * c - right * s, forward])
    return View(eye, axes, HEIGHT / 2 / np.tan(np.radians(high) / 2), distance)


def aim(stage: Stage, view: View) -> None:
    """Give the stage's camera a view."""
    right, down, forward = view.axes
    stage.model.cam_pos[0] = view.eye
    stage.model.cam_quat[0] = quaternion(np.stack([right, -down, -forward], 1))
    stage.model.cam_fovy[0] = 2 * np.degrees(np.arctan(HEIGHT / 2 / view.focal))
