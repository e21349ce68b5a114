"""The pinhole camera that turns pixels into metres and back, with stated defaults where the image shows nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cow_service.media.types import Floats
from cow_service.physics.bodies import SeenBody, Shadow, no_edges
from cow_service.physics.vanishing import Segments, Views
from cow_service.records import BBox, CameraEstimate, CameraSource, Estimate, Shape, Vector
from cow_service.requests import CameraRequest

FREE_PITCH = math.radians(30)  # how far the camera looks down on a floor, for motion towards or away from it


def depth_motion(sense: float) -> tuple[tuple[float, float], float]:
    """Image direction and `Motion.depth` of what moves on the floor straight away (+1) or towards (-1) the camera."""
    return (0.0, -1.0 if sense > 0 else 1.0), math.copysign(math.cos(FREE_PITCH), sense)


def way_to(goal: BBox, mover: BBox, is_on_floor: bool) -> tuple[float, float]:
    """From the mover to a thing in the image: from foot to foot on the floor, else between the middles."""
    (x0, y0, x1, y1), (left, top, right, bottom) = goal, mover
    across = (x0 + x1 - left - right) / 2
    if is_on_floor and (across, y1) != (0.0, bottom):
        return across, y1 - bottom
    return across, (y0 + y1 - top - bottom) / 2


NEAREST = 1e-3  # of the camera's height: depths below it project as if they were there
HORIZON = 0.02  # sine of the angle below the horizon from which a ray meets the floor at a sane distance


@dataclass(frozen=True)
class FloorCamera:
    """Focal length (px), pitch and roll (radians), height above the floor (m) and the image's size (px)."""

    width: int
    height_px: int
    focal: float
    pitch: float  # positive: it looks down
    roll: float  # positive: the vertical leans to the left in the image
    height: float

    @staticmethod
    def of(estimate: CameraEstimate, width: int, height_px: int) -> FloorCamera:
        """The camera of a record, for an image of a size in px."""
        pitch, roll = math.radians(estimate.pitch), math.radians(estimate.roll)
        return FloorCamera(width, height_px, estimate.focal, pitch, roll, estimate.height)

    @cached_property
    def axes(self) -> Floats:
        """Rows: right, up and ahead over the floor [3, 3], unit vectors in the frame of the camera."""
        return axes_of(np.array([self.pitch]), np.array([self.roll]))[0]

    @property
    def right(self) -> Floats:
        """Unit vector [3] over the floor."""
        return self.axes[0]

    @property
    def up(self) -> Floats:
        """Unit vector [3]."""
        return self.axes[1]

    @property
    def ahead(self) -> Floats:
        """Unit vector [3] over the floor, away from the camera."""
        return self.axes[2]

    def rays(self, points: Floats) -> Floats:
        """Rays [N, 3] of depth 1 through image points [N, 2] (px)."""
        across = (points - np.array([self.width / 2, self.height_px / 2])) / self.focal
        return np.column_stack([across, np.ones(len(points))])

    def project(self, positions: Floats) -> Floats:
        """Image points [N, 2] (px) of positions [N, 3] (m)."""
        z = np.maximum(positions[:, 2:], NEAREST * self.height)
        return positions[:, :2] * self.focal / z + np.array([self.width / 2, self.height_px / 2])

    def above_floor(self, positions: Floats) -> Floats:
        """Heights [N] (m) of positions [N, 3]."""
        return positions @ self.up + self.height

    def floor_points(self, points: Floats) -> Floats:
        """Positions [N, 3] (m) on the floor under image points [N, 2] (px); nan at and above the horizon."""
        rays = self.rays(points)
        sink = -rays @ self.up
        length = np.linalg.norm(rays, axis=1)
        depth = np.where(sink > HORIZON * length, self.height / np.where(sink > 0, sink, 1.0), np.nan)
        return rays * depth[:, None]

    def to_floor(self, positions: Floats) -> Floats:
        """Coordinates [N, 3] (m) right, above the floor and ahead, of positions [N, 3] in the frame of the camera."""
        return positions @ self.axes.T + np.array([0.0, self.height, 0.0])

    def from_floor(self, coordinates: Floats) -> Floats:
        """Positions [N, 3] (m) in the frame of the camera, of coordinates [N, 3] right, above the floor and ahead."""
        return (coordinates - np.array([0.0, self.height, 0.0])) @ self.axes


