"""Cameras over a floor, the bodies that they see, lifted off the image, and how these set out, for many draws at once.

Coordinates are metres right, above the floor and ahead, the camera above their origin. Arrays have a row per draw [K].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cow_service.media.types import Floats
from cow_service.physics.camera import FLAT, HORIZON, LONGEST, SHORTEST, CameraFit, axes_of
from cow_service.physics.draws import COLUMN, quantiles
from cow_service.records import BBox, Cue, Motion, Shape

SIZE_SIGMA = 0.08  # of a body's width: boxes are inexact, and a thing is not as deep as wide
FOOT_SIGMA = 0.02  # of a body's height in the image: where it meets the floor
LEAST_FOOT = 0.002  # of the width of the image: no box is more exact
CUT = 0.3  # of the height of a body that the lower border of the image cuts off: how far it reaches beyond
SLIMMEST, TALLEST = 0.2, 12.0  # half heights, in half widths

# Degrees, one standard deviation of a direction in the image, by where it was read.
DIRECTION_DEVIATIONS: dict[Cue, float] = {
    "arrow": 1.5, "trail": 1.5, "orientation": 6.0, "text": 4.0, "gravity": 0.0, "request": 1.0,
}  # fmt: skip
TOWARDS_SIGMA = math.radians(2)  # of the heading of what moves towards another thing: it is aimed at its middle
RISE, RISE_SIGMA = math.radians(22), math.radians(12)  # above the horizontal: how things are thrown
AIMED, AIM_SIGMA = 8.0, math.radians(9)  # how much likelier a heading to what stands there is, and how exact
UNUSUAL = 0.1  # of the likeliest throw's weight: that of throws at any heading and of any steepness
TURNS = np.linspace(-5, 5, 81)  # in deviations: turns out of the plane of the image that are weighed
LOW = 0.08  # sine of the angle between a ray and a horizontal plane below which the plane through the foot is taken


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
        normal = draws[:, [COLUMN[name] for name in names]].copy()
        normal[:, :2] = np.clip(normal[:, :2], -FLAT, FLAT)  # no pitch and no focal length that no picture has
        parameters = fit.mean + normal @ np.linalg.cholesky(fit.covariance).T
        roll = fit.roll + fit.roll_sigma * draws[:, COLUMN["roll"]]
        pitch = np.clip(parameters[:, 0], -1.4, 1.4)
        focal = np.exp(np.clip(parameters[:, 1], SHORTEST, LONGEST)) * size[0]
        return Cameras(*size, focal, axes_of(pitch, roll), np.ones(len(draws))), parameters

    def at_height(self, height: Floats) -> Cameras:
        """The same cameras at other heights [K] (m)."""
        return replace(self, height=height)

    def repeated(self, count: int, draw: int = 0) -> Cameras:
        """The camera of one draw, repeated."""
        one = slice(draw, draw + 1)
        focal, axes, height = (np.repeat(values[one], count, axis=0) for values in (self.focal, self.axes, self.height))
        return replace(self, focal=focal, axes=axes, height=height)

    def of(self, draws: slice | NDArray[np.intp]) -> Cameras:
        """Those of some draws."""
        return replace(self, focal=self.focal[draws], axes=self.axes[draws], height=self.height[draws])

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
    depth_share: Floats | float = 1.0  # [K]: how deep it is along the line of sight, of its width
    yaw: float | None = None  # radians from right to ahead, of its width, where that was measured

    def of(self, draws: slice | NDArray[np.intp]) -> LiftedBody:
        """As some draws have it."""
        share = self.depth_share[draws] if isinstance(self.depth_share, np.ndarray) else self.depth_share
        centre, half, tall = self.centre[draws], self.half_width[draws], self.half_height[draws]
        return replace(self, centre=centre, half_width=half, half_height=tall, depth_share=share)

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
    depth_share: Floats | float = 1.0,
    taper: float = 1.0,
    bbox_deviation: float = 0.0,
) -> LiftedBody | None:
    """A body that stands on a horizontal plane at a height [K] (m); None if its foot lies at or above the horizon.

    The foot is the middle of the box's lower edge; the body's middle lies half its depth there further away, which is
    `taper` of that at its top. A sphere's depth follows from its radius and its middle. `bbox_deviation` is that of
    the lower edge, in heights of the box.
    """
    height = cameras.height - plane
    stretch = np.exp(math.hypot(SIZE_SIGMA, math.sqrt(2) * bbox_deviation) * draws[:, COLUMN["size"]])
    x0, y0, x1, y1 = bbox
    off = draws[:, COLUMN["foot"]]
    if shape == "sphere":
        middle = (y0 + y1) / 2 + bbox_deviation * (y1 - y0) * off
        rays = cameras.rays(np.column_stack([np.full(len(off), (x0 + x1) / 2), middle]))
        radius = (x1 - x0 + y1 - y0) / 4
        sink = radius / cameras.focal - rays[:, 1]
        if not (sink[0] > HORIZON and height[0] > 0):
            return None
        z = height / np.maximum(sink, HORIZON)
        half = z * radius / cameras.focal
        return LiftedBody(shape, cameras.coordinates(rays * z[:, None]), half, half, True)
    sigma = max(max(FOOT_SIGMA, bbox_deviation) * (y1 - y0), LEAST_FOOT * cameras.width)
    foot = y1 + (sigma * off if y1 <= cameras.height_px - 1 else CUT * (y1 - y0) * np.abs(off))
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


# --- how they set out


def velocity_towards(
    mover: LiftedBody,
    motion: Motion,
    cameras: Cameras,
    draws: Floats,
    goal: LiftedBody | None,
    others: Sequence[LiftedBody],
    speed_name: str,
) -> Floats:
    """[K, 3] m/s right, up and ahead; `goal` is the body that it moves towards, `others` are all other bodies."""
    if motion.direction is None or motion.speed == 0:
        return np.zeros((len(draws), 3))
    speed = motion.speed * motion.metres_per_pixel.value * speed_factors(motion, draws, speed_name)
    turn = math.radians(motion.direction_deviation) * draws[:, COLUMN["turn"]]
    # Words such as "to the right" say how it goes over the floor: seen at a low angle, a little in the image is a lot.
    is_over_floor = motion.cue == "text" and mover.stands and motion.kind == "linear" and not motion.rises
    direction = _turned(_directions(motion, draws), np.zeros_like(turn) if is_over_floor else turn)
    if goal is not None and (mover.stands or motion.kind == "projectile"):
        way = _towards(mover, goal, motion, draws)
    elif motion.kind == "projectile":
        way = _thrown(mover, motion, cameras, draws, direction, others)
    elif motion.rises:
        way = _in_plane(mover, cameras, direction, np.full(len(draws), math.asin(motion.depth)))
    elif mover.stands:
        way = along_floor(mover, motion, cameras, direction)
        way[:, [0, 2]] = _turned(way[:, [0, 2]], turn if is_over_floor else np.zeros_like(turn))
    else:
        way = _out_of_image(motion, cameras, direction)
    return way * speed[:, None]


def _directions(motion: Motion, draws: Floats) -> Floats:
    """Unit vectors [K, 2] in the image: of two that speak against each other, each for half of the draws."""
    x, y = motion.direction or (0.0, 0.0)
    other = motion.other_direction or (x, y)
    is_other = (draws[:, COLUMN["let_go_right"]] > 0)[:, None]
    return np.where(is_other, np.array(other) / max(math.hypot(*other), 1e-9), np.array([x, y]))


def _turned(vectors: Floats, angles: Floats) -> Floats:
    """Vectors [K, 2] turned by angles [K] (radians), from the first axis to the second."""
    cosine, sine, (x, y) = np.cos(angles), np.sin(angles), vectors.T
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)


def velocity_in_side_view(
    mover: LiftedBody, motion: Motion, draws: Floats, goal: LiftedBody | None, speed_name: str
) -> Floats:
    """[K, 3] m/s of what moves in a drawing that has no depth: along the floor where it stands."""
    turn = math.radians(motion.direction_deviation) * draws[:, COLUMN["turn"]]
    seen = _turned(_directions(motion, draws), turn)
    direction = np.column_stack([seen[:, 0], -seen[:, 1], np.zeros(len(draws))])
    if goal is not None:
        direction = goal.centre - mover.centre
    if mover.stands and motion.kind == "linear" and not motion.rises:
        direction = direction * np.array([1.0, 0.0, 0.0])
    speed = motion.speed * motion.metres_per_pixel.value * speed_factors(motion, draws, speed_name)
    return direction / np.maximum(np.linalg.norm(direction, axis=1), 1e-9)[:, None] * speed[:, None]


def speed_factors(motion: Motion, draws: Floats, name: str = "speed") -> Floats:
    """[K]: speeds of draws, in likeliest ones."""
    return np.exp(motion.speed_deviation * draws[:, COLUMN[name]])


def _towards(mover: LiftedBody, goal: LiftedBody, motion: Motion, draws: Floats) -> Floats:
    """Unit vectors [K, 3] over the floor towards another body; of a throw, upwards at the angles of throws."""
    away = goal.centre - mover.centre
    heading = np.arctan2(away[:, 2], away[:, 0]) + TOWARDS_SIGMA * draws[:, COLUMN["turn"]]
    rise = np.zeros(len(draws))
    if motion.kind == "projectile":
        rise = RISE + RISE_SIGMA * draws[:, COLUMN["depth"]]
    return np.stack([np.cos(rise) * np.cos(heading), np.sin(rise), np.cos(rise) * np.sin(heading)], axis=1)


def _out_of_image(motion: Motion, cameras: Cameras, direction: Floats) -> Floats:
    """Unit vectors [K, 3] of directions [K, 2] in the image, turned out of its plane as the motion says."""
    depth = np.full((len(direction), 1), motion.depth)
    way = np.concatenate([direction * math.sqrt(1 - motion.depth**2), depth], axis=1)
    return np.einsum("kij,kj->ki", cameras.axes, way)


def along_floor(mover: LiftedBody, motion: Motion, cameras: Cameras, direction: Floats) -> Floats:
    """Unit vectors [K, 3] over the floor whose image at the mover has the directions [K, 2]."""
    if motion.depth and motion.source == "request":  # readers' depth is that of the direction, which the floor tells
        way = _out_of_image(motion, cameras, direction)
    else:
        points, depth = cameras.project(mover.centre)
        step = cameras.focal / depth * mover.half_width * 0.05
        ends = [cameras.rays(points + side * step[:, None] * direction) for side in (-1.0, 1.0)]
        sink = -ends[0][:, 1] / np.linalg.norm(ends[0], axis=1)
        below = np.where(sink < LOW, mover.half_height, 0.0)
        drop = cameras.height - mover.centre[:, 1] + below
        hit = [ray * (drop / np.maximum(-ray[:, 1], 1e-3))[:, None] for ray in ends]
        way = hit[1] - hit[0]
    way[:, 1] = 0.0
    return way / np.maximum(np.linalg.norm(way, axis=1), 1e-12)[:, None]


def _thrown(
    mover: LiftedBody, motion: Motion, cameras: Cameras, draws: Floats, direction: Floats, others: Sequence[LiftedBody]
) -> Floats:
    """Unit vectors [K, 3] seen in directions [K, 2]: in a vertical plane, turned from that of the image by the depth.

    A drawn direction leaves the depth open. Small turns are likelier; so are throws that rise at the angle at which
    things are thrown, and throws that lead about to one of the things that stand there.
    """
    mean, sigma = math.asin(motion.depth), math.radians(motion.depth_deviation)
    turn = np.full(len(draws), mean)
    if sigma > 0:
        turns = mean + sigma * TURNS
        weight = np.tile(np.exp(-0.5 * TURNS**2), (len(draws), 1))  # [K, turns]
        if motion.cue != "trail":  # along a trail it may have come to any point of its path
            each = np.repeat(np.arange(len(draws)), len(turns))
            ways = _in_plane(mover.of(each), cameras.of(each), direction[each], np.tile(turns, len(draws)))
            rise = np.arcsin(np.clip(ways[:, 1], -1, 1)).reshape(weight.shape)
            usual = np.exp(-0.5 * ((rise - RISE) / RISE_SIGMA) ** 2)
            weight = (weight + UNUSUAL) * (usual + UNUSUAL)  # some are thrown far into the picture, or steeply
        aimed = np.ones(weight.shape)
        for other in others:
            away = other.centre - mover.centre
            bearing = np.arctan2(away[:, 2], np.sign(direction[:, 0]) * away[:, 0])
            aimed += AIMED * np.exp(-0.5 * ((turns - bearing[:, None]) / AIM_SIGMA) ** 2)
        weight = weight * aimed
        below = (np.cumsum(weight, axis=1) - weight / 2) / weight.sum(axis=1, keepdims=True)
        shares = quantiles(draws[:, COLUMN["depth"]])
        turn = np.array([np.interp(*each, turns) for each in zip(shares, below, strict=True)])
    return _in_plane(mover, cameras, direction, np.clip(turn, -1.5, 1.5))


def _in_plane(mover: LiftedBody, cameras: Cameras, direction: Floats, turn: Floats) -> Floats:
    """Unit vectors [K, 3], seen in directions [K, 2], in vertical planes turned from that of the image (radians)."""
    sense = np.where(direction[:, 0] < 0, -1.0, 1.0)
    level = np.stack([sense * np.cos(turn), np.zeros(len(turn)), np.sin(turn)], axis=1)
    up = np.tile(np.array([0.0, 1.0, 0.0]), (len(turn), 1))
    step = 1e-4 * mover.half_width[:, None]
    scale = (cameras.depth(mover.centre) / cameras.focal)[:, None]
    seen: list[Floats] = []  # image velocities [K, 2], to a common factor, of the mover going either way
    for way in (level, up):
        before, after = (cameras.project(mover.centre + side * step * way)[0] for side in (-1.0, 1.0))
        seen.append((after - before) / (2 * step) * scale)
    shares = np.linalg.solve(np.stack(seen, axis=2) + 1e-9 * np.eye(2), direction[:, :, None])[:, :, 0]
    way = shares[:, :1] * level + shares[:, 1:] * up
    return way / np.maximum(np.linalg.norm(way, axis=1), 1e-12)[:, None]
