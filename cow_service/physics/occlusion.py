"""How much of a body another hides in the image, per draw and frame: silhouettes moved and scaled as the world says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cow_service.physics.projection import SeenPaths
from cow_service.vision.masks import CroppedMask
from cow_service.vision.types import Floats, Mask

SAMPLES = 96  # points of a silhouette that are looked up in the other
CHUNK = 2048  # draws and frames at a time, to bound the memory


@dataclass(frozen=True)
class Shares:
    """Shares [K, F] of a still body that the mover covers, and of the mover that the still body covers."""

    covers: Floats
    covered: Floats


def shares(mover: CroppedMask, path: SeenPaths, other: CroppedMask, other_depth: Floats) -> Shares:
    """By the silhouettes of the first frame. `other_depth` [K] m: what is nearer covers what is farther."""
    covers, covered = np.zeros(path.depth.shape), np.zeros(path.depth.shape)
    draws, frames = np.nonzero(_boxes_meet(mover, path, other) & ~path.passed)
    of_other, of_mover = _sample(other), _sample(mover)
    for start in range(0, len(draws), CHUNK):
        k, f = draws[start : start + CHUNK], frames[start : start + CHUNK]
        first, now, scale = path.points[k, 0], path.points[k, f], path.scale[k, f][:, None, None]
        nearer = path.depth[k, f] < other_depth[k]
        looked = first[:, None] + (of_other[None] - now[:, None]) / scale
        covers[k, f] = np.where(nearer, _inside(mover, looked), 0.0)
        moved = now[:, None] + (of_mover[None] - first[:, None]) * scale
        covered[k, f] = np.where(nearer, 0.0, _inside(other, moved))
    return Shares(covers, covered)


def _boxes_meet(mover: CroppedMask, path: SeenPaths, other: CroppedMask) -> Mask:
    """[K, F]: the box of the moved silhouette meets that of the other."""
    corners = np.array(mover.bbox).reshape(2, 2)
    low, high = (
        path.points + (corner - path.points[:, :1]) * path.scale[..., None] for corner in (corners[0], corners[1])
    )
    x0, y0, x1, y1 = other.bbox
    return (low[..., 0] < x1) & (low[..., 1] < y1) & (high[..., 0] > x0) & (high[..., 1] > y0)


def _sample(mask: CroppedMask) -> Floats:
    """Points [S, 2] (px) spread evenly over a mask."""
    rows, columns = np.nonzero(mask.patch)
    if not len(rows):
        return np.array([[mask.columns.start + 0.5, mask.rows.start + 0.5]])
    # Every n-th pixel of a raster lines up in columns; a golden-ratio sequence does not.
    order = np.argsort(np.modf(np.arange(len(rows)) * 0.6180339887498949)[0])[:SAMPLES]
    return np.stack([columns[order] + mask.columns.start + 0.5, rows[order] + mask.rows.start + 0.5], axis=1)


def _inside(mask: CroppedMask, points: Floats) -> Floats:
    """Share [N] of points [N, S, 2] (px) that lie in a mask."""
    height, width = mask.patch.shape
    x = np.floor(points[..., 0]).astype(np.int64) - mask.columns.start
    y = np.floor(points[..., 1]).astype(np.int64) - mask.rows.start
    seen = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    found = mask.patch[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] & seen
    return np.asarray(found.mean(axis=1), np.float64)