def axes_of(pitch: Floats, roll: Floats) -> Floats:
    """Unit vectors right, up and ahead over the floor [K, 3, 3] in the frames of cameras, from radians [K] each."""
    sine, cosine, zero = np.sin(pitch), np.cos(pitch), np.zeros(len(pitch))
    s, c = np.sin(roll), np.cos(roll)
    # A roll turns the image about the optical axis: up leans to the left where it is positive.
    right = np.stack([c, -s, zero], axis=1)
    up = np.stack([-s * cosine, -c * cosine, -sine], axis=1)
    ahead = np.stack([-s * sine, -c * sine, cosine], axis=1)
    return np.stack([right, up, ahead], axis=1)


FOCAL_WIDTHS = 1.0  # focal length in image widths, where no floor is computed
PITCHES = 0.0, math.radians(55)  # that pictures of things on a floor have
FOCALS = 0.45, 2.2  # of the longer side of the image
FLAT = math.sqrt(3)  # half the width of a uniform distribution, in its deviations
GRID = 20, 10  # pitches, and focal lengths, that are weighed
ROLLS = np.array([-1, 0, 1]) * math.sqrt(3), np.array([1, 4, 1]) / 6  # in deviations, and weights: moments of a normal
SEEN_RIM = 0.8  # of the tops that look round: the others were seen amiss
CUBE_SIGMA = 0.1  # of a cube's height in the image against its width
CUBE_AMISS = 0.02  # likelihood of any height, where a cube was seen amiss
TURNED = np.linspace(1.0, math.sqrt(2), 6)  # widths, in its side, of a cube whose yaw is not known
OUT_OF_SIGHT = 50.0  # penalty of a foot above the horizon: such a camera loses against any without one
FAR_END = 0.3  # of the image's width: a level line so long above all things is the far end of the floor, as a rule
FAR_END_SLOPE = 0.35
FAR_END_SIGMA, FAR_END_SEEN = 0.2, 0.75  # of the sine of the angle below the horizon; share of such lines that are it
NARROWED = 0.5  # of the deviation of the pitch before: from here on it was measured
ROLL_SIGMA = math.radians(1.0)
HEIGHT_RADII, HEIGHT_SIGMA = 5.0, 0.6  # above the floor of what is in the air, in its radii; of the logarithm
SLANT = (0.0, 0.1)  # of the light: right and ahead, per unit of height
SLANT_SIGMA = (0.5, 0.45)
# Of the measurements: centre in radii of the ball, log of width and height, correlation.
MEASUREMENT_SIGMA = (0.05, 0.05, 0.06, 0.08, 0.05)
MAX_COST = 12.0  # squared deviations of the measurements in all: a patch that fits worse is not the ball's shadow
GOOD_COST = 5.0  # a worse fit than this widens the deviations
LOWEST, HIGHEST = np.array([0.05, -0.9, 0.0, -1.5, -1.5]), np.array([1.4, 1.2, 3.7, 1.5, 1.5])
MAX_ITERATIONS = 20


@dataclass(frozen=True)
class CameraFit:
    """Pitch (rad), log focal length (image widths), log height (radii), slant right and ahead: mean and covariance."""

    mean: Floats  # [5]
    covariance: Floats  # [5, 5]
    roll: float  # radians
    roll_sigma: float
    source: CameraSource


def prior(roll: float = 0.0, aspect: float = 1.0) -> CameraFit:
    """What is known of the camera before anything is measured; `aspect` is the image's longer side in its widths."""
    (lowest, highest), (shortest, longest) = PITCHES, np.log(FOCALS)
    middle = (lowest + highest) / 2, (shortest + longest) / 2 + math.log(aspect)
    mean = np.array([*middle, math.log(HEIGHT_RADII), *SLANT])
    flat = (highest - lowest) / 2 / FLAT, (longest - shortest) / 2 / FLAT
    sigma = np.array([*flat, HEIGHT_SIGMA, *SLANT_SIGMA])
    return CameraFit(mean, np.diag(sigma**2), roll, ROLL_SIGMA, "prior")


