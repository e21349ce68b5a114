"""How much of a body another hides in the image, per draw and frame: silhouettes moved and scaled as the world says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cow_service.physics.projection import SeenPaths
from cow_service.vision.masks import CroppedMask
from cow_service.vision.types import Floats, Mask

Indices = NDArray[np.int64]

SAMPLES = 96  # points of a silhouette that are looked up in the other
CHUNK = 2048  # draws and frames at a time, to bound the memory


@dataclass(frozen=True)
class Shares:
    """Shares [K, F] of another body that the subject covers, and of the subject that the other body covers."""

    covers: Floats
    covered: Floats


def shares(subject: CroppedMask, path: SeenPaths, other: CroppedMask, other_path: SeenPaths) -> Shares:
    """By the silhouettes of the image; what is nearer covers what is farther."""
    covers, covered = np.zeros(path.depth.shape), np.zeros(path.depth.shape)
    seen = ~path.passed & ~other_path.passed
    meet = _boxes_meet(subject, path, other, other_path) & seen
    nearer = path.depth < other_path.depth
    _fill(covers, meet & nearer, subject, path, other, other_path)
    _fill(covered, meet & ~nearer, other, other_path, subject, path)
    return Shares(covers, covered)


def _fill(
    found: Floats, where: Mask, front: CroppedMask, front_path: SeenPaths, back: CroppedMask, back_path: SeenPaths
) -> None:
    """Writes the share of the body at the back that the one in front covers, in some draws and frames [K, F]."""
    draws, frames = np.nonzero(where)
    if not len(draws):
        return
    points = _sample(back)
    for start in range(0, len(draws), CHUNK):
        k, f = draws[start : start + CHUNK], frames[start : start + CHUNK]
        there = _moved(points, back_path, k, f)
        found[k, f] = _inside(front, _moved_back(there, front_path, k, f))


def _moved(points: Floats, path: SeenPaths, k: Indices, f: Indices) -> Floats:
    """Points [S, 2] of the image, where a path has them [N, S, 2] in draws and frames [N]."""
    first, now, scale = path.seen[k], path.points[k, f], path.scale[k, f][:, None, None]
    return now[:, None] + (points[None] - first[:, None]) * scale


def _moved_back(points: Floats, path: SeenPaths, k: Indices, f: Indices) -> Floats:
    """Where points [N, S, 2] of draws and frames [N] were at the first frame."""
    first, now, scale = path.seen[k], path.points[k, f], path.scale[k, f][:, None, None]
    return first[:, None] + (points - now[:, None]) / scale


def _boxes_meet(subject: CroppedMask, path: SeenPaths, other: CroppedMask, other_path: SeenPaths) -> Mask:
    """[K, F]: the boxes of the moved silhouettes meet."""
    (low, high), (other_low, other_high) = _corners(subject, path), _corners(other, other_path)
    return np.all((low < other_high) & (high > other_low), axis=2)


def _corners(mask: CroppedMask, path: SeenPaths) -> tuple[Floats, Floats]:
    """Upper left and lower right corners [K, F, 2] of the box of a moved silhouette."""
    x0, y0, x1, y1 = mask.bbox
    low, high = (
        path.points + (np.array(corner) - path.seen[:, None]) * path.scale[..., None] for corner in ((x0, y0), (x1, y1))
    )
    return low, high


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
