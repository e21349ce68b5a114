"""The bodies of a clip: their masks, their sprites, and where each is at a frame: above what, and in front of what."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.media.masks import eroded, hull, resized_mask, turning, window_of
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.perception.classical.inpainting import push_pull
from cow_service.physics.camera import NEAREST, FloorCamera
from cow_service.physics.tracks import TOUCHING, is_in_front
from cow_service.records import FALLING_KINDS, BBox, Body, Path, Shape

EDGE_SIGMA = 0.5  # px: Gaussian that softens the sprite's edge; moving it blurs it further
MARGIN = 4  # px around the mask that the soft edge takes
SHADING_SIGMA = 0.1  # of a ball's width: coarser than this is its shading, finer is what is printed on it
PRINTED = 14.0  # grey levels, 80th percentile: from so much fine detail on, a ball is seen to turn
SMALLEST = 0.5  # scale under which a half-size copy of the sprite is drawn, so that it does not flicker
UNMOVED = 0.3  # px

Window = tuple[slice, slice]  # rows and columns of the clip's frames


@dataclass(frozen=True)
class Extent:
    """Where a body is at one frame."""

    bbox: BBox  # [x0, y0, x1, y1], px of the image
    airborne: bool  # the image does not say how far away it is
    depth: float | None = None  # m from the camera, along its axis; None if no camera is known
    bottom: float = 0.0  # m above the floor
    top: float = 0.0

    def is_in_front_of(self, other: Extent, eye: float) -> bool:
        """Whether it covers the other one in the image; `eye` is the camera's height above the floor (m).

        As `tracks.is_in_front` says; without a camera the one that stands lower in the image.
        """
        if self.depth is None or other.depth is None:
            return self.airborne or (not other.airborne and self.bbox[3] >= other.bbox[3])
        here, there = (self.depth, self.bottom, self.top), (other.depth, other.bottom, other.top)
        return bool(is_in_front(here, there, eye))


@dataclass(frozen=True)
class Surface:
    """What lies beneath a body."""

    height: float  # m above the floor
    body: int | None  # whose top it is, of `Trajectory.bodies`; None for the floor


@dataclass(frozen=True)
class Ground:
    """The floor and the still objects on it, seen by the camera; image points are px of the clip."""

    camera: FloorCamera
    factor: float  # clip px per image px
    bodies: tuple[Body, ...]
    still: tuple[int, ...]  # which of the bodies never move

    @staticmethod
    def of(given: GeneratorInput, factor: float) -> Ground | None:
        """None if the trajectory has no camera."""
        trajectory, scene = given.trajectory, given.scene
        if trajectory.camera is None or not trajectory.bodies:
            return None
        moving = {path.body for path in trajectory.paths}
        still = tuple(index for index in range(len(trajectory.bodies)) if index not in moving)
        return Ground(FloorCamera.of(trajectory.camera, scene.width, scene.height), factor, trajectory.bodies, still)

    def height(self, position: Floats) -> float:
        """Metres above the floor of a position [3]."""
        return float(self.camera.above_floor(position[None])[0])

    def foot(self, position: Floats, height: float) -> Floats:
        """The position [3] at a height above the floor (m), straight below or above another one."""
        return position + (height - self.height(position)) * self.camera.up

    def project(self, position: Floats) -> Floats:
        """The image point [2] of a position [3]."""
        return self.factor * self.camera.project(position[None])[0]

    def depth(self, position: Floats) -> float:
        """Metres along the camera's axis, for points that can be projected."""
        return max(float(position[2]), NEAREST * self.camera.height)

    def shape_on_floor(self, position: Floats) -> Floats:
        """Matrix [2, 2]: px right and down per metre right and ahead over the floor, at a position [3]."""
        x, y, z = position[0], position[1], self.depth(position)
        steps = np.stack([self.camera.right, self.camera.ahead], axis=1)
        slope = np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]])
        return self.factor * self.camera.focal * slope @ steps

    def surface_below(self, position: Floats, bottom: float, size: float) -> Surface:
        """The highest top of a still body, or else the floor, below a body of a size (m) with its lower end there."""
        best = Surface(0.0, None)
        over = self.camera.to_floor(position[None])[0]
        for index in self.still:
            it = self.bodies[index]
            below = self.camera.to_floor(np.array([it.position]))[0]
            top = float(below[1]) + it.size[1] / 2
            beside = float(np.hypot(over[0] - below[0], over[2] - below[2]))
            if beside < max(it.size[0], it.size[2]) / 2 and best.height < top <= bottom + TOUCHING * size:
                best = Surface(top, index)
        return best

    def extent(self, body: int, bbox: BBox, airborne: bool = False, position: Sequence[float] | None = None) -> Extent:
        """Of a body in a box, at a position [3], or else where it is at the first frame."""
        there = np.array(self.bodies[body].position if position is None else position)
        middle, half = self.height(there), self.bodies[body].size[1] / 2
        return Extent(bbox, airborne, float(there[2]), middle - half, middle + half)


