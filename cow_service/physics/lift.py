"""From boxes in the image to bodies on a floor, for many draws of what is uncertain at once.

Coordinates are metres right, above the floor and ahead, the camera above their origin. Arrays have a row per draw [K].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cow_service.physics.camera import HORIZON, CameraFit, axes_of
from cow_service.physics.draws import COLUMN
from cow_service.records import BBox, Shape
from cow_service.vision.types import Floats

SIZE_SIGMA = 0.08  # of a body's width: boxes are inexact, and a thing is not as deep as wide
FOOT_SIGMA = 0.02  # of a body's height in the image: where it meets the floor
SLIMMEST, TALLEST = 0.2, 12.0  # half heights, in half widths
NEAREST, FARTHEST = 0.05, 40.0  # depths, in those of the first body: what seems to lie elsewhere is put there
BOX_SIDE = 0.82  # of the seen width of a box whose yaw is not known: its side


@dataclass(frozen=True)
class Cameras:
    """Cameras [K] of one image, as the draws have them."""

    width: int  # px, of the image
    height_px: int
    focal: Floats  # [K] px
    axes: Floats  # [K, 3, 3]: rows right, up and ahead over the floor
    height: Floats  # [K] m above the floor

    @staticmethod
    def drawn(fit: CameraFit, size: tuple[int, int], draws: Floats) -> tuple[Cameras, Floats]:
        """Cameras 1 m above the floor, and the five fitted parameters [K, 5], for draws [K, P]."""
        names = ("pitch", "focal", "height", "slant_right", "slant_ahead")
        normal = draws[:, [COLUMN[name] for name in names]]
        parameters = fit.mean + normal @ np.linalg.cholesky(fit.covariance).T
        roll = fit.roll + fit.roll_sigma * draws[:, COLUMN["roll"]]
        pitch = np.clip(parameters[:, 0], -1.4, 1.4)
        focal = np.exp(np.clip(parameters[:, 1], -2, 3)) * size[0]
        return Cameras(*size, focal, axes_of(pitch, roll), np.ones(len(draws))), parameters

    def at_height(self, height: Floats) -> Cameras:
        """The same cameras at other heights [K] (m)."""
        return replace(self, height=height)

    def repeated(self, count: int, draw: int = 0) -> Cameras:
        """The camera of one draw so many times."""
        one = slice(draw, draw + 1)
        focal, axes, height = (np.repeat(values[one], count, axis=0) for values in (self.focal, self.axes, self.height))
        return replace(self, focal=focal, axes=axes, height=height)

    def rays(self, point: tuple[float, float] | Floats) -> Floats:
        """Rays [K, 3] through an image point (px), or through one each [K, 2]: right, up and ahead, of depth 1."""
        across = (np.asarray(point, np.float64) - np.array([self.width / 2, self.height_px / 2])) / self.focal[:, None]
        rays = np.concatenate([across, np.ones((len(self.focal), 1))], axis=1)
        return np.einsum("kij,kj->ki", self.axes, rays)

    def project(self, coordinates: Floats) -> tuple[Floats, Floats]:
        """Image points [K, ..., 2] (px) and depths [K, ...] (m) of coordinates [K, ..., 3]."""
        steps = (slice(None),) + (None,) * (coordinates.ndim - 2)
        from_camera = coordinates - np.array([0.0, 1.0, 0.0]) * self.height[(*steps, None)]
        position = np.einsum("k...i,kij->k...j", from_camera, self.axes)
        z = np.maximum(position[..., 2], 1e-3 * self.height[steps])
        points = position[..., :2] * (self.focal[steps] / z)[..., None]
        return points + np.array([self.width / 2, self.height_px / 2]), position[..., 2]

    def coordinates(self, positions: Floats) -> Floats:
        """Coordinates [K, 3] above the floor, of positions seen from the camera: right, up and ahead."""
        return positions + np.stack([np.zeros(len(self.height)), self.height, np.zeros(len(self.height))], axis=1)

    def depth(self, coordinates: Floats) -> Floats:
        """Depths [K] (m) of coordinates [K, 3]."""
        return self.project(coordinates)[1]


@dataclass(frozen=True)
class LiftedBody:
    """A body where the draws have it."""

    shape: Shape
    centre: Floats  # [K, 3]
    half_width: Floats  # [K]
    half_height: Floats  # [K]
    stands: bool  # on the floor or on another body; else it is in the air
    depth_share: float = 1.0  # how deep it is along the line of sight, of its width

    def repeated(self, count: int) -> LiftedBody:
        """As the first draw has it, so many times."""
        centre, *halves = (np.repeat(v[:1], count, axis=0) for v in (self.centre, self.half_width, self.half_height))
        return replace(self, centre=centre, half_width=halves[0], half_height=halves[1])

    @property
    def top(self) -> Floats:
        """Height [K] of its upper end above the floor."""
        return self.centre[:, 1] + self.half_height


def above(
    cameras: Cameras,
    bbox: BBox,
    shape: Shape,
    draws: Floats,
    plane: Floats,
    depth_share: float = 1.0,
    taper: float = 1.0,
) -> LiftedBody | None:
    """A body that stands on a horizontal plane at a height [K] (m); None where its foot lies at or above the horizon.

    The foot is the middle of the box's lower edge; the body's middle lies half its depth there further away, which is
    `taper` of that at its top. A sphere's depth follows from its radius and its middle.
    """
    height = cameras.height - plane
    stretch = np.exp(SIZE_SIGMA * draws[:, COLUMN["size"]])
    x0, y0, x1, y1 = bbox
    if shape == "sphere":
        rays, radius = cameras.rays(((x0 + x1) / 2, (y0 + y1) / 2)), (x1 - x0 + y1 - y0) / 4
        sink = radius / cameras.focal - rays[:, 1]
        if not (sink[0] > HORIZON and height[0] > 0):
            return None
        z = height / np.maximum(sink, HORIZON)
        half = z * radius / cameras.focal
        return LiftedBody(shape, cameras.coordinates(rays * z[:, None]), half, half, True)
    foot = y1 + FOOT_SIGMA * (y1 - y0) * draws[:, COLUMN["foot"]]
    rays = cameras.rays(np.stack([np.full(len(foot), (x0 + x1) / 2), foot], axis=1))
    if not (-rays[0, 1] > HORIZON and height[0] > 0):  # the likeliest ray meets the plane at no sane distance
        return None
    near = rays[:, [0, 2]] * (height / np.maximum(-rays[:, 1], HORIZON))[:, None]
    distance = np.linalg.norm(near, axis=1)
    way = near / distance[:, None]
    half, tall, centre = np.zeros(len(foot)), np.zeros(len(foot)), np.zeros((len(foot), 3))
    wide = (x1 - x0) / (2 * cameras.focal)
    upper = cameras.rays(((x0 + x1) / 2, y0))
    slope = upper[:, 1] / np.maximum(np.linalg.norm(upper[:, [0, 2]], axis=1), 1e-6)
    for _ in range(5):
        middle = near + way * (half * depth_share * taper)[:, None]
        # What is seen from above is widest at its top, which is nearer; a cone is at its foot.
        widest = plane + (0.0 if shape == "cone" else 2 * tall)
        depth = cameras.depth(np.stack([middle[:, 0], widest, middle[:, 1]], axis=1))
        half = wide / np.sqrt(1 + wide**2) * np.maximum(depth, 1e-3 * height)
        deep = half * depth_share
        # The upper edge of the box is the far rim of a top that is seen from above, else the near one.
        rim = np.zeros(len(deep)) if shape == "cone" else np.where(slope < 0, deep, -deep)
        top = cameras.height + slope * np.maximum(distance + deep * taper + rim, 1e-3)
        tall = np.clip((top - plane) / 2, SLIMMEST * deep, TALLEST * deep)
        centre = np.stack([middle[:, 0], plane + tall, middle[:, 1]], axis=1)
    return LiftedBody(shape, centre, half * stretch, tall, True, depth_share)


def in_the_air(cameras: Cameras, bbox: BBox, shape: Shape, depth: Floats) -> LiftedBody:
    """A body at depths [K] (m), as wide and high as its box."""
    x0, y0, x1, y1 = bbox
    rays = cameras.rays(((x0 + x1) / 2, (y0 + y1) / 2))
    half, tall = ((x1 - x0) * depth / cameras.focal / 2, (y1 - y0) * depth / cameras.focal / 2)
    if shape == "sphere":
        half = tall = (half + tall) / 2
    return LiftedBody(shape, cameras.coordinates(rays * depth[:, None]), half, tall, False)