# Of a drawing that has no depth: seen level, from so far away that all depths look the same.
_FAR = np.array([0.0, math.log(20.0), math.log(HEIGHT_RADII), *SLANT])
SIDE_VIEW = CameraFit(_FAR, 1e-12 * np.eye(5), roll=0.0, roll_sigma=0.0, source="side-view")


@dataclass(frozen=True)
class Standing:
    """What one thing that stands on the floor shows of the camera."""

    bbox: BBox
    rim: tuple[float, float] | None = None  # of a round top: minor to major axis as seen, and its deviation
    is_cube: bool = False
    shape: Shape | None = None  # where it is known
    edges: Floats = field(default_factory=no_edges)  # ends [S, 4] (px) of its straight edges, longest first

    @staticmethod
    def of(body: SeenBody) -> Standing:
        """What a body shows."""
        shape = body.shape if body.is_form_known else None
        rim = body.rim if shape == "cylinder" else None
        return Standing(body.core, rim, body.prior.equal_sided, shape, body.edges)

    def explained(self, views: Views, size: tuple[int, int]) -> Floats:
        """Log likelihood [K], to a constant, of what it shows in an image of a size (px) to each of some cameras.

        A circle is seen as an ellipse whose axes have the ratio of the sine of the angle at which it is looked down
        on; a cube shows the more of its top the larger that angle is.
        """
        x0, y0, x1, y1 = self.bbox
        ends = np.array([((x0 + x1) / 2, y0), ((x0 + x1) / 2, y1)])
        at_top, sine = views.sines_down((ends - np.array(size) / 2) / size[0]).T
        fits = -OUT_OF_SIGHT * (sine < HORIZON)
        if self.rim is not None:
            seen, deviation = self.rim
            off = (at_top - seen) / deviation
            fits += np.log(SEEN_RIM * np.exp(-0.5 * off**2) / (deviation * math.sqrt(2 * math.pi)) + 1 - SEEN_RIM)
        if self.is_cube:
            heights = np.sqrt(1 - np.clip(sine, 0, 1) ** 2)[:, None] / TURNED + sine[:, None]
            off = ((y1 - y0) / (x1 - x0) - heights) / CUBE_SIGMA
            fits += np.log(np.exp(-0.5 * off**2).mean(axis=1) + CUBE_AMISS)
        if len(self.edges) and self.shape != "sphere":
            fits += views.explain(Segments.of(self.edges, size), self.bbox, self.shape, size)
        return fits


GIVEN_PITCH_SIGMA, GIVEN_ROLL_SIGMA = math.radians(1.0), math.radians(0.5)
GIVEN_FOCAL_SIGMA = 0.02  # of the logarithm
LEAST_HEIGHT_SIGMA = 0.05  # of the logarithm of a height that is said
SHORTEST, LONGEST = -2.0, 3.0  # logarithms of focal lengths in widths that a camera can have
FIXED = 1e-6  # deviation of a focal length that must not vary


def given_camera(
    size: tuple[int, int],
    down: Vector,
    given: CameraRequest | None,
    focal: Estimate | None = None,
    fixed_focal: bool = False,
) -> CameraFit:
    """The camera of an image of a size (width, height; px) as far as a request gives it; the rest is a guess.

    `down` is where the vertical leads in the image; `focal` (px) is the focal length by what else tells it, which the
    request overrules; `fixed_focal` holds it where it is.
    """
    fit, given = prior(math.atan2(*down), max(size) / size[0]), given or CameraRequest.model_construct()
    mean, sigma = fit.mean.copy(), np.sqrt(np.diag(fit.covariance))
    if given.pitch is not None:
        mean[0], sigma[0] = math.radians(given.pitch), GIVEN_PITCH_SIGMA
    if focal is not None:
        mean[1], sigma[1] = math.log(focal.value / size[0]), focal.deviation / focal.value
    if given.focal is not None:
        mean[1], sigma[1] = math.log(given.focal / size[0]), GIVEN_FOCAL_SIGMA
    mean[1] = min(max(mean[1], SHORTEST), LONGEST)
    if fixed_focal:
        mean[1], sigma[1] = math.log(FOCAL_WIDTHS), FIXED
    if given.roll is not None:
        fit = replace(fit, roll=math.radians(given.roll), roll_sigma=GIVEN_ROLL_SIGMA)
    source = "request" if given.model_fields_set else fit.source if focal is None else "exif"
    return replace(fit, mean=mean, covariance=np.diag(sigma**2), source=source)


