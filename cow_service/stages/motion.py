"""Stage 2: how the object moves."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from cow_service.physics.dynamics import DEFAULT_SCENE_WIDTH, GRAVITY
from cow_service.readers.base import MotionHints, MotionReading, Quantity
from cow_service.readers.question.wording import direction_words, motion_sentence
from cow_service.records import (
    DIRECTED_KINDS,
    FALLING_KINDS,
    Grounding,
    Law,
    MetresPerPixel,
    Motion,
    Source,
    Vector,
)
from cow_service.requests import MotionRequest, SimulateRequest, TrajectoryRequest
from cow_service.stages.legs import also_moving, given_others, other_words, step_of, step_reading, unit
from cow_service.stages.placing import placed_mover, placing_sentence
from cow_service.stages.quantities import Measures
from cow_service.stages.results import StageResult
from cow_service.stages.run import Run
from cow_service.stages.trails import along_trail

THROW_DEPTH_DEVIATION = 15.0  # degrees: words and arrows tell a throw's heading in the image alone
_GLIDING_ONLY = ("distance", "duration", "until", "steps")  # what only a motion along a line can have


def read_motion(run: Run[SimulateRequest], grounding: Grounding, hints: MotionHints | None) -> StageResult[Motion]:
    """The motion, from the request where it gives one or a whole path, else from the reader, which gave the `hints`.

    What the request says of speed and length goes before what the reader says. Raises what the reader raises, and
    `InvalidRequest` for a second mover that is none of the `objects`.
    """
    given, path = run.request.stated_motion, run.request.trajectory
    placed = placed_mover(grounding)
    source: Source = "request"
    if given is not None:
        reading = _given(given)
    elif path is not None:
        reading = _along(path)
    elif placed is not None and grounding.source == "request":
        reading = MotionReading("place", None, "request")
    else:
        reading, source = run.reader.read_motion(run.reader_input("motion"), grounding, hints), run.reader.source
        if run.request.motion is not None:
            reading = _with_lengths(reading, run.request.motion)
    if placed is not None and reading.kind == "place":
        reading = replace(reading, sentence=reading.sentence or placing_sentence(grounding, placed))
    if run.request.motion is not None and run.request.motion.others:
        reading = replace(reading, others=given_others(run.request.motion.others, grounding))
    if placed is not None and reading.kind == "place":
        reading = replace(reading, sentence=reading.sentence or placing_sentence(grounding, placed))
    reading, unused = _fitting(reading)
    motion = _complete(run.scene.width, grounding, reading, source, run.request.law)
    if motion.cue == "trail":
        with run.cpu():
            run.place_mover(grounding.bbox, motion.cue)
            motion = along_trail(run.scene, grounding, motion, run.request.camera, reading.speed is not None)
    return StageResult(value=motion, warnings=(*reading.warnings, *unused, *_assumed(motion, reading)))


def _given(motion: MotionRequest) -> MotionReading:
    reading = MotionReading(
        motion.stated_kind or "linear",
        motion.direction,
        "request",
        depth=motion.depth,
        depth_deviation=motion.depth_deviation or 0.0,
    )
    return _with_lengths(reading, motion)


def _with_lengths(reading: MotionReading, given: MotionRequest) -> MotionReading:
    """The reading with what a request says of speed, length and scale."""
    said: dict[str, Any] = {
        "speed": None if given.speed is None else Quantity(given.speed, "px/s"),
        "speed_deviation": given.speed_deviation,
        "distance": None if given.distance is None else Quantity(given.distance, "px"),
        "duration": given.duration,
        "until": given.until,
        "steps": tuple(step_reading(step) for step in given.steps),
        "metres_per_pixel": None
        if given.metres_per_pixel is None
        else MetresPerPixel(value=given.metres_per_pixel, source="request"),
    }
    return replace(reading, **{name: value for name, value in said.items() if value not in (None, ())})


def _fitting(reading: MotionReading) -> tuple[MotionReading, tuple[str, ...]]:
    """The reading without lengths that its kind of motion cannot have, and a warning for them."""
    unused = [name for name in _GLIDING_ONLY if getattr(reading, name) not in (None, ())]
    if reading.kind == "linear" or not unused:
        return reading, ()
    cleared = replace(reading, distance=None, duration=None, until=None, steps=())
    return cleared, (f"The {' and '.join(unused)} of the motion was not used: a {reading.kind} ends by what it meets.",)


def _complete(image_width: int, grounding: Grounding, reading: MotionReading, source: Source, law: Law) -> Motion:
    """Adds what a reading leaves open: scale, speed, deviations, gravity and the sentence."""
    scale = reading.metres_per_pixel or MetresPerPixel(
        value=DEFAULT_SCENE_WIDTH / image_width,
        source="default",
        note=f"the image is taken to be {DEFAULT_SCENE_WIDTH:g} m wide at the object",
    )
    measures = Measures(image_width, scale, law)
    moves = reading.kind in DIRECTED_KINDS
    direction = unit(reading.direction) if moves and reading.direction is not None else None
    depth = reading.depth if moves else 0.0
    return Motion(
        kind=reading.kind,
        law=law,
        direction=direction,
        depth=depth,
        depth_deviation=_depth_deviation(reading),
        cue=reading.cue,
        along_arrow=reading.along_arrow,
        speed=measures.speed(reading.kind, grounding.bbox, reading.speed),
        speed_deviation=_speed_deviation(measures, reading),
        distance=None if reading.distance is None else measures.pixels(reading.distance),
        duration=reading.duration,
        until=reading.until,
        steps=tuple(step_of(step, measures) for step in reading.steps),
        trail=reading.trail,
        others=tuple(also_moving(other, measures) for other in reading.others),
        gravity=_gravity(reading.down, scale) if reading.kind in FALLING_KINDS else (0.0, 0.0),
        down=reading.down,
        metres_per_pixel=scale,
        sentence=_sentence(grounding, reading, direction, depth),
        source=source,
    )


def _sentence(grounding: Grounding, reading: MotionReading, direction: Vector | None, depth: float) -> str:
    """The whole motion in words."""
    return motion_sentence(
        grounding.object,
        reading.kind,
        direction,
        depth,
        reading.sentence,
        further=[direction_words(step.direction, step.depth) for step in reading.steps],
        stops=any(value is not None for value in (reading.distance, reading.duration, reading.until)),
        also=[other_words(other) for other in reading.others],
    )


def _depth_deviation(reading: MotionReading) -> float:
    """Degrees."""
    if reading.depth_deviation is not None and reading.kind in DIRECTED_KINDS:
        return reading.depth_deviation
    return THROW_DEPTH_DEVIATION if reading.kind == "projectile" else 0.0


def _speed_deviation(measures: Measures, reading: MotionReading) -> float:
    """Of the speed's natural logarithm."""
    if reading.kind not in DIRECTED_KINDS:
        return 0.0
    if reading.speed_deviation is not None:
        return reading.speed_deviation
    return measures.speed_deviation(reading.kind, reading.speed)


