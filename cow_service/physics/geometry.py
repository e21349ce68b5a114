"""The floor, the camera above it and the bodies on it, as a depth map shows them.

Of a pixel, u and v are its place right of the image's middle and below it, in focal lengths: it shows what lies at
z (u, v, 1), where z is its depth. A plane N . p = 1 has the inverse depths N . (u, v, 1), so the floor is a straight
line fit. Lengths have the unit of the map; over the floor they are right, up and ahead, the camera above the origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import ArrayLike

from cow_service.media.masks import CroppedMask, eroded
from cow_service.media.types import Floats, Floats32, Mask
from cow_service.physics.bodies import SeenBody
from cow_service.physics.camera import HORIZON, CameraFit, axes_of
from cow_service.records import BBox, DepthEstimate, Shape


class FloorSearch(NamedTuple):
    """How the floor is found in a depth map."""

    samples: int = 6000  # pixels that the floor is sought in
    tries: int = 300  # planes through three of them
    level: float = math.radians(20)  # largest roll of the floor against the assumed vertical
    steepest: float = math.radians(79)  # pitches at which a floor is a floor
    flattest: float = math.radians(-10)
    least_tolerance: float = 0.01  # of the depth: how far a pixel of the floor may lie off its plane
    below: float = 3.0  # how much more a pixel that would lie under the floor counts than one on it
    least_floor: float = 0.1  # smallest share of floor among the pixels that show no body
    farthest: float = 8.0  # of the nearest depths: what lies beyond tells little of the floor that things stand on
    cells: tuple[int, int] = (3, 4)  # rows and columns: errors of a depth map are alike within such a part of the image
    sure: float = 0.003  # of the depth: no map is more exact


FLOOR = FloorSearch()


class BodyReading(NamedTuple):
    """How bodies are measured in a depth map."""

    least_seen: float = 0.3  # of a body's pixels: with fewer known depths it is not measured
    least_pixels: int = 24
    edge: int = 5  # px across: at outlines depths are those of neither side
    smoothed: float = 2.5  # px: standard deviation over which the depths of a body are averaged
    trim: float = 2.0  # percent of the points at either end that are left out
    from_above: float = 0.12  # sine of the angle at which a top is looked down on: then it shows how deep a body is
    touches: float = 0.05  # of the depth of a ball: so much nearer or farther than on the floor it may lie on it
    around: float = 0.3  # of a body's width and height: so far around its foot the floor is looked at
    alike: float = 0.3  # share of the depth error that remains if the error of the floor next to it is known
    grain: int = 6  # over such a part of the width of an image the errors of depth maps change altogether
    bent: float = 0.5  # of its width: with so much doubt of how deep a body is, the map does not tell
    on_top: float = 0.3  # of a body's height: largest distance of its lower end from the top of its support
    gap: float = 0.3  # of the longer side of a body: a gap in depth so wide lies between two things
    sparse: float = 0.02  # of a body's pixels: hardly more lie in such a gap
    least_part: float = 0.15  # of a body's pixels: fewer on one side of a gap are no thing
    at_foot: float = 0.15  # of the distance of a body's foot: so far from it may begin what stands there
    least_top: int = 4  # edges that outlines lose: a top that, half as deep as wide, fills more shows its depth
    raised: float = 0.2  # of the pixels of a thing are nearer than the floor behind it


BODY = BodyReading()


@dataclass(frozen=True)
class DepthMap:
    """How far from the camera, along its optical axis, what the pixels of an image show is."""

    depth: Floats | Floats32  # [H, W] in the unit of the map; nan where nothing is known
    scale: float | None  # metres per unit; None: relative depth
    deviation: float  # relative, one standard deviation
    focal: float | None  # px; None: it is not known
    source: Literal["request", "model"] = "request"

    def metres_per_pixel(self, bbox: BBox, focal: float) -> float | None:
        """At what is in the middle of a box (px), for a focal length (px); None if it is unknown."""
        x0, y0, x1, y1 = bbox
        across, down = (x1 - x0) / 4, (y1 - y0) / 4
        inner = self.depth[int(y0 + down) : math.ceil(y1 - down), int(x0 + across) : math.ceil(x1 - across)]
        if self.scale is None or not inner.size or np.isfinite(inner).mean() < BODY.least_seen:
            return None
        return float(np.nanmedian(inner)) * self.scale / focal

    def estimate(self, fit: CameraFit, measured: Measurement | None) -> DepthEstimate:
        """The record of it, with what was measured in it, if anything was."""
        mover = None if measured is None else measured.footprints[0]
        return DepthEstimate(
            source=self.source,
            scale=self.scale,
            focal=math.exp(fit.mean[1]) * self.depth.shape[1],
            valid=float(np.isfinite(self.depth).mean()),
            deviation=self.deviation,
            floor=None if measured is None else measured.floor.share,
            mover=0.0 if mover is None else mover.share,
        )


@dataclass(frozen=True)
class Floor:
    """The plane on which things stand."""

    pitch: float  # radians that the camera looks down on it
    roll: float  # radians
    height: float  # of the camera above it, in the unit of the map
    sigma: tuple[float, float, float]  # of pitch and roll, and of the logarithm of the height
    share: float  # of the pixels that show no body

    @property
    def axes(self) -> Floats:
        """Rows right, up and ahead over it [3, 3], in the frame of the camera."""
        return axes_of(np.array([self.pitch]), np.array([self.roll]))[0]

    def coordinates(self, positions: Floats) -> Floats:
        """Right, up and ahead [N, 3] of positions [N, 3] in the frame of the camera."""
        return positions @ self.axes.T + np.array([0.0, self.height, 0.0])

    def position(self, coordinates: tuple[float, float, float]) -> Floats:
        """Position [3] in the frame of the camera."""
        return (np.array(coordinates) - np.array([0.0, self.height, 0.0])) @ self.axes


@dataclass(frozen=True)
class Footprint:
    """Where a body is and how far it reaches, as its pixels show it."""

    shape: Shape
    centre: tuple[float, float, float]  # right, up and ahead
    half_width: float  # across the line of sight, about
    half_depth: float  # along it, as far as it is seen
    half_height: float
    yaw: float  # radians from right to ahead: of the side that is `half_width`
    bottom: float  # height of its lowest pixels above the floor
    depth_seen: bool  # its top shows how deep it is; else it may be deeper
    deviation: float  # of its depth, relative
    bend: float  # one standard deviation of how much deeper or less deep the errors of the map make it
    share: float  # of its pixels whose depth is known

    @property
    def top(self) -> float:
        """Height of its upper end above the floor."""
        return self.centre[1] + self.half_height

    @property
    def distance(self) -> float:
        """From the camera, over the floor."""
        return math.hypot(self.centre[0], self.centre[2])

    def is_over(self, other: Footprint) -> bool:
        """Whether its middle lies over another one."""
        away = np.array([self.centre[0] - other.centre[0], self.centre[2] - other.centre[2]])
        along = abs(float(away @ [math.cos(other.yaw), math.sin(other.yaw)]))
        across = abs(float(away @ [-math.sin(other.yaw), math.cos(other.yaw)]))
        return along < other.half_width and across < max(other.half_depth, other.half_width * (not other.depth_seen))


@dataclass(frozen=True)
class Measurement:
    """What a depth map says of a scene: the floor, its bodies, and what each of them stands on (None: the floor)."""

    floor: Floor
    footprints: tuple[Footprint | None, ...]
    supports: tuple[int | None, ...]
    deviation: float  # relative, of depths
    focal: float  # px
    scale: float | None  # metres per unit of the map; None: relative depth


def measure_scene(
    given: DepthMap, fit: CameraFit, bodies: Sequence[SeenBody], seen: Sequence[int | None], in_air: Sequence[bool]
) -> tuple[CameraFit, Measurement | None]:
    """The camera and the bodies by a depth map, where the camera is known as `fit` says; None if it has no floor.

    `seen` is what the bodies stand on as the picture alone shows it; `in_air` are those that stand nowhere.
    """
    focal = math.exp(fit.mean[1]) * given.depth.shape[1]
    floor = find_floor(given, focal, [body.mask for body in bodies], fit.roll)
    if floor is None:
        return (fit if fit.source == "request" else replace(fit, source="prior")), None
    footprints = measure(given, focal, floor, bodies, in_air)
    supports = tuple(_supports(bodies, footprints, seen, given.deviation))
    return camera_over(floor, fit), Measurement(floor, footprints, supports, given.deviation, focal, given.scale)


def _supports(
    bodies: Sequence[SeenBody], footprints: Sequence[Footprint | None], seen: Sequence[int | None], deviation: float
) -> list[int | None]:
    """What each body stands on: what is beneath its middle and ends where it begins; as seen, where that is unknown."""
    found = list(seen)
    for index, (body, own) in enumerate(zip(bodies, footprints, strict=True)):
        if own is None or body.prior.stands_on is not None:
            continue
        allowed = BODY.on_top * (own.top - own.bottom) + deviation / 2 * own.distance
        under = {
            other: abs(own.bottom - each.top)
            for other, each in enumerate(footprints)
            if each is not None and other != index and each.top < own.top and own.is_over(each)
        }
        on = min(under, key=lambda other: under[other], default=None)
        found[index] = on if on is not None and under[on] < min(allowed, abs(own.bottom)) else None
    return found


def rise_above(given: DepthMap, measured: Measurement, boxes: Sequence[BBox]) -> tuple[BBox, ...]:
    """Those of some boxes (px) in which something rises above the floor: what is flat is a mark or a shadow on it."""
    found: list[BBox] = []
    for box in boxes:
        x0, y0, x1, y1 = (int(edge) for edge in box)
        depth = given.depth[y0 : y1 + 1, x0 : x1 + 1]
        y, x = np.nonzero(np.isfinite(depth))
        rays = _rays(x + x0, y + y0, given.depth.shape[1], given.depth.shape[0], measured.focal)
        off = depth[y, x] * (rays @ -measured.floor.axes[1]) / measured.floor.height
        if not len(y) or np.percentile(off, 100 * BODY.raised) < 1 - FLOOR.least_tolerance - measured.deviation:
            found.append(box)
    return tuple(found)


def find_floor(given: DepthMap, focal: float, bodies: Sequence[CroppedMask], roll: float = 0.0) -> Floor | None:
    """The floor in a depth map of an image with that focal length (px), outside bodies; None if no floor is visible.

    It is the plane, level but for the pitch of the camera, on which most pixels lie and beneath which hardly any do.
    `roll` (radians) is that of the vertical that is assumed.
    """
    height, width = given.depth.shape
    covered = np.zeros((height, width), bool)
    for body in bodies:
        body.add_to(covered)
    free = np.flatnonzero(~covered & np.isfinite(given.depth))
    if len(free) < BODY.least_pixels:
        return None
    rng = np.random.default_rng(0)  # the same map must give the same floor
    chosen = np.stack(np.unravel_index(free[rng.integers(0, len(free), FLOOR.samples)], (height, width)), axis=1)
    depth = given.depth[tuple(chosen.T)].astype(np.float64)
    near = depth < FLOOR.farthest * np.percentile(depth, 5)
    chosen, depth = chosen[near], depth[near]
    rays = _rays(chosen[:, 1], chosen[:, 0], width, height, focal)
    rows = rays * depth[:, None]  # a plane N has rows @ N = 1
    tolerance = FLOOR.least_tolerance + given.deviation / 2
    threes = rows[rng.integers(0, len(rows), (FLOOR.tries, 3))]
    threes = threes[np.abs(np.linalg.det(threes)) > 1e-9 * np.median(depth) ** 3]
    planes = np.linalg.solve(threes, np.ones((len(threes), 3, 1)))[..., 0]
    planes = planes[[_is_level(plane, roll) for plane in planes]]
    if not len(planes):
        return None
    off = planes @ rows.T - 1  # how much farther than the plane a pixel is, of its depth
    score = (np.abs(off) < tolerance).sum(axis=1) - FLOOR.below * (off > 3 * tolerance).sum(axis=1)
    plane = planes[int(score.argmax())]
    for _ in range(6):
        off = rows @ plane - 1
        weight = np.clip(1 - (off / (3 * tolerance)) ** 2, 0, None)
        weighted = rows * weight[:, None]
        plane = np.linalg.lstsq(weighted.T @ rows, weighted.sum(axis=0), rcond=None)[0]
    off = rows @ plane - 1
    near = np.abs(off) < 2 * tolerance
    share = float(near.mean())
    if share < FLOOR.least_floor or not _is_level(plane, roll) or float(score.max()) <= 0:
        return None
    # Neighbouring pixels have the same error: this sums over parts of the image with one error each.
    used, places = rows[near], chosen[near] * np.array(FLOOR.cells) // np.array([height, width])
    inverse = np.linalg.inv(used.T @ used)
    parts = [used[(places == cell).all(axis=1)].sum(axis=0) for cell in np.unique(places, axis=0)]
    spread = max(FLOOR.sure, given.deviation, float(np.std(off[near])))
    root = np.stack(parts) @ inverse * spread
    pitch, found_roll, distance = _of_plane(plane)
    steps = np.stack([np.array(_of_plane(plane + each)) - [pitch, found_roll, distance] for each in root])
    sigma = np.sqrt((steps**2).sum(axis=0)) / np.array([1.0, 1.0, distance])
    return Floor(pitch, found_roll, distance, (float(sigma[0]), float(sigma[1]), float(sigma[2])), share)


def _rays(x: ArrayLike, y: ArrayLike, width: int, height: int, focal: float) -> Floats:
    """Rays [N, 3] of depth 1 through the middles of pixels in columns [N] and rows [N]."""
    across, down = np.asarray(x, np.float64) + 0.5, np.asarray(y, np.float64) + 0.5
    return np.stack([(across - width / 2) / focal, (down - height / 2) / focal, np.ones(len(across))], axis=1)


def _of_plane(plane: Floats) -> tuple[float, float, float]:
    """Pitch and roll (radians) of the camera over a plane [3], and its height."""
    length = float(np.linalg.norm(plane))
    down = plane / length
    return math.asin(float(np.clip(down[2], -1, 1))), math.atan2(float(down[0]), float(down[1])), 1 / length


def _is_level(plane: Floats, roll: float) -> bool:
    pitch, found, _ = _of_plane(plane)
    return FLOOR.flattest < pitch < FLOOR.steepest and abs(math.remainder(found - roll, math.tau)) < FLOOR.level


def camera_over(floor: Floor, fit: CameraFit) -> CameraFit:
    """The camera over a floor that was measured with the focal length of a fit: its doubt makes the pitch doubtful."""
    mean, covariance = fit.mean.copy(), np.diag(np.diag(fit.covariance))
    tilt = -math.sin(floor.pitch) * math.cos(floor.pitch)  # of the pitch, by the logarithm of the focal length
    mean[0] = floor.pitch
    covariance[0, 0] = floor.sigma[0] ** 2 + tilt**2 * covariance[1, 1] + 1e-12
    covariance[0, 1] = covariance[1, 0] = tilt * covariance[1, 1]
    return replace(fit, mean=mean, covariance=covariance, roll=floor.roll, roll_sigma=floor.sigma[1], source="depth")


def measure(
    given: DepthMap, focal: float, floor: Floor, bodies: Sequence[SeenBody], in_air: Sequence[bool]
) -> tuple[Footprint | None, ...]:
    """The footprints of bodies, some of them in the air; None for a body of unknown depth."""
    known, covered = np.isfinite(given.depth), np.zeros(given.depth.shape, bool)
    for body in bodies:
        body.mask.add_to(covered)
    filled = np.where(known, given.depth, np.float32(0)).astype(np.float32, copy=False)
    smooth = np.asarray(cv2.medianBlur(filled, BODY.edge), np.float32)
    known &= smooth > 0
    size, free, found = (known.shape[1], known.shape[0]), known & ~covered, list[Footprint | None]()
    for body, flies in zip(bodies, in_air, strict=True):
        off = None if flies else _floor_error(body, smooth, free, focal, floor, given.deviation)
        deviation = FLOOR.sure + (1.0 if off is None else BODY.alike) * given.deviation
        view = _View(body, flies, size, focal, floor, deviation, given.deviation)
        flat = _is_flat(view, smooth, known, off or 1.0)
        found.append(None if flat else _footprint(view, smooth, known, off or 1.0))
    return tuple(found)


def _floor_error(
    body: SeenBody, depth: Floats32, free: Mask, focal: float, floor: Floor, deviation: float
) -> float | None:
    """How far the depths [H, W] of the free pixels [H, W] around the foot of a body are off the floor, as a factor.

    Errors of a map are alike in neighbouring pixels: the body is off by the same. None if no floor is seen there.
    """
    (x0, y0, x1, y1), (height, width) = body.bbox, depth.shape
    across, down = BODY.around * (x1 - x0), BODY.around * (y1 - y0)
    rows = slice(max(0, int(y1 - down)), min(height, math.ceil(y1 + down)))
    columns = slice(max(0, int(x0 - across)), min(width, math.ceil(x1 + across)))
    y, x = np.nonzero(free[rows, columns])
    y, x = y + rows.start, x + columns.start
    lower = -floor.axes[1]  # the unit vector downwards
    off = depth[y, x] * (_rays(x, y, width, height, focal) @ lower) / floor.height
    on_floor = off[np.abs(off - 1) < 3 * (FLOOR.least_tolerance + deviation)]
    return float(np.median(on_floor)) if len(on_floor) >= max(BODY.least_pixels, 0.3 * len(off)) else None


@dataclass(frozen=True)
class _View:
    """One body as a depth map shows it."""

    body: SeenBody
    flies: bool
    size: tuple[int, int]  # px, of the image: width and height
    focal: float  # px
    floor: Floor
    deviation: float  # relative, of its depth, which may be known better than all of the map
    map_deviation: float


def _is_flat(view: _View, depth: Floats32, known: Mask, off: float) -> bool:
    """Whether the map shows floor where a body rises above it, or hangs over it: it is one of another scene.

    A body that is too low to be distinguished from the floor is not.
    """
    body, (width, height) = view.body, view.size
    (x0, y0, x1, y1), mask = body.bbox, body.mask
    middle = slice(int(y0 + (y1 - y0) / 4), math.ceil((y0 + y1) / 2))
    rows = slice(max(middle.start, mask.rows.start), min(middle.stop, mask.rows.stop))
    inside = mask.patch[rows.start - mask.rows.start : rows.stop - mask.rows.start] & known[rows, mask.columns]
    y, x = np.nonzero(inside)
    if len(y) < BODY.least_pixels:
        return False
    lower = -view.floor.axes[1]
    rays = _rays(x + mask.columns.start, y + rows.start, width, height, view.focal)
    sink = rays @ lower / view.floor.height  # of what lies on the floor, one over the depth
    ratio = depth[rows, mask.columns][inside] / off * sink
    foot = float(_rays([(x0 + x1 - 1) / 2], [y1 - 0.5], width, height, view.focal)[0] @ lower) / view.floor.height
    tolerance = FLOOR.least_tolerance + view.deviation
    # How much nearer than the floor behind it what stands upright at the foot of the body would be.
    rises = 1.0 if view.flies else 1 - float(np.median(sink)) / max(foot, 1e-9)
    return rises > 2 * tolerance and float(np.percentile(ratio, 100 * BODY.raised)) > 1 - min(tolerance, rises / 3)


def _footprint(view: _View, depth: Floats32, known: Mask, off: float) -> Footprint | None:
    """Of one body, by depths [H, W] that are too large by a factor, and where they are known [H, W]."""
    body, focal, floor, (width, height) = view.body, view.focal, view.floor, view.size
    mask = body.mask
    inner = eroded(np.pad(mask.patch, BODY.edge), BODY.edge)[BODY.edge : -BODY.edge, BODY.edge : -BODY.edge]
    inner = inner if np.count_nonzero(inner) >= BODY.least_pixels else mask.patch
    there = inner & known[mask.rows, mask.columns]
    share = np.count_nonzero(there) / max(1, np.count_nonzero(inner))
    if share < BODY.least_seen or np.count_nonzero(there) < BODY.least_pixels:
        return None
    y, x = np.nonzero(there)
    depth = depth[mask.rows, mask.columns] / np.float32(off)
    if body.shape != "sphere":
        rays = _rays(x + mask.columns.start, y + mask.rows.start, width, height, focal)
        spots = floor.coordinates(rays * depth[there][:, None])
        there[y, x] = _of_one_thing(view, spots)
        y, x = np.nonzero(there)
    # The noise of single pixels would make a body larger: what is seen of it is smoothed, without what is around.
    inverse = np.where(there, 1 / np.where(there, depth, 1.0), 0.0)
    z = blurred(there.astype(np.float64))[y, x] / blurred(inverse)[y, x]
    y, x = y + mask.rows.start, x + mask.columns.start
    if body.shape == "sphere":
        near = np.hypot(x + 0.5 - body.middle_point[0], y + 0.5 - body.middle_point[1]) < body.radius / 3
        front = float(np.median(z[near] if near.any() else z))
        return _ball(view, front, share)
    points = floor.coordinates(_rays(x, y, width, height, focal) * z[:, None])
    edge = BODY.edge / 2 * float(np.median(z)) / focal  # what the outline lost
    # The error of the map is another one at the other side of a body, the more the wider that is seen.
    bend = view.map_deviation * float(np.median(z)) * (body.bbox[2] - body.bbox[0]) / (width / BODY.grain)
    return _upright(view, points, edge, bend, share)


def _ball(view: _View, front: float, share: float) -> Footprint:
    """Of a ball whose nearest point has a depth."""
    floor, radius, (x, y) = view.floor, view.body.radius / view.focal, view.body.middle_point
    depth = front / max(1 - radius, 0.1)
    ray = _rays([x - 0.5], [y - 0.5], *view.size, view.focal)
    # Where it may as well touch the floor it does: then the floor tells its depth more exactly.
    sink = radius - float(ray[0] @ floor.axes[1])
    may_lie = not view.flies and sink > HORIZON
    if may_lie and abs(floor.height / sink / depth - 1) < BODY.touches + view.deviation:
        depth = floor.height / sink
    across, up, ahead = floor.coordinates(ray * depth)[0].tolist()
    half = radius * depth
    return Footprint("sphere", (across, up, ahead), half, half, half, 0.0, up - half, True, view.deviation, 0.0, share)


def _upright(view: _View, points: Floats, edge: float, bend: float, share: float) -> Footprint:
    """Of a body with points [N, 3] over the floor, whose outline lost an edge."""
    body, floor, deviation = view.body, view.floor, view.deviation
    is_round = body.is_form_known and body.shape in ("cylinder", "cone")
    right, ahead = (float(value) for value in np.median(points[:, [0, 2]], axis=0))
    bottom, top = (float(value) for value in np.percentile(points[:, 1], (BODY.trim, 100 - BODY.trim)))
    yaw = math.atan2(ahead, right) - math.pi / 2  # across the line of sight
    if not is_round:
        _, sides, degrees = cv2.minAreaRect(np.asarray(_core(points[:, [0, 2]]), np.float32))
        # Of its two sides the one that lies across the line of sight.
        turned = math.radians(degrees)
        yaw = turned + math.pi / 2 * round((yaw - turned) / (math.pi / 2)) if max(sides) > 0 else yaw
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    low, high = np.percentile(points[:, [0, 2]] @ turn.T, (BODY.trim, 100 - BODY.trim), axis=0)
    half_width, half_depth = ((high - low) / 2).tolist()
    half_width += edge
    is_cube = body.prior.equal_sided
    is_deep_as_wide = is_round or is_cube
    if is_deep_as_wide:
        half_depth, bend = half_width, 0.0
        high[1] = low[1] + 2 * half_width
    elif bend > BODY.bent * 2 * half_width:  # how deep it is cannot be distinguished from the error
        half_depth = 0.0
    x, z = ((low + high) / 2 @ turn).tolist()
    distance = math.hypot(right, ahead, floor.height)
    near = max(float(low[1]), edge)
    shown = (floor.height - top) * (distance / near - distance / (near + half_width))  # of a top half as deep as wide
    is_seen = (floor.height - top) / distance > BODY.from_above or shown > BODY.least_top * edge
    foot = bottom if view.flies else 0.0
    tall = half_width if is_cube else max((top + edge - foot) / 2, 1e-6)
    shape = body.shape if body.is_form_known else "box"
    is_seen = (is_seen or is_deep_as_wide) and half_depth > 0
    centre = x, foot + tall, z
    return Footprint(shape, centre, half_width, half_depth, tall, yaw, bottom, is_seen, deviation, bend, share)


def _of_one_thing(view: _View, points: Floats) -> Mask:
    """Which [N] of the points [N, 3] in the outline of a body are its own.

    An outline also holds what is seen through the gaps of a thing, and one that was cut by colour holds parts of what
    stands in front or behind. Gaps in depth divide these: the body is the part where its foot is, else the largest one.
    """
    floor, focal, deviation, steps = view.floor, view.focal, view.deviation, 4  # of a gap
    (x0, y0, x1, y1), away = view.body.bbox, np.hypot(points[:, 0], points[:, 2])
    middle = float(np.median(away))
    step = max(BODY.gap * max(x1 - x0, y1 - y0) * middle / focal, 3 * deviation * middle) / steps
    place = (np.clip(away - away.min(), 0, FLOOR.farthest * middle) / step).astype(int)
    shares = np.bincount(place, minlength=steps) / len(away)
    is_gap = np.convolve(np.convolve(shares, np.ones(steps), "valid") < BODY.sparse, np.ones(steps)) > 0.5
    part = np.where(is_gap, 0, np.cumsum(np.diff(np.where(is_gap, 0, 1), prepend=0) > 0))[place]  # 0: in a gap
    parts = [part == number for number in range(1, int(part.max(initial=0)) + 1)]
    parts = [each for each in parts if each.mean() > BODY.least_part]
    down = -_rays([(x0 + x1 - 1) / 2], [y1 - 0.5], *view.size, focal)[0] @ floor.axes.T
    foot = floor.height * math.hypot(down[0], down[2]) / max(down[1], HORIZON)

    begins = [float(np.percentile(away[each], BODY.trim)) for each in parts]
    near = [abs(start / foot - 1) < BODY.at_foot + deviation for start in begins]
    fits = [(is_near, each.sum()) for is_near, each in zip(near, parts, strict=True)]
    return parts[fits.index(max(fits))] if parts else np.ones(len(away), bool)


def blurred(values: Floats) -> Floats:
    """Values [h, w] smoothed over a few pixels."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), BODY.smoothed), np.float64)


def _core(spots: Floats) -> Floats:
    """Points [N, 2] without the few that lie far out."""
    low, high = np.percentile(spots, (BODY.trim, 100 - BODY.trim), axis=0)
    kept = spots[((spots >= low) & (spots <= high)).all(axis=1)]
    return kept if len(kept) >= BODY.least_pixels // 2 else spots
