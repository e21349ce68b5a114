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
    MetresPerPixel,
    Motion,
    MotionKind,
    MotionStep,
    Source,
    Vector,
)
from cow_service.requests import CameraRequest, MotionRequest, OtherMotionRequest, SimulateRequest, TrajectoryRequest
from cow_service.stages.grounding import placed_mover
from cow_service.stages.keys import StageResult
from cow_service.stages.reconstruction import camera_of
from cow_service.stages.run import Run
from cow_service.vision.scene import Scene
from cow_service.vision.trails import trail_of

THROW_SPEED, THROW_RADIUS = 1.8, 0.15  # m/s, m: of a toy that is thrown, where no speed is given
THROW_DEPTH_DEVIATION = 15.0  # degrees: words and arrows tell a throw's heading in the image alone
SPEED_DEVIATIONS: dict[MotionKind, float] = {"linear": 0.25, "projectile": 0.28}  # of the logarithm of a default speed
SPEED_FACTORS: dict[SpeedWord, float] = {"slow": 0.5, "normal": 1.0, "fast": 2.0}  # of the default speed
SCALE_DEVIATION = 0.25  # of the logarithm of metres per pixel, where nobody gave them
_OF_A_LINE = ("distance", "duration", "until", "steps")  # what only a motion along a line can have


def read_motion(run: Run[SimulateRequest], grounding: Grounding, hints: MotionHints | None) -> StageResult[Motion]:
    """The motion, from the request where it gives one or a whole path, else from the reader, which gave the `hints`.

    What the request says of speed and length goes before what the reader says. Raises what the reader raises, and
    `InvalidRequest` for a second mover that is none of the `objects`.
    """
    request = run.request
    reading = _given_motion(request, grounding)
    source: Source = "request"
    if reading is None:
        with run.cpu():
            given = run.reader_input("motion", run.scene_of(grounding, None if hints is None else hints.cue))
        reading, source = run.reader.read_motion(given, grounding, hints), run.reader.source
    reading, unused = _fitting(_with_request(reading, request.motion, grounding))
    motion = _complete(run.image.info.width, grounding, reading, source, request.law)
    if motion.cue == "trail":
        with run.cpu():
            scene = run.scene_of(grounding, motion.cue)
            motion = along_trail(scene, grounding, motion, request.camera, reading.speed is not None)
    return StageResult(value=motion, warnings=(*reading.warnings, *unused, *_assumed(motion, reading)))


# --- what the request and the reader say


def _given_motion(request: SimulateRequest, grounding: Grounding) -> MotionReading | None:
    """What the request says of the motion; None where it leaves that to the reader."""
    given = request.stated_motion
    if given is not None:
        return MotionReading(
            given.stated_kind or "linear",
            given.direction,
            "request",
            depth=given.depth,
            depth_deviation=given.depth_deviation or 0.0,
        )
    if request.trajectory is not None:
        return _along(request.trajectory)
    if grounding.source == "request" and placed_mover(grounding) is not None:
        return MotionReading("place", None, "request")
    return None


def _along(path: TrajectoryRequest) -> MotionReading:
    """The motion that a given path amounts to: from its first point towards its last, at its mean speed (px/s)."""
    (x0, y0), last = path.points[0], path.points[-1]
    way = sum(math.dist(a, b) for a, b in zip(path.points, path.points[1:], strict=False))
    if way < 1e-6:
        return MotionReading("static", None, "request")
    # The first move of a path that ends where it began.
    x, y = next(point for point in (last, *path.points) if math.dist(point, (x0, y0)) > 1e-6)
    speed = Quantity(way * path.fps / (len(path.points) - 1), "px/s")
    return MotionReading("linear", (x - x0, y - y0), "request", speed=speed)