def _gravity(down: Vector, scale: MetresPerPixel) -> Vector:
    """px/s^2."""
    strength = GRAVITY / scale.value
    return down[0] * strength, down[1] * strength


def _assumed(motion: Motion, reading: MotionReading) -> tuple[str, ...]:
    """Warnings for what nobody said: how fast a throw is, and the scale of lengths in metres."""
    told: list[str] = []
    if motion.kind == "projectile" and not isinstance(reading.speed, Quantity) and not motion.trail:
        told.append(
            f"How far a throw reaches depends on its speed: {motion.speed:.0f} px/s was assumed; "
            "`motion.speed` sets it."
        )
    lengths = [each for each in (reading.speed, reading.distance) if isinstance(each, Quantity)]
    if motion.metres_per_pixel.source == "default" and any(each.unit in ("m", "m/s") for each in lengths):
        told.append(
            f"Lengths in metres were taken at {motion.metres_per_pixel.value:.4f} m per pixel, which was assumed; "
            "`motion.metres_per_pixel` sets it."
        )
    return tuple(told)


def _along(path: TrajectoryRequest) -> MotionReading:
    """The motion that a given path amounts to: from its first point towards its last, at its mean speed (px/s)."""
    (x0, y0), (x1, y1) = path.points[0], path.points[-1]
    way = sum(math.dist(a, b) for a, b in zip(path.points, path.points[1:], strict=False))
    if way < 1e-6:
        return MotionReading("static", None, "request")
    direction = (x1 - x0, y1 - y0) if math.hypot(x1 - x0, y1 - y0) > 1e-6 else _first_step(path)
    speed = Quantity(way * path.fps / (len(path.points) - 1), "px/s")
    return MotionReading("linear", direction, "request", speed=speed)


def _first_step(path: TrajectoryRequest) -> Vector:
    """The first move of a path that ends where it began."""
    x0, y0 = path.points[0]
    return next((x - x0, y - y0) for x, y in path.points if math.hypot(x - x0, y - y0) > 1e-6)
