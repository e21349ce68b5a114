"""Stage 2: how the object moves."""

from __future__ import annotations

import math
from dataclasses import replace

from cow_service.physics.dynamics import DEFAULT_SCENE_WIDTH, DEFAULT_SPEED, GRAVITY
from cow_service.readers.base import MotionHints, MotionReading
from cow_service.readers.question.wording import motion_sentence
from cow_service.records import (
    DIRECTED_KINDS,
    FALLING_KINDS,
    BBox,
    Grounding,
    Law,
    MetresPerPixel,
    Motion,
    MotionKind,
    Source,
    Vector,
)
from cow_service.requests import MotionRequest, SimulateRequest, TrajectoryRequest
from cow_service.stages.placing import placed_mover, placing_sentence
from cow_service.stages.results import StageResult
from cow_service.stages.run import Run

THROW_SPEED, THROW_RADIUS = 1.8, 0.15  # m/s, m: of a toy that is thrown, where no speed is given
THROW_DEPTH_DEVIATION = 15.0  # degrees: words and arrows tell a throw's heading in the image alone
SPEED_DEVIATIONS: dict[MotionKind, float] = {"linear": 0.25, "projectile": 0.28}  # of the logarithm of a default speed
SPEED_FACTORS = {"slow": 0.5, "normal": 1.0, "fast": 2.0}  # of the default speed


def read_motion(run: Run[SimulateRequest], grounding: Grounding, hints: MotionHints | None) -> StageResult[Motion]:
    """The motion, from the request where it gives one or a whole path, else from the reader, which gave the `hints`.

    Raises what the reader raises.
    """
    given, path = run.request.stated_motion, run.request.trajectory
    placed = placed_mover(grounding)
    speed: float | None = None
    source: Source = "request"
    if given is not None:
        reading, speed = _given(given), given.speed
    elif path is not None:
        reading, speed = _along(path)
    elif placed is not None and grounding.source == "request":
        reading = MotionReading("place", None, "request")
    else:
        reading, source = run.reader.read_motion(run.reader_input("motion"), grounding, hints), run.reader.source
    if placed is not None and reading.kind == "place":
        reading = replace(reading, sentence=reading.sentence or placing_sentence(grounding, placed))
    motion = _complete(run.scene.width, grounding, reading, speed, source, run.request.law)
    return StageResult(value=motion, warnings=(*reading.warnings, *_assumed(motion, speed)))


def _given(motion: MotionRequest) -> MotionReading:
    metres = motion.metres_per_pixel
    return MotionReading(
        motion.stated_kind or "linear",
        motion.direction,
        "request",
        depth=motion.depth,
        depth_deviation=motion.depth_deviation or 0.0,
        speed_deviation=motion.speed_deviation,
        metres_per_pixel=None if metres is None else MetresPerPixel(value=metres, source="request"),
    )


def _complete(
    image_width: int, grounding: Grounding, reading: MotionReading, speed: float | None, source: Source, law: Law
) -> Motion:
    """Adds what a reading leaves open: scale, speed, deviations, gravity and the sentence."""
    scale = reading.metres_per_pixel or MetresPerPixel(
        value=DEFAULT_SCENE_WIDTH / image_width,
        source="default",
        note=f"the image is taken to be {DEFAULT_SCENE_WIDTH:g} m wide at the object",
    )
    moves = reading.kind in DIRECTED_KINDS
    direction = _unit(reading.direction) if moves and reading.direction is not None else None
    depth = reading.depth if moves else 0.0
    return Motion(
        kind=reading.kind,
        law=law,
        direction=direction,
        depth=depth,
        depth_deviation=_depth_deviation(reading),
        cue=reading.cue,
        along_arrow=reading.along_arrow,
        speed=(_default_speed(image_width, grounding, reading, scale, law) if speed is None else speed)
        if moves
        else 0.0,
        speed_deviation=_speed_deviation(reading, speed),
        gravity=_gravity(reading.down, scale) if reading.kind in FALLING_KINDS else (0.0, 0.0),
        down=reading.down,
        metres_per_pixel=scale,
        sentence=motion_sentence(grounding.object, reading.kind, direction, depth, reading.sentence),
        source=source,
    )


def _default_speed(
    image_width: int, grounding: Grounding, reading: MotionReading, scale: MetresPerPixel, law: Law
) -> float:
    """px/s of a motion whose speed nobody gave as a number."""
    thrown = reading.kind == "projectile" and law == "contact"
    speed = throw_speed(grounding.bbox, scale) if thrown else DEFAULT_SPEED * image_width
    return speed if reading.speed is None else SPEED_FACTORS[reading.speed] * speed


def throw_speed(bbox: BBox, scale: MetresPerPixel) -> float:
    """px/s of a throw whose speed nobody gave: v^2 / (g R) as of a toy of radius 0.15 m thrown at 1.8 m/s.

    How far it gets in the image, in its own radii, does then not depend on the scale, which is uncertain.
    """
    x0, y0, x1, y1 = bbox
    radius = (x1 - x0 + y1 - y0) / 4  # px
    return math.sqrt(THROW_SPEED**2 / (GRAVITY * THROW_RADIUS) * (GRAVITY / scale.value) * radius)


def _depth_deviation(reading: MotionReading) -> float:
    """Degrees."""
    if reading.depth_deviation is not None and reading.kind in DIRECTED_KINDS:
        return reading.depth_deviation
    return THROW_DEPTH_DEVIATION if reading.kind == "projectile" else 0.0


def _speed_deviation(reading: MotionReading, speed: float | None) -> float:
    """Of the speed's natural logarithm; 0 for a speed that was given."""
    if reading.kind not in DIRECTED_KINDS:
        return 0.0
    if reading.speed_deviation is not None:
        return reading.speed_deviation
    return SPEED_DEVIATIONS[reading.kind] if speed is None else 0.0


def _gravity(down: Vector, scale: MetresPerPixel) -> Vector:
    """px/s^2."""
    strength = GRAVITY / scale.value
    return down[0] * strength, down[1] * strength


def _assumed(motion: Motion, speed: float | None) -> tuple[str, ...]:
    """A warning for a throw, whose reach depends on a speed that nobody gave."""
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
