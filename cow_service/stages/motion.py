"""Stage 2: how the object moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from cow_service.errors import FieldError, InvalidRequest
from cow_service.narration import bare_name, direction_words, place_words, same_name
from cow_service.physics.ballistic import DEFAULT_SCENE_WIDTH, DEFAULT_SPEED, GRAVITY
from cow_service.physics.trail_fit import fit_throw, straight_direction
from cow_service.readers.base import MotionHints, MotionReading, OtherMotionReading, Quantity, SpeedWord, StepReading
from cow_service.readers.prompts import load_prompt
from cow_service.records import (
    DIRECTED_KINDS,
    FALLING_KINDS,
    AlsoMoving,
    BBox,
    Grounding,
    Law,
    LocatedObject,
    MetresPerPixel,
    Motion,
    MotionKind,
    MotionStep,
    Source,
    Vector,
)
from cow_service.requests import (
    CameraRequest,
    MotionRequest,
    MotionStepRequest,
    OtherMotionRequest,
    SimulateRequest,
    TrajectoryRequest,
)
from cow_service.stages.grounding import placed_mover
from cow_service.stages.keys import StageResult
from cow_service.stages.reconstruction import camera_of
from cow_service.stages.run import Run
from cow_service.vision.scene import Scene
from cow_service.vision.trails import Trail, trail_of

THROW_SPEED, THROW_RADIUS = 1.8, 0.15  # m/s, m: of a toy that is thrown, where no speed is given
SPEED_DEVIATIONS: dict[MotionKind, float] = {"linear": 0.25, "projectile": 0.28}  # of the logarithm of a default speed
SPEED_FACTORS: dict[SpeedWord, float] = {"slow": 0.5, "normal": 1.0, "fast": 2.0}  # of the default speed
SCALE_DEVIATION = 0.25  # of the logarithm of metres per pixel, where nobody gave them


@dataclass(frozen=True)
class Measures:
    """What turns numbers with units into pixels."""

    image_width: int  # px
    scale: MetresPerPixel
    law: Law

    def pixels(self, quantity: Quantity) -> float:
        """px, or px/s."""
        match quantity.unit:
            case "px" | "px/s":
                return quantity.value
            case "m" | "m/s":
                return quantity.value / self.scale.value
            case "widths" | "widths/s":
                return quantity.value * self.image_width

    def speed(self, kind: MotionKind, bbox: BBox, said: SpeedWord | Quantity | None) -> float:
        """px/s of an object in a box; 0 for kinds of motion that have no speed."""
        if kind not in DIRECTED_KINDS:
            return 0.0
        if isinstance(said, Quantity):
            return self.pixels(said)
        thrown = kind == "projectile" and self.law == "contact"
        usual = throw_speed(bbox, self.scale) if thrown else DEFAULT_SPEED * self.image_width
        return usual if said is None else SPEED_FACTORS[said] * usual

    def speed_deviation(self, kind: MotionKind, said: SpeedWord | Quantity | None) -> float:
        """Of the speed's natural logarithm: 0 for a number in pixels, else that of what is assumed."""
        if not isinstance(said, Quantity):
            return SPEED_DEVIATIONS.get(kind, 0.0)
        assumed = said.unit == "m/s" and self.scale.source == "default"
        return SCALE_DEVIATION if assumed else 0.0


def throw_speed(bbox: BBox, scale: MetresPerPixel) -> float:
    """px/s of a throw whose speed nobody gave: v^2 / (g R) as of a toy of radius 0.15 m thrown at 1.8 m/s.

    How far it gets in the image, in its own radii, does then not depend on the scale, which is uncertain.
    """
    x0, y0, x1, y1 = bbox
    radius = (x1 - x0 + y1 - y0) / 4  # px
    return math.sqrt(THROW_SPEED**2 / (GRAVITY * THROW_RADIUS) * (GRAVITY / scale.value) * radius)


def unit(vector: Vector) -> Vector:
    """A vector of length 1."""
    length = math.hypot(*vector)
    return vector[0] / length, vector[1] / length


def step_reading(step: MotionStepRequest) -> StepReading:
    """A leg that a request gives."""
    distance = None if step.distance is None else Quantity(step.distance, "px")
    return StepReading(step.direction, step.depth, distance, step.duration)


def step_of(step: StepReading, measures: Measures) -> MotionStep:
    """A leg in pixels."""
    distance = None if step.distance is None else measures.pixels(step.distance)
    return MotionStep(direction=unit(step.direction), depth=step.depth, distance=distance, duration=step.duration)


def given_others(given: Sequence[OtherMotionRequest], grounding: Grounding) -> tuple[OtherMotionReading, ...]:
    """Other movers of a request. Raises `InvalidRequest` for one that was not located."""
    return tuple(_given_other(index, each, grounding) for index, each in enumerate(given))


def _given_other(index: int, given: OtherMotionRequest, grounding: Grounding) -> OtherMotionReading:
    speed = None if given.speed is None else Quantity(given.speed, "px/s")
    located = _located(index, given.object, grounding)
    return OtherMotionReading(located, given.stated_kind, given.direction, given.depth, speed)


