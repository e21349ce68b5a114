"""Estimates the camera: by a ball's shadow where it flies, else by priors; each with its covariance.

A ball in the air of pixel radius r has depth f / r in radii. Its shadow on the floor, a circle stretched along the
slant of the light, gives five numbers: centre and spread. Five unknowns (pitch, log focal length, log height above the
floor, slant of the light to the right and ahead) are fitted to them and to their priors by Gauss-Newton.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cow_service.physics.floor_camera import axes_of
from cow_service.records import BBox, CameraSource
from cow_service.vision.shadows import Shadow
from cow_service.vision.types import Floats

FOCAL_WIDTHS = 1.0  # focal length in image widths: a horizontal field of view of 53 degrees
PITCH, PITCH_SIGMA = math.radians(28), math.radians(8)
FOCAL_SIGMA = 0.1  # of its natural logarithm
ROLL_SIGMA = math.radians(1.0)
HEIGHT_RADII, HEIGHT_SIGMA = 5.0, 0.6  # above the floor of what is in the air, in its radii; of the logarithm
SLANT = (0.0, 0.1)  # of the light: right and ahead, per unit of height
SLANT_SIGMA = (0.5, 0.45)
# Of the measurements: centre in radii of the ball, log of width and height, correlation.
MEASUREMENT_SIGMA = (0.05, 0.05, 0.06, 0.08, 0.05)
MAX_COST = 12.0  # squared deviations of the measurements in all: a patch that fits worse is not the ball's shadow
GOOD_COST = 5.0  # a worse fit than this widens the deviations
LOWEST, HIGHEST = np.array([0.05, -0.7, 0.0, -1.5, -1.5]), np.array([1.4, 0.7, 3.7, 1.5, 1.5])
MAX_ITERATIONS = 20


@dataclass(frozen=True)
class CameraFit:
    """Pitch (rad), log focal length (image widths), log height (radii), slant right and ahead: mean and covariance."""

    mean: Floats  # [5]
    covariance: Floats  # [5, 5]
    roll: float  # radians
    roll_sigma: float
    source: CameraSource


def prior(roll: float = 0.0) -> CameraFit:
    """What is known of the camera before anything is measured."""
    return CameraFit(*_prior(), roll, ROLL_SIGMA, "prior")


def fit_shadow(start: CameraFit, ball: BBox, shadow: Shadow, size: tuple[int, int]) -> CameraFit | None:
    """The camera by the shadow of a ball in a box of an image of a size (width, height), px.

    None where no likely camera and light would make that shadow of a ball in the air.
    """
    model = _ShadowModel.of(ball, size, start.roll)
    precision = np.linalg.inv(start.covariance)
    root = np.linalg.cholesky(precision).T
    seen = np.array([*shadow.centre, *shadow.spread])

    def residuals(parameters: Floats) -> Floats:
        made = _features(model.shadow(parameters), model.radius)
        measured = (made - _features(seen, model.radius)) / np.array(MEASUREMENT_SIGMA)
        return np.concatenate([measured, root @ (parameters - start.mean)])

    parameters = start.mean.copy()
    drop = (shadow.centre[1] - (ball[1] + ball[3]) / 2) / model.radius / math.cos(parameters[0])
    parameters[2] = math.log(max(drop, 1.2))
    slopes = np.zeros((10, 5))
    for _ in range(MAX_ITERATIONS):
        now = residuals(parameters)
        slopes = np.stack([(residuals(parameters + step) - now) / 1e-5 for step in 1e-5 * np.eye(5)], axis=1)
        move = np.clip(np.linalg.lstsq(slopes, -now, rcond=None)[0], -0.3, 0.3)
        parameters = np.clip(parameters + move, LOWEST, HIGHEST)
        if float(np.abs(move).max()) < 1e-4:
            break
    cost = float((residuals(parameters)[:5] ** 2).sum())
    if cost > MAX_COST:
        return None
    covariance = np.asarray(np.linalg.inv(slopes.T @ slopes), np.float64) * max(1.0, cost / GOOD_COST)
    return CameraFit(parameters, covariance, start.roll, start.roll_sigma, "shadow")


def _prior() -> tuple[Floats, Floats]:
    mean = np.array([PITCH, math.log(FOCAL_WIDTHS), math.log(HEIGHT_RADII), *SLANT])
    sigma = np.array([PITCH_SIGMA, FOCAL_SIGMA, HEIGHT_SIGMA, *SLANT_SIGMA])
    return mean, np.diag(sigma**2)


@dataclass(frozen=True)
class _ShadowModel:
    """A ball seen by a pinhole camera, lengths in radii of the ball: x right, y down, z ahead."""

    across: Floats  # [2]: its centre from the middle of the image, in its radii
    radius: float  # px
    width: float  # px, of the image
    middle: Floats  # [2] px
    roll: float  # radians

    @staticmethod
    def of(bbox: BBox, size: tuple[int, int], roll: float) -> _ShadowModel:
        radius, middle = (bbox[2] - bbox[0] + bbox[3] - bbox[1]) / 4, np.array(size) / 2
        centre = np.array([bbox[0] + bbox[2], bbox[1] + bbox[3]]) / 2
        return _ShadowModel((centre - middle) / radius, radius, float(size[0]), middle, roll)

    def shadow(self, parameters: Floats) -> Floats:
        """Centre [2] and spread [3] (px, px^2) of the shadow that such a camera, height and light make."""
        pitch, log_focal, log_height, sideways, away = parameters
        focal, height = math.exp(log_focal) * self.width, math.exp(log_height)
        right, up, ahead = axes_of(np.array([pitch]), np.array([self.roll]))[0]
        ball = np.array([*self.across, focal / self.radius])
        centre = ball + height * (sideways * right + away * ahead - up)
        slant = np.array([sideways, away])
        # A ball's shadow has the matrix 1 + slant slant^T: as wide as the ball, drawn out along the light.
        stretch = np.eye(2) + np.outer(slant, slant) / (1 + np.sqrt(1 + slant @ slant))
        turns = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        rim = np.stack([np.cos(turns), np.sin(turns)], axis=1) @ stretch
        points = centre + rim[:, :1] * right + rim[:, 1:] * ahead
        image = focal * points[:, :2] / np.maximum(points[:, 2:], 1e-3) + self.middle
        spread = np.cov(image.T, bias=True) / 2
        return np.array([*image.mean(axis=0), spread[0, 0], spread[1, 1], spread[0, 1]])


def _features(shadow: Floats, radius: float) -> Floats:
    """A shadow's centre in radii, log half width and half height, and correlation."""
    x, y, xx, yy, xy = shadow
    return np.array([x / radius, y / radius, np.log(xx) / 2, np.log(yy) / 2, xy / np.sqrt(xx * yy)])
