"""Bodies for tests of the engine, with sizes in metres; and the energy that a run has."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cow_service.physics.engine import RigidShape, WorldRun

Floats = NDArray[np.float64]
RADIUS = 0.15  # m
G = 9.81  # m/s^2


def rigid(shape: str = "sphere", half: float = RADIUS, height: float | None = None, **other: Any) -> RigidShape:
    """A body of half widths `half` and half height `height`; by default it stands at the origin."""
    tall = half if height is None else height
    given = {"shape": shape, "half_width": half, "half_depth": half, "half_height": tall, "position": (0.0, tall, 0.0)}
    return RigidShape(**(given | other))


def mass(body: RigidShape) -> float:
    """At a density of 1, kg."""
    w, d, h = body.half_width, body.half_depth, body.half_height
    share = {"sphere": np.pi / 6, "box": 1.0, "cylinder": np.pi / 4, "cone": np.pi / 12}[body.shape]
    return float(share * 8 * w * d * h)


def turned(turns: Floats, vector: Floats) -> Floats:
    """A vector [3] turned by quaternions [F, 4] (x, y, z, w)."""
    axis, w = turns[:, :3], turns[:, 3:]
    across = np.cross(axis, vector)
    return vector + 2 * (w * across + np.cross(axis, across))


def energy(bodies: list[RigidShape], run: WorldRun) -> Floats:
    """[F] J: of height and of velocity, without that of spin, which only lessens what may be found later."""
    total = np.zeros(run.positions.shape[1])
    for i, body in enumerate(bodies):
        lower = np.array([0.0, -body.half_height / 2 if body.shape == "cone" else 0.0, 0.0])
        height = (run.positions[i] + turned(run.turns[i], lower))[:, 1]
        total += mass(body) * ((run.velocities[i] ** 2).sum(axis=1) / 2 + (G * height if body.falls else 0.0))
    return total


def spin_at_start(bodies: list[RigidShape]) -> float:
    """J: a ball that rolls has 2/5 of its energy in its spin."""
    rolling = [body for body in bodies if body.starts and body.glides and body.shape == "sphere"]
    return sum(mass(body) * (body.velocity[0] ** 2 + body.velocity[2] ** 2) / 5 for body in rolling)
