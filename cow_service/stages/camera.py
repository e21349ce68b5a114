"""The camera of an image: what the request says of it, what a shadow tells, and the priors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from cow_service.physics.camera_fit import CameraFit, fit_shadow, prior
from cow_service.records import BBox, Motion
from cow_service.requests import CameraRequest
from cow_service.vision.scene import Scene
from cow_service.vision.shadows import find_shadow

GIVEN_PITCH_SIGMA, GIVEN_ROLL_SIGMA = math.radians(1.0), math.radians(0.5)
GIVEN_FOCAL_SIGMA = 0.02  # of the logarithm
FIXED = 1e-6  # deviation of a focal length that must not vary


def camera_of(
    scene: Scene, motion: Motion, given: CameraRequest | None, flying: BBox | None, fixed_focal: bool
) -> CameraFit:
    """The camera, by the shadow of what flies in a box too; `fixed_focal` holds the focal length where it is."""
    x, y = motion.down
    fit = _with_given(prior(math.atan2(x, y)), given, scene.width, fixed_focal)
    shadow = None if flying is None else find_shadow(scene, flying)
    if flying is None or shadow is None:
        return fit
    return fit_shadow(fit, flying, shadow, (scene.width, scene.height)) or fit


def _with_given(fit: CameraFit, given: CameraRequest | None, width: int, fixed_focal: bool) -> CameraFit:
    mean, sigma = fit.mean.copy(), np.sqrt(np.diag(fit.covariance))
    roll, roll_sigma = fit.roll, fit.roll_sigma
    if given is not None and given.pitch is not None:
        mean[0], sigma[0] = math.radians(given.pitch), GIVEN_PITCH_SIGMA
    if given is not None and given.focal is not None and not fixed_focal:
        mean[1], sigma[1] = math.log(given.focal / width), GIVEN_FOCAL_SIGMA
    if given is not None and given.roll is not None:
        roll, roll_sigma = math.radians(given.roll), GIVEN_ROLL_SIGMA
    if fixed_focal:
        sigma[1] = FIXED
    source = fit.source if given is None else "request"
    return replace(fit, mean=mean, covariance=np.diag(sigma**2), roll=roll, roll_sigma=roll_sigma, source=source)
