"""Where a ball in the air comes down and whether it then rolls into something, estimated from its shadow on the floor.

A thrown ball comes down, bounces and rolls on along its heading, at whatever speed; what decides is its depth in the
scene. Its shadow depends on that depth and on the light: on the floor it is a circle stretched along the slant of the
light. Its centre and shape in the image are five measurements; camera pitch, height above the floor and the slant of
the light are four unknowns. A least-squares fit gives them with their covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.physics.camera import FOCAL_WIDTHS, PITCH
from cow_service.physics.encounters import REACH, floor_gap
from cow_service.records import BBox
from cow_service.vision.masks import iou
from cow_service.vision.obstacles import Obstacle
from cow_service.vision.regions import SAME_OBJECT_IOU
from cow_service.vision.scene import Scene
from cow_service.vision.shadows import Shadow, find_shadow
from cow_service.vision.types import Floats

MIN_SIDEWAYS = 0.5  # of the heading's length, sideways in the image: less is up, down or away
SURE = 0.88  # probability from which an answer is given
REACH_SIGMA = 0.12  # of the reach: objects are no circles on the floor, and boxes are inexact
CLEAR = 1.2  # of the reach: what lies that far behind the start is not met
PRIOR_MEAN = (PITCH, 4.0, 0.0, 0.1)  # rad, radii, radii per radius: pitch, height, slant of the light sideways and away
PRIOR_SIGMA = (0.21, 4.0, 0.5, 0.35)  # of the mean, in its units: a room's light falls steeper than 45 degrees
# Of the measurements: centre in radii of the ball, log of width and height, correlation.
MEASUREMENT_SIGMA = (0.05, 0.05, 0.06, 0.08, 0.05)
MAX_COST = 14.0  # squared deviations in all: a patch that fits worse is not the ball's shadow
MIN_HEIGHT = 1.4  # radii, from the floor to the ball's centre: lower, it stands
MAX_ITERATIONS = 12  # of the fit


@dataclass(frozen=True)
class Landing:
    """The ball on the floor below its place in the air, under one hypothesis. Not where it comes to rest."""

    footprint: BBox  # px: the circle on the floor that is as wide as the ball, around where it touches
    pitch: float  # rad: how far the camera looks down

    @property
    def squash(self) -> float:
        """Height of a circle on the floor, of its width."""
        return math.sin(self.pitch)


def rolls_into(
    scene: Scene, mover: BBox, heading: tuple[float, float], target: BBox, obstacles: Sequence[Obstacle] = ()
) -> bool | None:
    """Whether the ball in box `mover` thrown along `heading` (px, y down) rolls into what stands in box `target`.

    The heading's upward part is taken for elevation, not depth. None where no shadow tells where the ball is, where
    the heading is too steep, where it is too close to call, or where an obstacle might be met before the target.
    """
    region, length = scene.region_of(mover), float(np.hypot(*heading))
    if region is None or not region.is_disc or length == 0 or abs(heading[0]) < MIN_SIDEWAYS * length:
        return None
    shadow = find_shadow(scene, mover)
    if shadow is None:
        return None
    landings = landings_below(shadow, mover, (scene.width, scene.height))
    if not landings:
        return None
    sense = float(np.sign(heading[0]))
    verdict = _verdict(scene, landings, sense, target)
    if verdict is None:
        return None
    for obstacle in obstacles:
        if iou(obstacle.bbox, target) >= SAME_OBJECT_IOU or iou(obstacle.bbox, mover) >= SAME_OBJECT_IOU:
            continue
        before = sense * (obstacle.bbox[0] + obstacle.bbox[2] - target[0] - target[2]) < 0
        if before and _verdict(scene, landings, sense, obstacle.bbox) is not False:
            return None
    return verdict


def _verdict(scene: Scene, landings: Sequence[Landing], sense: float, bbox: BBox) -> bool | None:
    """Whether the ball meets what stands in a box, where that is sure, be a round thing a ball or a block."""
    region = scene.region_of(bbox)
    shapes = (False, True) if region is not None and region.is_disc else (False,)
    chances = [_chance(landings, sense, bbox, is_ball) for is_ball in shapes]
    verdicts = {None if chance is None or 1 - SURE < chance < SURE else chance >= SURE for chance in chances}
    return verdicts.pop() if len(verdicts) == 1 else None


def _standing(bbox: BBox, is_ball: bool, landing: Landing) -> BBox:
    """The box of an object, down to the foot of its footprint: a ball's silhouette ends above that."""
    if not is_ball:
        return bbox
    left, top, right, bottom = bbox
    overhang = (math.cos(landing.pitch) + landing.squash - 1) * (right - left) / 2
    return left, top, right, bottom + overhang


def _chance(landings: Sequence[Landing], sense: float, bbox: BBox, is_ball: bool) -> float | None:
    """How likely the ball, rolling on along its row of the image, comes within reach of what stands in a box.

    None where it may come down upon that very thing, or beside it.
    """
    gaps = [floor_gap(landing.footprint, _standing(bbox, is_ball, landing), landing.squash) for landing in landings]
    ratios = [away / (REACH * reach) for _, away, reach in gaps]
    variance = sum(((more - less) / 2) ** 2 for less, more in zip(ratios[1::2], ratios[2::2], strict=True))
    deviation = math.sqrt(variance + REACH_SIGMA**2)
    chance = _normal_cdf((1 - ratios[0]) / deviation) - _normal_cdf((-1 - ratios[0]) / deviation)
    across, _, reach = gaps[0]
    if -sense * across > REACH * reach:
        return chance
    if sense * across > CLEAR * REACH * reach:
        return 0.0
    return chance if chance < 1 - SURE else None


def _normal_cdf(deviations: float) -> float:
    """Share of a normal distribution below so many standard deviations."""
    return (1 + math.erf(deviations / math.sqrt(2))) / 2


