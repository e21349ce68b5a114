"""The room around the objects: its random parts and its depth. No picture is drawn here."""

from dataclasses import dataclass

import numpy as np

from .accept import Accepted
from .camera import Camera

FLOORS = ((0.30, 0.17, 0.085), (0.20, 0.125, 0.09), (0.38, 0.32, 0.25), (0.27, 0.27, 0.265))
WALLS = ((0.60, 0.56, 0.50), (0.55, 0.55, 0.54), (0.62, 0.58, 0.54))
FLOOR_HALF, WALL_HALF, WALL_HEIGHT = 12.0, 14.0, 4.0
"""Metres: half of the floor's side, half of a wall's width, a wall's height."""


@dataclass(frozen=True)
class Room:
    """Floor, two far walls, sun and sky.

    Colours are linear RGB. `streak` stretches the floor's grain along x and y. `walls` are the points (x, y) in metres
    of each wall that are nearest to the origin; a wall stands at a right angle to the line from the origin to it.
    `sun` is where the sun stands, `sun_size` its angle in radians.
    """

    sky: float
    streak: tuple[float, float, float]
    floor: tuple[float, float, float]
    wall: tuple[float, float, float]
    walls: tuple[tuple[float, float], ...]
    sun: tuple[float, float, float]
    sun_energy: float
    sun_size: float

    def wall_corners(self, wall: tuple[float, float]) -> np.ndarray:
        """Corners (4, 3) of a wall in metres, around it."""
        out = np.array(wall)
        along = np.array([-out[1], out[0]]) / np.linalg.norm(out) * WALL_HALF
        ends = ((-1, 0.0), (1, 0.0), (1, WALL_HEIGHT), (-1, WALL_HEIGHT))
        return np.array([(*(out + side * along), z) for side, z in ends])

    def depth(self, camera: Camera) -> np.ndarray:
        """Depth (height, width) in metres of floor and walls; infinite where the sky is seen."""
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays, eye = camera.ray(np.stack([x, y], -1)), camera.pose[:3, 3]
        nearest = np.full((camera.height, camera.width), np.inf)
        # Rays are one unit of depth long, so the factor that takes a ray to a plane is the depth there.
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = -eye[2] / rays[..., 2]
            reached = np.abs(eye[:2] + factor[..., None] * rays[..., :2]).max(-1) <= FLOOR_HALF
            nearest[reached & (factor > 0)] = factor[reached & (factor > 0)]
            for wall in self.walls:
                out = np.array(wall)
                normal = out / np.linalg.norm(out)
                factor = ((out - eye[:2]) @ normal) / (rays[..., :2] @ normal)
                point = eye + factor[..., None] * rays
                aside = np.abs((point[..., :2] - out) @ np.array([-normal[1], normal[0]]))
                seen = (factor > 0) & (aside <= WALL_HALF) & (point[..., 2] >= 0) & (point[..., 2] <= WALL_HEIGHT)
                nearest[seen] = np.minimum(nearest, factor)[seen]
        return nearest


def room_of(item: Accepted) -> Room:
    """The room of an item: its walls are behind the objects, as the camera sees them."""
    random, camera = item.key.random("look"), item.camera
    sky = float(random.uniform(0.55, 0.75))
    streak = (8.0, 0.7, 1.0) if random.uniform() < 0.5 else (0.7, 8.0, 1.0)
    floor, wall = FLOORS[int(random.integers(len(FLOORS)))], WALLS[int(random.integers(len(WALLS)))]
    away = camera.pose[:2, 2] / np.linalg.norm(camera.pose[:2, 2])
    yaw = np.arctan2(away[1], away[0]) + random.uniform(-0.5, 0.5)
    walls = []
    for turn in (0.0, np.pi / 2 * random.choice([-1, 1])):
        out = np.array([np.cos(yaw + turn), np.sin(yaw + turn)]) * random.uniform(3.4, 4.4)
        walls.append((float(out[0]), float(out[1])))
    angle = random.uniform(0, 2 * np.pi)
    sun = (float(np.cos(angle) * 0.8), float(np.sin(angle) * 0.8), 2.4)
    energy, size = float(random.uniform(1.8, 2.4)), float(np.radians(random.uniform(9, 16)))
    return Room(sky, streak, floor, wall, tuple(walls), sun, energy, size)