def camera_of(
    fit: CameraFit,
    size: tuple[int, int],
    standing: Sequence[Standing],
    lines: Floats,
    flying: SeenBody | None,
    metres_per_pixel: float,
    shadow: Shadow | None,
) -> CameraFit:
    """The camera from objects on the floor and, for a mover in the air, from its stated height and its shadow.

    `lines` are segments [N, 4] (px) that lie between things; `metres_per_pixel` holds at the mover.
    """
    said = None if flying is None else flying.prior.height
    if flying is not None and said is not None:
        radius = flying.radius * metres_per_pixel
        height = 1 + said.value / radius  # of its middle, in its radii
        mean, covariance = fit.mean.copy(), fit.covariance.copy()
        mean[2], covariance[2, 2] = math.log(height), max(said.deviation / radius / height, LEAST_HEIGHT_SIGMA) ** 2
        fit = replace(fit, mean=mean, covariance=covariance)
    fit = narrowed(fit, standing, size, lines)
    return fit if shadow is None or flying is None else fit_shadow(fit, flying.bbox, shadow, size) or fit


def narrowed(
    fit: CameraFit, things: Sequence[Standing], size: tuple[int, int], floor: Floats | None = None
) -> CameraFit:
    """The camera from objects on the floor of an image of a size (width, height; px), and from lines of the floor.

    All feet lie below the horizon. Upright edges meet in one vanishing point, the level edges of a thing in two on the
    horizon. `floor` has segments [N, 4] (px) beside things.
    """
    floor = no_edges() if floor is None else floor
    if not things and not len(floor):
        return fit
    sigma = np.sqrt(np.diag(fit.covariance))[:2]
    steps = [side * np.linspace(-FLAT, FLAT, count) for side, count in zip(sigma, GRID, strict=True)]
    axes = fit.mean[0] + steps[0], fit.mean[1] + steps[1], fit.roll + fit.roll_sigma * ROLLS[0]
    pitch, log_focal, roll = (axis.ravel() for axis in np.meshgrid(*axes, indexing="ij"))
    views = Views(np.exp(log_focal), axes_of(pitch, roll))
    fits = np.tile(np.log(ROLLS[1]), math.prod(GRID))
    for thing in things:
        fits += thing.explained(views, size)
    if len(floor) > 1:
        fits += views.explain(Segments.of(floor, size), None, None, size)
    fits += _far_end(floor, min((thing.bbox[3] for thing in things), default=size[1]), views, size)
    weight = np.exp(fits - fits.max())
    found = np.stack([pitch, log_focal])
    mean, covariance = fit.mean.copy(), fit.covariance.copy()
    mean[:2] = found @ weight / weight.sum()
    # What lies between two steps is not told apart.
    between = np.diag([float(step[1] - step[0]) ** 2 / 12 for step in steps])
    covariance[:2, :2] = np.cov(found, aweights=weight, ddof=0) + between
    is_measured = fit.source == "prior" and covariance[0, 0] < (NARROWED * sigma[0]) ** 2
    return replace(fit, mean=mean, covariance=covariance, source="edges" if is_measured else fit.source)


def _far_end(floor: Floats, above: float, views: Views, size: tuple[int, int]) -> Floats:
    """Log likelihood [K] to each camera that the uppermost long and level segment above a height is the floor's far
    end, which lies on the horizon."""
    middle, across = (floor[:, :2] + floor[:, 2:]) / 2, np.abs(floor[:, 2:] - floor[:, :2])
    is_end = (across[:, 0] > FAR_END * size[0]) & (across[:, 1] < FAR_END_SLOPE * across[:, 0]) & (middle[:, 1] < above)
    if not is_end.any():
        return np.zeros(len(views.focal))
    end = min(middle[is_end], key=lambda point: point[1])
    down = views.sines_down((end[None] - np.array(size) / 2) / size[0])[:, 0]
    likely = np.exp(-0.5 * (down / FAR_END_SIGMA) ** 2) / (FAR_END_SIGMA * math.sqrt(math.pi / 2))
    return np.asarray(np.log(FAR_END_SEEN * likely + 1 - FAR_END_SEEN) - OUT_OF_SIGHT * (down < 0), np.float64)


