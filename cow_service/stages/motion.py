"""Stage 2: how the object moves."""

from __future__ import annotations

import math
from collections.abc import Callable

from cow_service.physics.dynamics import DEFAULT_SCENE_WIDTH, DEFAULT_SPEED, GRAVITY
from cow_service.readers.base import Look, MotionReading
from cow_service.readers.question.wording import motion_sentence
from cow_service.records import Grounding, MetresPerPixel, Motion, Source, Vector
from cow_service.requests import MotionRequest, TrajectoryRequest
from cow_service.vision.scene import Scene

MOVING = ("linear", "projectile")
FALLING = ("projectile", "fall")


def read_motion(
    scene: Scene,
    grounding: Grounding,
    given: MotionRequest | None,
    path: TrajectoryRequest | None,
    look: Callable[[], Look],
) -> tuple[Motion, tuple[str, ...]]:
    """The motion, from the request where it gives one or a whole path, else from a reader's look; and its warnings."""
    speed = None
    if given is not None:
        speed = given.speed
        scale = (
            None if given.metres_per_pixel is None else MetresPerPixel(value=given.metres_per_pixel, source="request")
        )
        reading = MotionReading(given.kind, given.direction, "request", depth=given.depth, metres_per_pixel=scale)
        source: Source = "request"
    elif path is not None:
        reading, speed = _along(path)
        source = "request"
    else:
        reading, source = look().read_motion(grounding), look().source
    motion = _complete(scene, grounding, reading, speed, source)
    return motion, (*reading.warnings, *_assumed(motion, speed))


def _complete(
    scene: Scene, grounding: Grounding, reading: MotionReading, speed: float | None, source: Source
) -> Motion:
    """Adds what a reading leaves open: scale, speed, gravity and the sentence."""
    scale = reading.metres_per_pixel or MetresPerPixel(
        value=DEFAULT_SCENE_WIDTH / scene.width,
        source="default",
        note=f"the image is taken to be {DEFAULT_SCENE_WIDTH:g} m wide at the object",
    )
    moves = reading.kind in MOVING
    direction = _unit(reading.direction) if moves and reading.direction is not None else None
    depth = reading.depth if moves else 0.0
    return Motion(
        kind=reading.kind,
        direction=direction,
        depth=depth,
        cue=reading.cue,
        along_arrow=reading.along_arrow,
        speed=(DEFAULT_SPEED * scene.width if speed is None else speed) if moves else 0.0,
        gravity=_gravity(reading.down, scale) if reading.kind in FALLING else (0.0, 0.0),
        metres_per_pixel=scale,
        sentence=motion_sentence(grounding.object, reading.kind, direction, depth, reading.sentence),
        source=source,
    )


def _gravity(down: Vector, scale: MetresPerPixel) -> Vector:
    """px/s^2."""
    strength = GRAVITY / scale.value
    return down[0] * strength, down[1] * strength


def _assumed(motion: Motion, speed: float | None) -> tuple[str, ...]:
    """A doubt about a throw, whose reach hangs on a speed that nobody gave."""
    if motion.kind != "projectile" or speed is not None:
        return ()
    return (
        f"How far a throw reaches depends on its speed: {motion.speed:.0f} px/s was assumed; `motion.speed` sets it.",
    )


def _along(path: TrajectoryRequest) -> tuple[MotionReading, float]:
    """The motion that a given path amounts to: from its first point towards its last, at its mean speed (px/s)."""
    (x0, y0), (x1, y1) = path.points[0], path.points[-1]
    way = sum(math.dist(a, b) for a, b in zip(path.points, path.points[1:], strict=False))
    if way < 1e-6:
        return MotionReading("static", None, "request"), 0.0
    direction = (x1 - x0, y1 - y0) if math.hypot(x1 - x0, y1 - y0) > 1e-6 else _first_step(path)
    return MotionReading("linear", direction, "request"), way * path.fps / (len(path.points) - 1)


def _first_step(path: TrajectoryRequest) -> Vector:
    """The first move of a path that ends where it began."""
    x0, y0 = path.points[0]
    return next((x - x0, y - y0) for x, y in path.points if math.hypot(x - x0, y - y0) > 1e-6)


def _unit(vector: Vector) -> Vector:
    length = math.hypot(*vector)
    return vector[0] / length, vector[1] / length
