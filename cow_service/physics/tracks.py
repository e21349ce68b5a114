"""Tracks: points on the surfaces of bodies, where each is in every frame of a clip, and whether it is seen there.

Points are chosen inside a body's mask at the first frame, lifted onto its shape, and carried along with its pose. A
point is hidden where it faces away from the camera, and where another body lies in front of it, by the same order in
which the compositor draws, but for what is put into a container, of which that alone shows the front before its
contents. Points of a sphere do not roll with it: a plain ball looks the same however it has rolled.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media.masks import CroppedMask, dilated, hull, scaled_size
from cow_service.media.types import Floats, Mask
from cow_service.physics.camera import FloorCamera
from cow_service.physics.events import turned
from cow_service.records import Body, Path, Point, Shape, StillTracks, Trajectory

POINT_DECIMALS = 3  # px
SAMPLES = 96  # along a line of sight through a body
FACING = 0.1  # cosine between a surface and the line of sight, below which what is there is seen badly
SAFE = 2  # px: what lies so close to a body in front counts as hidden by it
DEEP = 0.25  # of the deepest point of a mask: so far from its rim points are chosen
STILL_POINTS = 3  # on a body that stays where it is
TOUCHING = 0.25  # of the smaller height: how deep one body may seem to stand in the one beneath it
WORKING_SIDE = 320  # px: paths are swept at this size
MOST_CANDIDATES = 4_000  # among which points are chosen: more take seconds, and are no farther apart
ANCHORS = 8
GRID = 14  # candidates along the longer side
CLEARANCE = 0.02  # of the shorter side, kept between an anchor and what may move

Bools = NDArray[np.bool_]
Extent: TypeAlias = tuple[Any, Any, Any]  # numbers, or arrays [F]


@dataclass(frozen=True)
class Density:
    """How many points a body gets: one for each square of `spacing` (px), within limits."""

    spacing: float
    least: int
    most: int

    def count(self, mask: CroppedMask) -> int:
        """For a mask."""
        return int(np.clip(mask.area / self.spacing**2, self.least, self.most))


RECORDED = Density(1.0, 5, 5)  # what a result tells: the first points of any other density


def with_tracks(
    trajectory: Trajectory, masks: Sequence[CroppedMask], start: Point, density: Density = RECORDED
) -> Trajectory:
    """The trajectory with tracks of every body: of those that move, and of those that stay.

    `masks` are those of `Trajectory.bodies` at the first frame, `start` (px) is where the image shows the mover.
    """
    height, width = masks[0].shape
    assert trajectory.camera is not None  # every world has one
    scene = _Silhouettes(trajectory, masks, start, FloorCamera.of(trajectory.camera, width, height))
    paths = [
        path.model_copy(update=scene.fields(path.body, scene.carried(path, density.count(masks[path.body]))))
        for path in trajectory.paths
    ]
    moving = {path.body for path in paths}
    still: list[StillTracks] = []
    for body in sorted(set(range(len(trajectory.bodies))) - moving):
        x0, y0, x1, y1 = trajectory.bodies[body].bbox
        chosen = np.array(points_inside(masks[body], ((x0 + x1) / 2, (y0 + y1) / 2), STILL_POINTS))
        stays = np.broadcast_to(chosen, (trajectory.num_frames, *chosen.shape))
        seen = scene.fields(body, (stays, np.ones(stays.shape[:2], bool)))["tracks_visible"]
        still.append(StillTracks(body=body, points=pairs(chosen.round(POINT_DECIMALS)), visible=seen))
    return trajectory.model_copy(update={"paths": tuple(paths), "still_tracks": tuple(still)})


def is_in_front(one: Extent, other: Extent, eye: float) -> Any:
    """Whether one thing covers another one in the image, each given by its (depth, bottom, top), m.

    What is wholly above another's top is in front where the camera, at the height `eye`, looks down on that top. Else
    the nearer one is.
    """
    (depth, bottom, top), (other_depth, other_bottom, other_top) = one, other
    slack = TOUCHING * np.minimum(top - bottom, other_top - other_bottom)
    above = (bottom >= other_top - slack) & (eye > other_top)
    below = (other_bottom >= top - slack) & (eye > top)
    return above | (np.logical_not(below) & (depth <= other_depth))


class _Silhouettes:
    """Where all bodies are in each frame, as the compositor shows them."""

    def __init__(self, trajectory: Trajectory, masks: Sequence[CroppedMask], start: Point, camera: FloorCamera) -> None:
        self._camera, self._frames, self._poses = camera, trajectory.num_frames, trajectory.law == "contact"
        self.bodies, self._masks, self._start = trajectory.bodies, masks, start
        self._paths = {path.body: path for path in trajectory.paths}
        self._put = {each.body for each in trajectory.placed}
        places = [self._place(index) for index in range(len(self.bodies))]
        self._positions = places
        halves = [body.size[1] / 2 for body in self.bodies]
        middles = [camera.above_floor(place) for place in places]
        self._extents = [
            (place[:, 2], middle - half, middle + half)
            for place, middle, half in zip(places, middles, halves, strict=True)
        ]
        self._grown: dict[int, _Grown] = {}

    def _place(self, body: int) -> Floats:
        """Its centre [F, 3] in the frame of the camera."""
        path = self._paths.get(body)
        if path is None:
            return np.broadcast_to(np.array(self.bodies[body].position), (self._frames, 3))
        return np.array(path.states)[:, :3]

    def carried(self, path: Path, count: int) -> tuple[Floats, Bools]:
        """So many points of a body that moves, [F, N, 2] px, and whether each faces the camera [F, N]."""
        start = path.points[0] if self._poses else self._start
        chosen = np.array(points_inside(self._masks[path.body], start, count))
        points, scale = np.array(path.points), np.array(path.scale)
        # A path without a world around it, and a ball: as large as it appears.
        if not self._poses or self.bodies[path.body].shape == "sphere":
            moved = points[:, None] + scale[:, None, None] * (chosen - np.array(start))
            return moved, np.ones(moved.shape[:2], bool)
        body, places = self.bodies[path.body], self._camera.to_floor(self._positions[path.body])
        # What is drawn begins where the image shows it, a little off the centre of the body.
        shift = points - self._camera.project(self._positions[path.body])
        offsets, normals = lifted(self._camera, body, places[0], chosen - shift[0])
        turns = np.array(path.turns) if path.turns else np.tile((0.0, 0.0, 0.0, 1.0), (len(points), 1))
        offsets, normals = (np.stack([turned(turns, each) for each in some], axis=1) for some in (offsets, normals))
        at = places[:, None] + offsets
        seen = self._camera.project(self._camera.from_floor(at.reshape(-1, 3))).reshape(*at.shape[:2], 2)
        sight = np.array([0.0, self._camera.height, 0.0]) - at
        cosine = np.einsum("fni,fni->fn", sight, normals) / np.maximum(np.linalg.norm(sight, axis=2), 1e-9)
        return seen + shift[:, None], (cosine >= FACING) | ~normals.any(axis=2)

    def fields(self, body: int, carried: tuple[Floats, Bools]) -> dict[str, Any]:
        """Fields of a path: points of a body, and where they are seen; None if nothing ever hides one."""
        # What is no simple shape, such as a bottle's neck, may be carried beside where it is drawn.
        points, seen = carried[0], carried[1] & self._covered(body, carried[0])
        # What stays where the image shows it is chosen where it is seen: only what moves can come before it.
        for other in range(len(self.bodies)) if body in self._paths or body in self._put else self._paths:
            if other == body:
                continue
            front = is_in_front(self._extents[other], self._extents[body], self._camera.height)
            if front.any():
                seen = seen & ~(front[:, None] & self._covered(other, points))
        tracks = points.round(POINT_DECIMALS).transpose(1, 0, 2) + 0.0
        hidden = None if seen.all() else tuple(tuple(each) for each in seen.T.tolist())
        return {"tracks": tuple(pairs(track) for track in tracks), "tracks_visible": hidden}

    def _covered(self, body: int, points: Floats) -> Bools:
        """Whether points [F, N, 2] lie in a body's silhouette, or right next to it."""
        path, back = self._paths.get(body), points
        if path is not None:
            start = np.array(path.points[0] if self._poses or body else self._start)
            angle = np.radians(path.rotation or np.zeros(self._frames))[:, None]
            x, y = np.moveaxis(points - np.array(path.points)[:, None], 2, 0)
            turned_back = np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x], 2)
            back = start + turned_back / np.maximum(np.array(path.scale), 1e-6)[:, None, None]
        if body not in self._grown:
            self._grown[body] = _Grown(self._masks[body])
        return self._grown[body].contains(back)