@dataclass(frozen=True)
class Sprite:
    """A body as it is at the first frame: colours times alpha, then alpha 0..1.

    A ball's shading stays towards the light while what is printed on it turns: then both parts are there, and add up.
    """

    fixed: Floats32 | None  # [a, b, 4]: does not turn
    turning: Floats32 | None  # [a, b, 4]: turns about `start`
    origin: tuple[float, float]  # x, y of its top left corner at the first frame, px
    start: Floats  # [2] x, y of the body's centre at the first frame, px

    @staticmethod
    def of(image: Image, mask: Mask, hidden: Mask | None, start: Floats, shape: Shape | None) -> Sprite:
        """The body under a mask [h, w]; its part `hidden` behind others gets the colours next to it."""
        whole = mask if hidden is None else mask | hidden
        inside = window_of(whole, MARGIN) or (slice(0, 1), slice(0, 1))
        body, colours = whole[inside], image[inside].astype(np.float32)
        alpha = soft(body)
        known = mask[inside]
        core = eroded(known)
        if not core.any():
            core = known
        own = push_pull(colours, core) if core.any() else colours
        rim = 0.5 * colours + 0.5 * own
        blended = np.where(core[..., None], colours, np.where(known[..., None], rim, own))
        pixels = np.dstack([blended * alpha[..., None], alpha]).astype(np.float32)
        origin = float(inside[1].start), float(inside[0].start)
        if shape != "sphere":
            return Sprite(None, pixels, origin, start)
        # What is printed on a ball turns with it, without its shading.
        sigma = max(1.0, SHADING_SIGMA * float(np.sqrt(body.sum())))
        weight = body.astype(np.float32)
        shares = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)
        shading = cv2.GaussianBlur(blended * weight[..., None], (0, 0), sigma) / shares[..., None]
        detail = np.asarray((blended - shading) * weight[..., None], np.float32)
        core = eroded(body, 5)
        if not core.any() or float(np.percentile(np.abs(detail[core]).max(axis=1), 80)) <= PRINTED:
            return Sprite(pixels, None, origin, start)
        turns = np.dstack([detail * alpha[..., None], np.zeros_like(alpha)]).astype(np.float32)
        return Sprite(pixels - turns, turns, origin, start)

    def at(self, point: Floats, scale: float, rotation: float, size: tuple[int, int]) -> tuple[Window, Floats32] | None:
        """Its window and pixels [a, b, 4] with its centre at `point` (px); None outside a frame of `size`."""
        parts = [(part, turn) for part, turn in ((self.fixed, 0.0), (self.turning, rotation)) if part is not None]
        height, width = parts[0][0].shape[:2]
        offset = np.array(self.origin) - self.start
        around = offset + np.array([[0, 0], [width, 0], [0, height], [width, height]])
        corners = np.concatenate([point + around @ turning(scale, turn).T for _, turn in parts])
        window = clipped(corners.min(axis=0) - 1, corners.max(axis=0) + 1, size)
        if window is None:
            return None
        drawn: list[Floats32] = []
        for part, turn in parts:
            cells, step = part, 1.0
            while scale * step < SMALLEST and min(cells.shape[:2]) > 3:
                width, height = max(1, cells.shape[1] // 2), max(1, cells.shape[0] // 2)
                half = cv2.resize(cells[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
                cells, step = np.asarray(half, np.float32), 2 * step
            transform = warping(step, self.origin, turning(scale, turn), self.start, point, window)
            drawn.append(np.asarray(cv2.warpAffine(cells, *transform, flags=cv2.INTER_LINEAR), np.float32))
        return window, sum(drawn[1:], drawn[0])


def warping(
    step: float, origin: tuple[float, float], matrix: Floats, start: Floats, to: Floats, window: Window
) -> tuple[Floats, tuple[int, int]]:
    """For `cv2.warpAffine`, the transform [2, 3] and size of a window of what has gone from `start` `to` a place (px).

    It lies on cells of `step` px from `origin` on, and is turned and scaled by a matrix. Centres of cells are mapped.
    """
    rows, columns = window
    first = np.array(origin) + 0.5 * step - start
    shift = to + matrix @ first - 0.5 - np.array([columns.start, rows.start])
    return np.column_stack([matrix * step, shift]), (columns.stop - columns.start, rows.stop - rows.start)


def clipped(low: Floats, high: Floats, size: tuple[int, int]) -> Window | None:
    """The window between two corners x, y (px), inside a frame of a size (width, height); None if that is empty."""
    x0, y0 = (math.floor(min(max(float(v), 0.0), side)) for v, side in zip(low, size, strict=True))
    x1, y1 = (math.ceil(min(max(float(v), 0.0), side)) for v, side in zip(high, size, strict=True))
    return (slice(y0, y1), slice(x0, x1)) if x1 > x0 and y1 > y0 else None


def soft(mask: Mask) -> Floats32:
    """Alpha 0..1 of a mask: half at its outline."""
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), EDGE_SIGMA), np.float32)


