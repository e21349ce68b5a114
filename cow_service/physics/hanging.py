"""Where something that is let go hangs: likely over what the question asks about, if the picture shows it above."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from cow_service.physics.camera_fit import CameraFit
from cow_service.physics.draws import COLUMN
from cow_service.physics.lift import Placed
from cow_service.records import BBox
from cow_service.vision.types import Floats

HUNG = 4.0  # how much likelier it hangs over that than where the camera's priors have it
HUNG_SIGMA = 0.3  # of the mover's half width: how far ahead of the other it is
LEAST_OVERLAP = 0.1  # of the narrower box: with less of it above the other, it is seen beside that


def is_above(mover: BBox, asked: BBox) -> bool:
    """Whether the picture shows the mover above what is asked about."""
    overlap = min(mover[2], asked[2]) - max(mover[0], asked[0])
    narrower = min(mover[2] - mover[0], asked[2] - asked[0])
    return overlap > LEAST_OVERLAP * narrower and mover[1] + mover[3] < asked[1] + asked[3]


def hung_over(mover: Placed, heights: Floats, ahead_per_height: Floats, fit: CameraFit, draws: Floats) -> Floats:
    """Heights [K] (m) of the camera, of which most draws have the mover over what is asked about.

    `heights` [K] are those of the fit's draws. What is asked about stands `ahead_per_height` [K] times the height of
    the camera ahead of it, over the floor. What a shadow tells of the height weighs against it.
    """
    aside = HUNG_SIGMA * mover.half_width * draws[:, COLUMN["turn"]]
    aligned = (mover.centre[:, 2] + aside) / ahead_per_height
    in_radii = 2 * (aligned[0] + mover.centre[0, 1]) / (mover.half_width[0] + mover.half_height[0])
    if in_radii <= 0:
        return heights
    off = (np.log(in_radii) - fit.mean[2]) / np.sqrt(fit.covariance[2, 2])
    weight = HUNG * np.exp(-0.5 * off**2)
    shares = np.array([NormalDist().cdf(z) for z in draws[:, COLUMN["depth"]]])
    return np.where(shares < weight / (1 + weight), aligned, heights)
