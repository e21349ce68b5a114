"""Constant velocity plus gravity on the 6-D state [x, y, z, vx, vy, vz] of one object.

Source: the state and the motion model of arXiv 2601.13304, section on the Causal Object World model.
"""

from __future__ import annotations

import numpy as np

from cow_service.vision.types import Floats

GRAVITY = 9.81  # m/s^2
DEFAULT_SPEED = 0.26  # image widths per second
DEFAULT_SCENE_WIDTH = 3.0  # m across the image at the object's depth, where nothing tells the scale


def roll_out(position: Floats, velocity: Floats, acceleration: Floats, times: Floats) -> Floats:
    """States [F, 6] at the given times [F] (s), from position [3] (m), velocity [3] (m/s), acceleration [3] (m/s^2).

    Closed form, so that a state does not depend on how finely the clip is sampled.
    """
    t = times[:, None]
    return np.hstack([position + velocity * t + 0.5 * acceleration * t * t, velocity + acceleration * t])