def _with_request(reading: MotionReading, given: MotionRequest | None, grounding: Grounding) -> MotionReading:
    """The reading with what a request says of speed, length, scale and other movers."""
    said: dict[str, Any] = {}
    if given is not None:
        scale = given.metres_per_pixel
        said = {
            "speed": None if given.speed is None else Quantity(given.speed, "px/s"),
            "speed_deviation": given.speed_deviation,
            "distance": None if given.distance is None else Quantity(given.distance, "px"),
            "duration": given.duration,
            "until": given.until,
            "steps": tuple(
                StepReading(
                    step.direction,
                    step.depth,
                    None if step.distance is None else Quantity(step.distance, "px"),
                    step.duration,
                )
                for step in given.steps
            ),
            "metres_per_pixel": None if scale is None else MetresPerPixel(value=scale, source="request"),
            "others": tuple(_given_other(index, each, grounding) for index, each in enumerate(given.others)),
        }
    placed = placed_mover(grounding)
    if placed is not None and reading.kind == "place" and not reading.sentence:
        said["sentence"] = f"The {bare_name(grounding.object)} is lifted, carried over and put {place_words(placed)}"
    return replace(reading, **{name: value for name, value in said.items() if value not in (None, ())})


def _given_other(index: int, given: OtherMotionRequest, grounding: Grounding) -> OtherMotionReading:
    """Raises `InvalidRequest` for another mover that was not located."""
    found = [other for other in grounding.others if same_name(other.object, given.object)]
    if len(found) != 1:
        seen = ", ".join(f"'{other.object}'" for other in grounding.others) or "none"
        detail = f"'{given.object}' names {len(found)} of the located objects ({seen})"
        raise InvalidRequest(
            f"`motion.others.{index}.object`: {detail}: give it in `objects` under this name.",
            errors=(FieldError(f"/motion/others/{index}/object", detail),),
        )
    speed = None if given.speed is None else Quantity(given.speed, "px/s")
    return OtherMotionReading(found[0], given.stated_kind, given.direction, given.depth, speed)


def _fitting(reading: MotionReading) -> tuple[MotionReading, tuple[str, ...]]:
    """The reading without lengths that its kind of motion cannot have, and a warning for them."""
    unused = [name for name in _OF_A_LINE if getattr(reading, name) not in (None, ())]
    if reading.kind == "linear" or not unused:
        return reading, ()
    cleared = replace(reading, distance=None, duration=None, until=None, steps=())
    return cleared, (f"The {' and '.join(unused)} of the motion was not used: a {reading.kind} ends by what it meets.",)


# --- in pixels and seconds


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
        return SCALE_DEVIATION if said.unit == "m/s" and self.scale.source == "default" else 0.0


def throw_speed(bbox: BBox, scale: MetresPerPixel) -> float:
    """px/s of a throw whose speed nobody gave: v^2 / (g R) as of a toy of radius 0.15 m thrown at 1.8 m/s.

    How far it gets in the image, in its own radii, does then not depend on the scale, which is uncertain.
    """
    return math.sqrt(THROW_SPEED**2 / (GRAVITY * THROW_RADIUS) * (GRAVITY / scale.value) * _radius(bbox))


def _radius(bbox: BBox) -> float:
    x0, y0, x1, y1 = bbox
    return (x1 - x0 + y1 - y0) / 4  # px


def _unit(vector: Vector) -> Vector:
    length = math.hypot(*vector)
    return vector[0] / length, vector[1] / length


