"""From worlds that were run back to the image: points, apparent size, turns, and how far they spread."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.physics.world import Worlds
from cow_service.records import Path
from cow_service.vision.masks import CroppedMask, dilated, scaled_size
from cow_service.vision.types import Floats, Mask

UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # quaternion x, y, z, w
MOST_LEAN = np.radians(25)
PASSED = 0.08  # of its first depth: closer than this, a body has passed the camera


@dataclass(frozen=True)
class SeenPaths:
    """What one body does in the image, for draws [K] and recorded frames [F]."""

    points: Floats  # [K, F, 2] px
    depth: Floats  # [K, F] m
    scale: Floats  # [K, F]: apparent size, 1 as the image shows it
    passed: Mask  # [K, F]: it is at or behind the camera
    before: Floats | None = None  # [K, 2] px: where the image shows it, if it begins elsewhere

    @property
    def seen(self) -> Floats:
        """Points [K, 2] (px) at which the image shows it."""
        return self.points[:, 0] if self.before is None else self.before


def seen_paths(worlds: Worlds, body: int) -> SeenPaths:
    """A body's path in the image of every draw."""
    positions = np.stack([run.positions[body] for run in worlds.runs])
    points, depth = worlds.layout.cameras.project(positions)
    before, first = None, depth[:, :1]
    if worlds.seen is not None:
        shown = np.array([bodies[body].position for bodies in worlds.seen])
        before, first = worlds.layout.cameras.project(shown[:, None])
        before = before[:, 0]
    first = np.maximum(first, 1e-9)
    return SeenPaths(points, depth, first / np.maximum(depth, PASSED * first), depth <= PASSED * first, before)


def states(worlds: Worlds, body: int) -> Floats:
    """[F, 6] metres and m/s in the frame of the camera, of the first draw."""
    cameras, run = worlds.layout.cameras, worlds.runs[0]
    position = run.positions[body] - np.array([0.0, cameras.height[0], 0.0])
    return np.hstack([position @ cameras.axes[0], run.velocities[body] @ cameras.axes[0]])


def rotation(worlds: Worlds, body: int) -> Floats:
    """Degrees [F] that a body of the first draw has turned in the image, clockwise, since the first frame.

    A sphere turns by its spin about the line of sight. Of anything else the upright axis is followed: what turns about
    it looks the same.
    """
    run, cameras = worlds.runs[0], worlds.layout.cameras
    turns = run.turns[body]
    if worlds.shapes[0][body].shape == "sphere":
        sight = run.positions[body] - np.array([0.0, cameras.height[0], 0.0])
        sight = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-9)[:, None]
        # Right, up and ahead are a left-handed frame: there a positive turn about the line of sight is anticlockwise.
        before, after = turns[:-1], turns[1:]
        axis = before[:, 3:] * after[:, :3] - after[:, 3:] * before[:, :3] + np.cross(before[:, :3], after[:, :3])
        half = np.einsum("fi,fi->f", before, after)
        axis = axis * np.where(half < 0, -1.0, 1.0)[:, None]
        length = np.linalg.norm(axis, axis=1)
        steps = axis * (2 * np.arctan2(length, np.abs(half)) / np.maximum(length, 1e-12))[:, None]  # rotation vectors
        about = -np.einsum("fi,fi->f", steps, sight[1:])
        return np.concatenate([[0.0], np.degrees(np.cumsum(about))])
    return _leaned(worlds, run.positions[body], turns)


def rotation_where_put(worlds: Worlds, body: int) -> float:
    """Degrees, clockwise, that a body of the first draw is turned at its first frame against how the image shows it.

    A sphere looks the same wherever it is put.
    """
    if worlds.seen is None or worlds.shapes[0][body].shape == "sphere":
        return 0.0
    positions = np.array([worlds.seen[0][body].position, worlds.shapes[0][body].position])
    turn = worlds.shapes[0][body].turn
    return float(_leaned(worlds, positions, np.array([UPRIGHT, UPRIGHT if turn is None else turn]))[1])