def landings_below(shadow: Shadow, ball: BBox, size: tuple[int, int]) -> tuple[Landing, ...]:
    """The likeliest landing of a ball in a box of an image of a size (width, height), px, then pairs to either side.

    Each pair lies one standard deviation from it, one pair for each independent doubt. Empty where no likely camera
    and light would make that shadow of a ball in the air.
    """
    model = _ShadowModel.of(ball, size)
    fit = _fit(model, shadow)
    if fit is None:
        return ()
    parameters, covariance = fit
    values, axes = np.linalg.eigh(covariance)
    steps = axes * np.sqrt(np.maximum(values, 0))
    around = [parameters, *(parameters + sign * steps[:, i] for i in range(len(values)) for sign in (-1, 1))]
    return tuple(model.landing(_bounded(each)) for each in around)


@dataclass(frozen=True)
class _ShadowModel:
    """A ball seen by a pinhole camera, in radii of the ball: x right, y down, z ahead."""

    focal: float  # px
    middle: Floats  # [2] px
    ball: Floats  # [3]: its centre

    @staticmethod
    def of(bbox: BBox, size: tuple[int, int]) -> _ShadowModel:
        focal, middle = FOCAL_WIDTHS * size[0], np.array(size) / 2
        radius = (bbox[2] - bbox[0] + bbox[3] - bbox[1]) / 4
        centre = np.array([bbox[0] + bbox[2], bbox[1] + bbox[3]]) / 2
        return _ShadowModel(focal, middle, np.array([*((centre - middle) / radius), focal / radius]))

    def image(self, points: Floats) -> Floats:
        """Image points [N, 2] (px) of points [N, 3]."""
        return self.focal * points[:, :2] / np.maximum(points[:, 2:], 1e-3) + self.middle

    def shadow(self, parameters: Floats) -> Floats:
        """Centre [2] and spread [3] (px, px^2) of the shadow that such pitch, height and light make."""
        pitch, height, sideways, away = parameters
        up, ahead = _axes(pitch)
        right = np.array([1.0, 0.0, 0.0])
        centre = self.ball + height * (sideways * right + away * ahead - up)
        slant = np.array([sideways, away])
        # A ball's shadow has the matrix 1 + slant slant^T: as wide as the ball, drawn out along the light.
        stretch = np.eye(2) + np.outer(slant, slant) / (1 + np.sqrt(1 + slant @ slant))
        turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        rim = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ stretch
        points = self.image(centre + rim[:, :1] * right + rim[:, 1:] * ahead)
        spread = np.cov(points.T, bias=True) / 2
        return np.array([*points.mean(axis=0), spread[0, 0], spread[1, 1], spread[0, 1]])

    def landing(self, parameters: Floats) -> Landing:
        """The ball on the floor under it."""
        up, _ = _axes(parameters[0])
        touching = self.ball - parameters[1] * up
        (x, y), radius = self.image(touching[None])[0], self.focal / (touching + up)[2]
        high = radius * math.sin(parameters[0])
        return Landing((x - radius, y - high, x + radius, y + high), float(parameters[0]))


def _axes(pitch: float) -> tuple[Floats, Floats]:
    """The directions up and straight ahead over the floor [3] for a camera that looks down by a pitch (rad)."""
    sine, cosine = np.sin(pitch), np.cos(pitch)
    return np.array([0.0, -cosine, -sine]), np.array([0.0, -sine, cosine])


def _bounded(parameters: Floats) -> Floats:
    return np.clip(parameters, [0.1, 1.0, -1.5, -1.5], [1.3, 40.0, 1.5, 1.5])


def _fit(model: _ShadowModel, shadow: Shadow) -> tuple[Floats, Floats] | None:
    """Pitch, height and slant of the light [4] with their covariance [4, 4], by Gauss-Newton from the prior_mean.

    None where no likely camera and light would make that shadow of the ball in the air.
    """
    prior_mean, prior_sigma = np.array(PRIOR_MEAN), np.array(PRIOR_SIGMA)
    radius = model.focal / model.ball[2]

    def residuals(parameters: Floats) -> Floats:
        seen = _features(np.array([*shadow.centre, *shadow.spread]), radius)
        made = _features(model.shadow(_bounded(parameters)), radius)
        return np.concatenate([(made - seen) / np.array(MEASUREMENT_SIGMA), (parameters - prior_mean) / prior_sigma])

    drop = shadow.centre[1] - float(model.image(model.ball[None])[0, 1])
    parameters = _bounded(np.array([prior_mean[0], drop / radius / math.cos(prior_mean[0]), *prior_mean[2:]]))
    slopes = np.zeros((9, 4))
    for _ in range(MAX_ITERATIONS):
        now = residuals(parameters)
        slopes = np.stack([(residuals(parameters + step) - now) / 1e-4 for step in 1e-4 * np.eye(4)], axis=1)
        move = np.clip(np.linalg.lstsq(slopes, -now, rcond=None)[0], [-0.2, -2, -0.4, -0.4], [0.2, 2, 0.4, 0.4])
        parameters = _bounded(parameters + move)
        if float(np.abs(move).max()) < 1e-3:
            break
    cost = float((residuals(parameters) ** 2).sum())
    if cost > MAX_COST or parameters[1] < MIN_HEIGHT:
        return None
    return parameters, np.asarray(np.linalg.pinv(slopes.T @ slopes), np.float64)


def _features(shadow: Floats, radius: float) -> Floats:
    """A shadow's centre in radii, log half width and half height, and correlation."""
    x, y, xx, yy, xy = shadow
    return np.array([x / radius, y / radius, np.log(xx) / 2, np.log(yy) / 2, xy / np.sqrt(xx * yy)])
