"""Track points: static anchors that hold the camera still, and points of the object that move with it."""

from __future__ import annotations

import cv2
import numpy as np

from cow_service.vision.masks import CroppedMask
from cow_service.vision.types import Floats, Mask

ANCHORS = 8
TRACKS = 5
GRID = 14  # candidates along the longer side
CLEARANCE = 0.02  # of the shorter side, kept between an anchor and what may move


def spread_anchors(movable: Mask, count: int = ANCHORS) -> tuple[tuple[float, float], ...]:
    """At most `count` points (px), far from each other, off a mask [H, W] of everything that may move."""
    height, width = movable.shape
    side = 2 * max(2, int(CLEARANCE * min(height, width))) + 1
    blocked = cv2.dilate(movable.astype(np.uint8), np.ones((side, side), np.uint8))
    step = max(height, width) / GRID
    xs = np.arange(step / 2, width, step)
    ys = np.arange(step / 2, height, step)
    grid = np.array([(x, y) for y in ys for x in xs if not blocked[int(y), int(x)]]).reshape(-1, 2)
    chosen = _farthest(grid, np.array([0.0, 0.0]), count)
    return tuple((float(x), float(y)) for x, y in chosen)


def points_inside(
    mask: CroppedMask, centre: tuple[float, float], count: int = TRACKS
) -> tuple[tuple[float, float], ...]:
    """The centre and points inside a mask away from its rim (px), spread out; at least one point."""
    if not mask.area:
        return (centre,)
    deep = cv2.distanceTransform(np.pad(mask.patch, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    rows, columns = np.nonzero(deep >= 0.35 * deep.max())
    candidates = np.stack([columns + mask.columns.start + 0.5, rows + mask.rows.start + 0.5], axis=1)
    start = candidates[int(np.linalg.norm(candidates - np.array(centre), axis=1).argmin())]
    return tuple((float(x), float(y)) for x, y in [start, *_farthest(candidates, start, count - 1)])


def _farthest(candidates: Floats, start: Floats, count: int) -> list[Floats]:
    """Up to `count` candidates [N, 2], each as far as can be from `start` and from those before it."""
    chosen: list[Floats] = []
    if not len(candidates):
        return chosen
    gap = np.linalg.norm(candidates - start, axis=1)
    for _ in range(count):
        best = int(gap.argmax())
        if gap[best] < 1.0:
            break
        chosen.append(candidates[best])
        gap = np.minimum(gap, np.linalg.norm(candidates - candidates[best], axis=1))
    return chosen