def _leaned(worlds: Worlds, positions: Floats, turns: Floats) -> Floats:
    """Degrees [F], clockwise, that an upright axis has leaned since the first of positions [F, 3] and turns [F, 4]."""
    upright = np.tile(np.array([0.0, 1.0, 0.0]), (len(turns), 1))
    cameras, leans = worlds.layout.cameras, list[Floats]()
    step = 1e-3 * float(cameras.height[0])
    for axis in (turned(turns, upright[0]), upright):
        points, _ = cameras.repeated(1).project((positions + np.stack([axis, -axis]) * step)[None])
        way = points[0, 0] - points[0, 1]
        leans.append(np.unwrap(np.arctan2(way[:, 0], -way[:, 1])))
    leaning, plumb = leans
    angle = np.unwrap(leaning - plumb)
    # Verticals lean in the image as they come to its side; close to the camera they lean without bounds.
    return np.degrees(angle - angle[0] + np.clip(plumb - plumb[0], -MOST_LEAN, MOST_LEAN))


def turned(turns: Floats, vector: Floats) -> Floats:
    """A vector [3] turned by quaternions [F, 4]."""
    axis, w = turns[:, :3], turns[:, 3:]
    across = np.cross(axis, vector)
    return vector + 2 * (w * across + np.cross(axis, across))


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
    boxes: list[tuple[Floats, Floats]] = []  # upper left and lower right corners [K, F, 2]
    for mask, along in ((subject, path), (other, other_path)):
        x0, y0, x1, y1 = mask.bbox
        low, high = (
            along.points + (np.array(corner) - along.seen[:, None]) * along.scale[..., None]
            for corner in ((x0, y0), (x1, y1))
        )
        boxes.append((low, high))
    (low, high), (other_low, other_high) = boxes
    meet = np.all((low < other_high) & (high > other_low), axis=2) & ~path.passed & ~other_path.passed
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
    rows, columns = np.nonzero(back.patch) if back.area else (np.zeros(1, int), np.zeros(1, int))
    # Every n-th pixel of a raster lines up in columns; a golden-ratio sequence does not.
    order = np.argsort(np.modf(np.arange(len(rows)) * 0.6180339887498949)[0])[:SAMPLES]
    points = np.stack([columns[order] + back.columns.start + 0.5, rows[order] + back.rows.start + 0.5], axis=1)
    height, width = front.patch.shape
    for start in range(0, len(draws), CHUNK):
        k, f = draws[start : start + CHUNK], frames[start : start + CHUNK]

        def ends(path: SeenPaths, k: Indices = k, f: Indices = f) -> tuple[Floats, Floats, Floats]:
            return path.seen[k][:, None], path.points[k, f][:, None], path.scale[k, f][:, None, None]

        (first, now, scale), (front_first, front_now, front_scale) = ends(back_path), ends(front_path)
        there = now + (points[None] - first) * scale
        at = front_first + (there - front_now) / front_scale  # where the body in front has these points
        x = np.floor(at[..., 0]).astype(np.int64) - front.columns.start
        y = np.floor(at[..., 1]).astype(np.int64) - front.rows.start
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        covered = front.patch[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] & inside
        found[k, f] = covered.mean(axis=1)


WORKING_SIDE = 320  # px: paths are swept at this size


def swept(masks: Sequence[CroppedMask], starts: Sequence[Floats], paths: Sequence[Path]) -> Mask:
    """Mask [H, W] of every place that bodies cover on their paths: those of `masks`, first at `starts` [2] (px)."""
    height, width = masks[0].shape
    factor = min(1.0, WORKING_SIDE / max(height, width))
    size = scaled_size(width, height, factor)
    canvas = np.zeros((size[1], size[0]), np.uint8)
    for mask, start, path in zip(masks, starts, paths, strict=True):
        contours, _ = cv2.findContours(mask.patch.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        if not contours:
            continue
        outline = np.asarray(max(contours, key=len)[:, 0], np.float64) - start
        outline += np.array([mask.columns.start, mask.rows.start])
        for point, scale in zip(path.points, path.scale, strict=True):
            moved = (np.array(point) + scale * outline) * factor
            if np.all(np.abs(moved) < 4 * max(size)):
                cv2.fillPoly(canvas, [np.round(moved).astype(np.int32)], 1)
    return cv2.resize(canvas, (width, height), interpolation=cv2.INTER_NEAREST) > 0


ANCHORS = 8
TRACKS = 5
GRID = 14  # candidates along the longer side
CLEARANCE = 0.02  # of the shorter side, kept between an anchor and what may move


def spread_anchors(movable: Mask, count: int = ANCHORS) -> tuple[tuple[float, float], ...]:
    """At most `count` points (px), far from each other, off a mask [H, W] of everything that may move."""
    height, width = movable.shape
    side = 2 * max(2, int(CLEARANCE * min(height, width))) + 1
    blocked = dilated(movable, side)
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