def fit_shadow(start: CameraFit, ball: BBox, shadow: Shadow, size: tuple[int, int]) -> CameraFit | None:
    """The camera by the shadow of a ball in a box of an image of a size (width, height), px.

    None if no likely camera and light would make that shadow of a ball in the air.
    """
    radius, middle = (ball[2] - ball[0] + ball[3] - ball[1]) / 4, np.array(size) / 2
    across = (np.array([ball[0] + ball[2], ball[1] + ball[3]]) / 2 - middle) / radius
    precision = np.linalg.inv(start.covariance)
    root = np.linalg.cholesky(precision).T
    seen = np.array([*shadow.centre, *shadow.spread])
    turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)

    def residuals(parameters: Floats) -> Floats:
        """Deviations from the shadow that such a camera, height and light make [5], and from the priors [5].

        Lengths are radii of the ball: x right, y down, z ahead.
        """
        pitch, log_focal, log_height, sideways, away = parameters
        focal, height = math.exp(log_focal) * size[0], math.exp(log_height)
        right, up, ahead = axes_of(np.array([pitch]), np.array([start.roll]))[0]
        centre = np.array([*across, focal / radius]) + height * (sideways * right + away * ahead - up)
        slant = np.array([sideways, away])
        # A ball's shadow has the matrix 1 + slant slant^T: as wide as the ball, drawn out along the light.
        rim = circle @ (np.eye(2) + np.outer(slant, slant) / (1 + np.sqrt(1 + slant @ slant)))
        points = centre + rim[:, :1] * right + rim[:, 1:] * ahead
        image = focal * points[:, :2] / np.maximum(points[:, 2:], 1e-3) + middle
        spread = np.cov(image.T, bias=True) / 2
        made = np.array([*image.mean(axis=0), spread[0, 0], spread[1, 1], spread[0, 1]])
        measured = (_features(made, radius) - _features(seen, radius)) / np.array(MEASUREMENT_SIGMA)
        return np.concatenate([measured, root @ (parameters - start.mean)])

    parameters = start.mean.copy()
    drop = (shadow.centre[1] - (ball[1] + ball[3]) / 2) / radius / math.cos(parameters[0])
    parameters[2] = math.log(max(drop, 1.2))
    parameters, slopes = gauss_newton(
        residuals, parameters, step=1e-5, most=0.3, least=1e-4, iterations=MAX_ITERATIONS, bounds=(LOWEST, HIGHEST)
    )
    cost = float((residuals(parameters)[:5] ** 2).sum())
    if cost > MAX_COST:
        return None
    covariance = np.asarray(np.linalg.inv(slopes.T @ slopes), np.float64) * max(1.0, cost / GOOD_COST)
    return CameraFit(parameters, covariance, start.roll, start.roll_sigma, "shadow")


def gauss_newton(
    residuals: Callable[[Floats], Floats],
    parameters: Floats,
    *,
    step: float,
    most: float,
    least: float,
    iterations: int,
    bounds: tuple[Floats | float, Floats | float] = (-math.inf, math.inf),
) -> tuple[Floats, Floats]:
    """Parameters [P] of least squared residuals [N], and the slopes [N, P] of these by differences over a `step`.

    A parameter moves by `most` at a time, within the bounds, until none moves by `least`.
    """
    slopes = np.zeros((0, len(parameters)))
    for _ in range(iterations):
        now = residuals(parameters)
        steps = step * np.eye(len(parameters))
        slopes = np.stack([(residuals(parameters + each) - now) / step for each in steps], axis=1)
        move = np.clip(np.linalg.lstsq(slopes, -now, rcond=None)[0], -most, most)
        parameters = np.clip(parameters + move, *bounds)
        if float(np.abs(move).max()) < least:
            break
    return parameters, slopes


def _features(shadow: Floats, radius: float) -> Floats:
    """A shadow's centre in radii, log half width and half height, and correlation."""
    x, y, xx, yy, xy = shadow
    return np.array([x / radius, y / radius, np.log(xx) / 2, np.log(yy) / 2, xy / np.sqrt(xx * yy)])