@dataclass(frozen=True)
class StillBody:
    """Something that stays where it is, and hides what is farther away."""

    index: int  # of `Trajectory.bodies`
    mask: Mask  # [h, w]: what is seen of it
    extent: Extent
    whole: Mask | None = None  # [h, w]: what was said to be its silhouette, hidden parts included

    @cached_property
    def outline(self) -> Mask:
        """What it covers [h, w], whatever hides a part of it."""
        found = hull(self.mask)
        return found if self.whole is None else found | self.whole

    @cached_property
    def alpha(self) -> tuple[Window, Floats32]:
        """Window of the frame and alpha 0..1 in it."""
        window = window_of(self.mask, MARGIN) or (slice(0, 1), slice(0, 1))
        return window, soft(self.mask[window])


@dataclass(frozen=True)
class MovingBody:
    """Something that moves, with its path."""

    path: Path
    bbox: BBox  # px of the image, at the first frame
    start: Floats  # [2] px of the image: the point that `path.points` follows
    mask: Mask  # [h, w]
    airborne: bool
    ground: Ground | None
    support: int | None  # the still body that it stands on at the first frame, of `Trajectory.bodies`

    @property
    def disc(self) -> Mask:
        """Where a sphere is seen at the first frame [h, w], whatever hides it; nothing for other shapes."""
        disc = np.zeros(self.mask.shape, np.uint8)
        if self.ground is None or self.ground.bodies[self.path.body].shape != "sphere":
            return disc > 0
        first = np.array(self.path.states[0][:3])
        x, y = self.ground.project(first)
        per_metre = self.ground.factor * self.ground.camera.focal / self.ground.depth(first)
        radius = per_metre * self.ground.bodies[self.path.body].size[0] / 2
        # OpenCV's pixels are counted from their centres; 4 binary places.
        cv2.circle(disc, (round(16 * (x - 0.5)), round(16 * (y - 0.5))), round(16 * radius), 1, -1, shift=4)
        return disc > 0

    @property
    def stays(self) -> bool:
        """Whether it is where it was, to a pixel, all the time."""
        points = np.array(self.path.points)
        return bool(np.abs(points - points[0]).max() <= 1 and np.ptp(self.path.scale) <= 0.01)

    def is_unmoved(self, frame: int) -> bool:
        """Whether it is where and as it was at the first frame, to a fraction of a pixel."""
        (x, y), (x0, y0) = self.path.points[frame], self.start
        side = max(self.bbox[2] - self.bbox[0], self.bbox[3] - self.bbox[1])
        turned = math.radians(self.path.rotation[frame]) if self.path.rotation else 0.0
        return max(math.hypot(x - x0, y - y0), side * abs(self.path.scale[frame] - 1), side * abs(turned)) < UNMOVED

    def extent(self, frame: int) -> Extent:
        """At a frame of the clip."""
        point, scale = np.array(self.path.points[frame]), self.path.scale[frame]
        corners = point + (np.array(self.bbox).reshape(2, 2) - self.start) * scale
        x0, y0, x1, y1 = corners.ravel().tolist()
        bbox = (x0, y0, x1, y1)
        if self.ground is None:
            return Extent(bbox, self.airborne)
        return self.ground.extent(self.path.body, bbox, self.airborne, self.path.states[frame][:3])


def moving_bodies(given: GeneratorInput, size: tuple[int, int], ground: Ground | None) -> tuple[MovingBody, ...]:
    """The bodies that have paths, at a clip size (width, height)."""
    airborne = ground is None and given.motion.kind in FALLING_KINDS
    found: list[MovingBody] = []
    for path in given.trajectory.paths:
        if path.body == 0:
            bbox, mask = given.grounding.bbox, given.scene.mover.full()
        else:
            obstacle = given.obstacles[path.body - 1]
            bbox, mask = obstacle.bbox, obstacle.mask.full()
        # Without a camera, points follow the grounded point, wherever a given path begins.
        start = given.grounding.point if ground is None and path.body == 0 else path.points[0]
        on = None if ground is None else ground.bodies[path.body].support
        support = None if ground is None else next((i for i in ground.still if ground.bodies[i].object == on), None)
        found.append(MovingBody(path, bbox, np.array(start), resized_mask(mask, size), airborne, ground, support))
    return tuple(found)


def still_bodies(
    given: GeneratorInput, moving: Sequence[MovingBody], size: tuple[int, int], ground: Ground | None
) -> tuple[StillBody, ...]:
    """The obstacles that have no path."""
    taken, paths = np.logical_or.reduce([body.mask for body in moving]), {body.path.body for body in moving}
    found: list[StillBody] = []
    for index, obstacle in enumerate(given.obstacles, start=1):
        if index not in paths:
            extent = Extent(obstacle.bbox, False) if ground is None else ground.extent(index, obstacle.bbox)
            whole = obstacle.mask.at(size)
            found.append(StillBody(index, whole & ~taken, extent, whole))
    return tuple(found)