def _located(index: int, name: str, grounding: Grounding) -> LocatedObject:
    found = [other for other in grounding.others if same_name(other.object, name)]
    if len(found) != 1:
        seen = ", ".join(f"'{other.object}'" for other in grounding.others) or "none"
        detail = f"'{name}' names {len(found)} of the located objects ({seen})"
        raise InvalidRequest(
            f"`motion.others.{index}.object`: {detail}: give it in `objects` under this name.",
            errors=(FieldError(f"/motion/others/{index}/object", detail),),
        )
    return found[0]


def also_moving(other: OtherMotionReading, measures: Measures) -> AlsoMoving:
    """Another mover in pixels."""
    moves = other.kind in DIRECTED_KINDS
    return AlsoMoving(
        object=other.object,
        kind=other.kind,
        direction=unit(other.direction) if moves and other.direction is not None else None,
        depth=other.depth if moves else 0.0,
        speed=measures.speed(other.kind, other.object.bbox, other.speed),
        speed_deviation=measures.speed_deviation(other.kind, other.speed),
    )


def other_words(other: OtherMotionReading) -> str:
    """What another mover does, such as "car moves to the left"."""
    verb = {"projectile": "is thrown", "fall": "falls", "static": "stays where it is"}.get(other.kind, "moves")
    way = "" if other.kind in ("fall", "static") else direction_words(other.direction, other.depth)
    return " ".join([bare_name(other.object.object), verb, way]).rstrip()


def along_trail(
    scene: Scene, grounding: Grounding, motion: Motion, camera: CameraRequest | None, speed_given: bool
) -> Motion:
    """A motion read from a trail, with what the trail at the mover measures; others unchanged."""
    trail = trail_of(scene.trails, grounding.bbox) if motion.cue == "trail" else None
    if trail is None:
        return motion
    motion = motion.model_copy(update={"trail": tuple(position.centre for position in trail.older)})
    if motion.kind == "projectile":
        return _thrown(scene, grounding, motion, trail, camera, speed_given)
    if motion.kind == "linear":
        return motion.model_copy(update={"direction": straight_direction(trail.positions)})
    return motion


def _thrown(
    scene: Scene, grounding: Grounding, motion: Motion, trail: Trail, camera: CameraRequest | None, speed_given: bool
) -> Motion:
    """Speed, direction and depth of the throw at the present position, with their deviations."""
    fit = camera_of(scene, motion, camera, grounding.bbox, fixed_focal=False)
    throw = fit_throw(trail.positions, fit, (scene.width, scene.height))
    if throw is None:
        return motion
    measured: dict[str, object] = {
        "direction": throw.direction,
        "depth": math.sin(math.radians(throw.turn)),
        "depth_deviation": min(throw.turn_deviation, 90.0),
    }
    if not speed_given:
        x0, y0, x1, y1 = grounding.bbox
        radius = (x1 - x0 + y1 - y0) / 4  # px
        measured["speed"] = math.sqrt(throw.froude * GRAVITY * radius / motion.metres_per_pixel.value)
        measured["speed_deviation"] = min(throw.speed_deviation, 3.0)
    return motion.model_copy(update=measured)


THROW_DEPTH_DEVIATION = 15.0  # degrees: words and arrows tell a throw's heading in the image alone
_GLIDING_ONLY = ("distance", "duration", "until", "steps")  # what only a motion along a line can have


def motion_sentence(
    object: str,
    kind: MotionKind,
    direction: Vector | None,
    depth: float,
    sentence: str | None = None,
    further: Sequence[str] = (),
    stops: bool = False,
    also: Sequence[str] = (),
) -> str:
    """The motion in one line: a declarative `sentence` of a reader, or one made here; and that the camera stays.

    `further` are the directions of more legs in words, `also` what else moves, such as "car moves to the left".
    """
    prompt = load_prompt("motion-sentence")
    text = prompt.render(
        object=bare_name(object),
        kind=kind,
        words=direction_words(direction, depth),
        sentence="" if sentence is None else sentence.strip().rstrip(".") + ".",
        further=further,
        stops=stops,
        also=also,
    )
    return " ".join(text.split())


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
        with run.cpu():
            given_reader = run.reader_input("motion", run.scene_of(grounding, None if hints is None else hints.cue))
        reading, source = run.reader.read_motion(given_reader, grounding, hints), run.reader.source
        if run.request.motion is not None:
            reading = _with_lengths(reading, run.request.motion)
    if placed is not None and reading.kind == "place":
        reading = replace(
            reading,
            sentence=reading.sentence
            or f"The {bare_name(grounding.object)} is lifted, carried over and put {place_words(placed)}",
        )
    if run.request.motion is not None and run.request.motion.others:
        reading = replace(reading, others=given_others(run.request.motion.others, grounding))
    reading, unused = _fitting(reading)
    motion = _complete(run.image.info.width, grounding, reading, source, run.request.law)
    if motion.cue == "trail":
        with run.cpu():
            scene = run.scene_of(grounding, motion.cue)
            motion = along_trail(scene, grounding, motion, run.request.camera, reading.speed is not None)
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
