"""The bodies of a scene as the compositor sees them: masks at the clip's size, and where each is at a frame."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.ground import Ground, Placed
from cow_service.generators.cutout.sprites import MARGIN, Window, soft
from cow_service.records import FALLING_KINDS, BBox, Path
from cow_service.vision.masks import Floats, Floats32, Mask, hull, resized_mask, window_of

UNMOVED = 0.3  # px


@dataclass(frozen=True)
class StillBody:
    """Something that stays where it is, and hides what is farther away."""

    index: int  # of `Trajectory.bodies`
    mask: Mask  # [h, w]: what is seen of it
    placed: Placed
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

    def is_unmoved(self, frame: int) -> bool:
        """Whether it is where and as it was at the first frame, to a fraction of a pixel."""
        (x, y), (x0, y0) = self.path.points[frame], self.start
        side = max(self.bbox[2] - self.bbox[0], self.bbox[3] - self.bbox[1])
        turned = math.radians(self.path.rotation[frame]) if self.path.rotation else 0.0
        return max(math.hypot(x - x0, y - y0), side * abs(self.path.scale[frame] - 1), side * abs(turned)) < UNMOVED

    def placed(self, frame: int) -> Placed:
        """At a frame of the clip."""
        point, scale = np.array(self.path.points[frame]), self.path.scale[frame]
        corners = point + (np.array(self.bbox).reshape(2, 2) - self.start) * scale
        x0, y0, x1, y1 = (float(v) for v in corners.ravel())
        bbox = (x0, y0, x1, y1)
        if self.ground is None:
            return Placed(bbox, self.airborne)
        there = np.array(self.path.states[frame][:3])
        middle, half = self.ground.height(there), self.ground.bodies[self.path.body].size[1] / 2
        return Placed(bbox, self.airborne, float(there[2]), middle - half, middle + half)


def moving_body(given: GeneratorInput, path: Path, size: tuple[int, int], ground: Ground | None) -> MovingBody:
    """The body of a path, at a clip size (width, height)."""
    airborne = ground is None and given.motion.kind in FALLING_KINDS
    if path.body == 0:
        bbox, mask = given.grounding.bbox, given.scene.silhouette(given.grounding.bbox)
    else:
        obstacle = given.obstacles[path.body - 1]
        bbox, mask = obstacle.bbox, obstacle.mask.full()
    # Without a camera, points follow the grounded point, wherever a given path begins.
    start = given.grounding.point if ground is None and path.body == 0 else path.points[0]
    support = None if ground is None else ground.support_of(path.body)
    return MovingBody(path, bbox, np.array(start), resized_mask(mask, size), airborne, ground, support)


def still_bodies(
    given: GeneratorInput, moving: tuple[MovingBody, ...], size: tuple[int, int], ground: Ground | None
) -> tuple[StillBody, ...]:
    """The obstacles that have no path."""
    taken = np.zeros(moving[0].mask.shape, bool)
    for body in moving:
        taken |= body.mask
    found: list[StillBody] = []
    for index, obstacle in enumerate(given.obstacles, start=1):
        if any(body.path.body == index for body in moving):
            continue
        placed = Placed(obstacle.bbox, airborne=False)
        if ground is not None:
            body = ground.bodies[index]
            middle = ground.height(np.array(body.position))
            half = body.size[1] / 2
            placed = Placed(obstacle.bbox, False, body.position[2], middle - half, middle + half)
        whole = obstacle.mask.at(size)
        found.append(StillBody(index, whole & ~taken, placed, whole))
    return tuple(found)