class _Grown:
    """The hull of a mask and a margin, as visible outlines have gaps, for example on a shaded side."""

    def __init__(self, mask: CroppedMask) -> None:
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * SAFE + 1,) * 2)
        grown = cv2.dilate(np.pad(hull(mask.patch).astype(np.uint8), SAFE), kernel)
        self._patch: Bools = np.array(grown, bool)
        self._corner = np.array([mask.columns.start - SAFE, mask.rows.start - SAFE])

    def contains(self, points: Floats) -> Bools:
        """Whether points [..., 2] (px) lie in it."""
        rows, columns = self._patch.shape
        inside = np.clip(np.floor(points) - self._corner, -1, [columns, rows]).astype(int)
        x, y = inside[..., 0], inside[..., 1]
        there = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
        return there & self._patch[np.where(there, y, 0), np.where(there, x, 0)]


def lifted(camera: FloorCamera, body: Body, centre: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Where the lines of sight through points [N, 2] (px) meet a body, from its centre, and its normals there.

    [N, 3] each, right, up and ahead over the floor (m); `centre` [3] likewise. What misses the body's shape lies as far
    away as its centre, and has no normal.
    """
    half = np.array(body.size) / 2
    yaw = 0.0 if body.footprint is None else np.radians(body.footprint.yaw)
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    eye, rays = np.array([0.0, camera.height, 0.0]), camera.rays(points) @ camera.axes.T
    depth = float(camera.from_floor(centre[None])[0, 2])
    reach = float(np.linalg.norm(half))
    depths = np.linspace(max(depth - reach, 0.0), depth + reach, SAMPLES)
    along = eye - centre + rays[:, None] * depths[:, None]  # [N, SAMPLES, 3]
    level = _level(body.shape, along @ turn.T, half)
    inside: Bools = np.asarray(level <= 1)
    first = np.maximum(inside.argmax(axis=1), 1)
    rows = np.arange(len(points))
    before, after = level[rows, first - 1], level[rows, first]
    share = np.clip((before - 1) / np.where(before > after, before - after, 1.0), 0, 1)
    hits: Bools = np.asarray(np.any(inside, axis=1))
    found = depths[first - 1] + share * (depths[1] - depths[0])
    offsets = eye - centre + rays * np.where(hits, found, depth)[:, None]
    local, step = offsets @ turn.T, 1e-3 * reach
    slope = np.stack([_level(body.shape, local + step * axis, half) for axis in np.eye(3)], axis=1)
    normals = (slope - _level(body.shape, local, half)[:, None]) @ turn
    lengths = np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return offsets, np.where(hits[:, None], normals / lengths, 0.0)


def _level(shape: Shape, places: Floats, half: Floats) -> Floats:
    """1 on the surface of a shape with half sizes `half`, less inside, at places [..., 3] in its own frame."""
    x, y, z = np.moveaxis(places / np.maximum(half, 1e-9), -1, 0)
    match shape:
        case "sphere":
            return np.sqrt(x * x + y * y + z * z)
        case "box":
            return np.maximum(np.maximum(abs(x), abs(y)), abs(z))
        case "cylinder":
            return np.maximum(np.hypot(x, z), abs(y))
        case "cone":
            return np.maximum(2 * np.hypot(x, z) + y, -y)


def at_rate(trajectory: Trajectory, fps: float, num_frames: int, lead: int = 0) -> Trajectory:
    """The trajectory at another frame rate, for a generator: linear between frames, at rest after the last.

    What is true at the frames before and after a time is true at that time. `lead` frames before the motion begins
    stay as they are, and are not counted. Encounters and the ensemble's paths, which count frames, are left out.
    """
    last = trajectory.num_frames - 1
    if fps == trajectory.fps and num_frames + lead == last + 1:
        return trajectory
    times = np.minimum(lead + np.arange(num_frames) * trajectory.fps / fps, last)
    times = np.concatenate([np.arange(lead), times])
    before = np.floor(times + 1e-9).astype(int)
    after, share = np.minimum(np.ceil(times - 1e-9).astype(int), last), times - before

    def between(values: Sequence[Any]) -> Any:
        known = np.array(values, np.float64)
        part = share.reshape(-1, *[1] * (known.ndim - 1))
        return known[before] * (1 - part) + known[after] * part if len(known) else known

    def rows(values: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(map(tuple, between(values).tolist()))

    def poses(turns: Sequence[Any]) -> tuple[Any, ...]:
        known = np.array(turns).reshape(-1, 4)  # a quaternion and its negative are the same turn: the nearer is taken
        flips = np.cumprod(np.where((known[1:] * known[:-1]).sum(axis=1) < 0, -1.0, 1.0))
        found = np.array(between((known * np.concatenate([[1.0], flips])[: len(known), None]).tolist())).reshape(-1, 4)
        return tuple(map(tuple, (found / np.linalg.norm(found, axis=-1, keepdims=True)).tolist()))

    def both(flags: Sequence[bool]) -> tuple[bool, ...]:
        return tuple((np.array(flags)[before] & np.array(flags)[after]).tolist())

    paths = [
        path.model_copy(
            update={
                "states": rows(path.states),
                "points": rows(path.points),
                "turns": poses(path.turns),
                "visible": both(path.visible),
                "scale": tuple(between(path.scale).tolist()),
                "rotation": tuple(between(path.rotation).tolist()),
                "band": (),
                "futures": (),
                "tracks": tuple(map(rows, path.tracks)),
                "tracks_visible": None if path.tracks_visible is None else tuple(map(both, path.tracks_visible)),
            }
        )
        for path in trajectory.paths
    ]
    still = [
        each if each.visible is None else each.model_copy(update={"visible": tuple(map(both, each.visible))})
        for each in trajectory.still_tracks
    ]
    update = {"fps": fps, "paths": tuple(paths), "still_tracks": tuple(still), "encounters": ()}
    return trajectory.model_copy(update=update)


def pairs(points: Floats) -> tuple[Point, ...]:
    """Rows [F, 2] as tuples."""
    return tuple((x, y) for x, y in points.tolist())


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


def points_inside(mask: CroppedMask, centre: tuple[float, float], count: int) -> tuple[tuple[float, float], ...]:
    """The centre and points inside a mask away from its rim (px), spread out; at least one point."""
    if not mask.area:
        return (centre,)
    deep = cv2.distanceTransform(np.pad(mask.patch, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    rows, columns = np.nonzero(deep >= DEEP * deep.max())
    candidates = np.stack([columns + mask.columns.start + 0.5, rows + mask.rows.start + 0.5], axis=1)
    candidates = candidates[:: len(candidates) // MOST_CANDIDATES + 1]
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
