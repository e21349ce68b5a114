"""Bodies for tests of the engine, with sizes in metres, and the energy that a run has; and what a known camera sees."""

from __future__ import annotations

from typing import Any

import numpy as np
from floors import Box, Floats, TrueCamera, known, outline

from cow_service.media.masks import CroppedMask
from cow_service.physics.bodies import SeenBody
from cow_service.physics.draws import likeliest
from cow_service.physics.engine import RigidShape, WorldRun
from cow_service.physics.events import WorldEvents, find_world_events
from cow_service.physics.world import WorldInput, Worlds, run_world
from cow_service.records import MetresPerPixel, Motion

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


CAMERA = TrueCamera(pitch=25, height=1.5)
HALF, SPEED = 0.12, 1.2  # m, of the balls that it sees; m/s
FRAMES, FPS = 65, 16.0


def seen(name: str, shape: Any, bbox: Box) -> SeenBody:
    """A body in a box: an ellipse, if it is a sphere, else all of the box."""
    x0, y0, x1, y1 = bbox
    ys, xs = np.mgrid[:400, :640] + 0.5
    inside = (xs >= x0) & (xs < x1) & (ys >= y0) & (ys < y1)
    if shape == "sphere":
        inside &= ((xs - (x0 + x1) / 2) / (x1 - x0)) ** 2 + ((ys - (y0 + y1) / 2) / (y1 - y0)) ** 2 < 0.25
    return SeenBody(name, bbox, CroppedMask.of(inside), shape)


def ball(right: float, ahead: float = 3.0, above: float = 0.0, name: str = "ball") -> SeenBody:
    """At a place over the floor, m."""
    return seen(name, "sphere", CAMERA.sphere_box((right, above + HALF, ahead), HALF))


def post(
    right: float, ahead: float = 3.0, half: float = HALF, height: float = 0.35, name: str = "post", shape="cylinder"
) -> SeenBody:
    return seen(name, shape, CAMERA.box(outline(shape, (right, ahead), half, height)))


def rolling(speed: float = SPEED, above: float = 0.0, **changes: Any) -> Motion:
    """To the right, three metres ahead, at a scale that makes metres those of the true camera."""
    scale = CAMERA.positions(np.array([[0.0, above + HALF, 3.0]]))[0, 2] / CAMERA.focal
    given = {"kind": "linear", "direction": (1.0, 0.0), "speed": speed / scale} | changes
    metres = MetresPerPixel(value=scale, source="reference")
    return Motion(
        law="contact",
        cue="request",
        direction_deviation=1.0,
        sentence="",
        metres_per_pixel=metres,
        source="request",
        **given,
    )


def happened(
    *bodies: SeenBody,
    motion: Motion | None = None,
    draws: Floats | None = None,
    every: int = 1,
    doubt: float = 1e-6,
    above: float | None = None,
    **world: Any,
) -> tuple[Worlds, WorldEvents]:
    """The worlds of bodies whose first one moves; the first floats `above` the floor, if that is given, m."""
    fit, rows = known(CAMERA, doubt), likeliest() if draws is None else draws
    if above is not None:
        fit.mean[2] = np.log((above + HALF) / HALF)  # in radii, as a fit says it of what flies
    given = WorldInput(bodies, motion or rolling(), fit, CAMERA.size, FRAMES, FPS, **world)
    worlds = run_world(given, rows, every)
    return worlds, find_world_events(worlds, bodies, rows, CAMERA.size)