def _complete(image_width: int, grounding: Grounding, reading: MotionReading, source: Source, law: Law) -> Motion:
    """Adds what a reading leaves open: scale, speed, deviations, gravity and the sentence."""
    scale = reading.metres_per_pixel or MetresPerPixel(
        value=DEFAULT_SCENE_WIDTH / image_width,
        source="default",
        note=f"the image is taken to be {DEFAULT_SCENE_WIDTH:g} m wide at the object",
    )
    measures = Measures(image_width, scale, law)
    moves, falls = reading.kind in DIRECTED_KINDS, reading.kind in FALLING_KINDS
    direction = _unit(reading.direction) if moves and reading.direction is not None else None
    depth = reading.depth if moves else 0.0
    depth_deviation = THROW_DEPTH_DEVIATION if reading.kind == "projectile" else 0.0
    speed_deviation = measures.speed_deviation(reading.kind, reading.speed) if moves else 0.0
    if moves and reading.depth_deviation is not None:
        depth_deviation = reading.depth_deviation
    if moves and reading.speed_deviation is not None:
        speed_deviation = reading.speed_deviation
    steps = tuple(
        MotionStep(
            direction=_unit(step.direction),
            depth=step.depth,
            distance=None if step.distance is None else measures.pixels(step.distance),
            duration=step.duration,
        )
        for step in reading.steps
    )
    gravity = GRAVITY / scale.value  # px/s^2
    return Motion(
        kind=reading.kind,
        law=law,
        direction=direction,
        depth=depth,
        depth_deviation=depth_deviation,
        cue=reading.cue,
        along_arrow=reading.along_arrow,
        speed=measures.speed(reading.kind, grounding.bbox, reading.speed),
        speed_deviation=speed_deviation,
        distance=None if reading.distance is None else measures.pixels(reading.distance),
        duration=reading.duration,
        until=reading.until,
        steps=steps,
        trail=reading.trail,
        others=tuple(_also_moving(other, measures) for other in reading.others),
        gravity=(reading.down[0] * gravity, reading.down[1] * gravity) if falls else (0.0, 0.0),
        down=reading.down,
        metres_per_pixel=scale,
        sentence=motion_sentence(
            grounding.object,
            reading.kind,
            direction,
            depth,
            reading.sentence,
            further=[direction_words(step.direction, step.depth) for step in reading.steps],
            stops=any(value is not None for value in (reading.distance, reading.duration, reading.until)),
            also=[_other_words(other) for other in reading.others],
        ),
        source=source,
    )


def _also_moving(other: OtherMotionReading, measures: Measures) -> AlsoMoving:
    moves = other.kind in DIRECTED_KINDS
    return AlsoMoving(
        object=other.object,
        kind=other.kind,
        direction=_unit(other.direction) if moves and other.direction is not None else None,
        depth=other.depth if moves else 0.0,
        speed=measures.speed(other.kind, other.object.bbox, other.speed),
        speed_deviation=measures.speed_deviation(other.kind, other.speed),
    )


def along_trail(
    scene: Scene, grounding: Grounding, motion: Motion, camera: CameraRequest | None, speed_given: bool
) -> Motion:
    """A motion read from a trail, with speed, direction and depth as the trail at the mover measures them."""
    trail = trail_of(scene.trails, grounding.bbox)
    if trail is None:
        return motion
    measured: dict[str, object] = {"trail": tuple(position.centre for position in trail.older)}
    if motion.kind == "linear":
        measured["direction"] = straight_direction(trail.positions)
    throw = None
    if motion.kind == "projectile":
        fit = camera_of(scene, motion, camera, grounding.bbox, fixed_focal=False)
        throw = fit_throw(trail.positions, fit, (scene.width, scene.height))
    if throw is not None:
        measured["direction"] = throw.direction
        measured["depth"] = math.sin(math.radians(throw.turn))
        measured["depth_deviation"] = min(throw.turn_deviation, 90.0)
    if throw is not None and not speed_given:
        square = throw.froude * GRAVITY * _radius(grounding.bbox) / motion.metres_per_pixel.value
        measured |= {"speed": math.sqrt(square), "speed_deviation": min(throw.speed_deviation, 3.0)}
    return motion.model_copy(update=measured)


# --- in words


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
    text = load_prompt("motion-sentence").render(
        object=bare_name(object),
        kind=kind,
        words=direction_words(direction, depth),
        sentence="" if sentence is None else sentence.strip().rstrip(".") + ".",
        further=further,
        stops=stops,
        also=also,
    )
    return " ".join(text.split())


def _other_words(other: OtherMotionReading) -> str:
    """What another mover does, such as "car moves to the left"."""
    verb = {"projectile": "is thrown", "fall": "falls", "static": "stays where it is"}.get(other.kind, "moves")
    way = "" if other.kind in ("fall", "static") else direction_words(other.direction, other.depth)
    return " ".join([bare_name(other.object.object), verb, way]).rstrip()


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
