"""Stage 2: how the object moves."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np

from cow_service import records
from cow_service.errors import CannotReadDirection, FieldError, InvalidRequest, MllmBadReply, MllmUnavailable, field_of
from cow_service.narration.words import bare_name, direction_words, place_words, same_name
from cow_service.perception.facing import facing
from cow_service.physics.ballistic import DEFAULT_SCENE_WIDTH, DEFAULT_SPEED, GRAVITY
from cow_service.physics.camera import FloorCamera, depth_motion, fit_shadow, given_camera
from cow_service.physics.lift import DIRECTION_DEVIATIONS
from cow_service.physics.trail_fit import fit_throw, straight_direction
from cow_service.readers.base import MotionHints, MotionReading, OtherMotionReading, Quantity, SpeedWord, StepReading
from cow_service.readers.prompts import load_prompt
from cow_service.readers.remedies import GIVE_DIRECTION
from cow_service.records import BBox, Grounding, Law, LocatedObject, Motion, MotionKind, Source, Vector
from cow_service.requests import MotionRequest, SimulateRequest
from cow_service.stages.grounding import placed_mover
from cow_service.stages.keys import StageResult
from cow_service.stages.run import Run
from cow_service.stages.settling import SeenWay, settle_way
from cow_service.vision.scene import Scene
from cow_service.vision.shadows import find_shadow
from cow_service.vision.trails import trail_of

THROW_SPEED, THROW_RADIUS = 1.8, 0.15  # m/s, m: of a toy that is thrown, where no speed is given
THROW_DEPTH_DEVIATION = 20.0  # degrees: words and arrows tell a throw's heading in the image alone
SPEED_DEVIATIONS: dict[MotionKind, float] = {"linear": 0.25, "projectile": 0.28}  # of the logarithm of a default speed
SPEED_FACTORS: dict[SpeedWord, float] = {"slow": 0.5, "normal": 1.0, "fast": 2.0}  # of the default speed
SCALE_DEVIATION = 0.25  # of the logarithm of metres per pixel, where nobody gave them
ELSEWHERE_SIGMA = 0.3  # of the logarithm of a scale that is told by the size of what stands elsewhere
LEAST_SIZE_SIGMA = 0.05
MOST_APART = 2.0  # factor between two scales from which they disagree
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
            seen = _way_seen(run, given.scene, grounding)
        way, source = run.question.way, run.reader.source
        reading, objections = settle_way(run.reader.read_motion(given, grounding, hints), way, seen, grounding.bbox)
        if objections:
            with suppress(CannotReadDirection, MllmBadReply, MllmUnavailable):
                again = run.reader.read_motion(replace(given, objections=objections), grounding, hints)
                reading, objections = settle_way(again, way, seen, grounding.bbox)
        reading = replace(reading, warnings=(*reading.warnings, *objections))
        if reading.direction is None and reading.kind in records.DIRECTED_KINDS:
            raise CannotReadDirection(
                f"Neither the image nor the question tells which way the {grounding.object} moves.",
                remedy=GIVE_DIRECTION,
            )
    if request.motion is not None:
        reading = _with_request(reading, request.motion, grounding)
    placed = placed_mover(grounding)
    if placed is not None and reading.kind == "place" and not reading.sentence:
        sentence = f"The {bare_name(grounding.object)} is lifted, carried over and put {place_words(placed)}"
        reading = replace(reading, sentence=sentence)
    warnings = list(reading.warnings)
    unused = [name for name in _OF_A_LINE if getattr(reading, name) not in (None, ())]
    if reading.kind != "linear" and unused:
        reading = replace(reading, distance=None, duration=None, until=None, steps=())
        ends = f"a {reading.kind} ends where it hits something"
        warnings.append(f"The {' and '.join(unused)} of the motion was not used: {ends}.")
    scale, doubts = scale_of(run, grounding, reading)
    reading = replace(reading, metres_per_pixel=scale)
    warnings += doubts
    if _is_up_the_floor(reading, grounding, request.law):
        warnings.append(
            f"'Up' was read as along the floor, away from the camera. If the {bare_name(grounding.object)} leaves "
            "the floor, say that it is lifted or thrown, or give `motion.rises`."
        )
        reading = replace(reading, depth=depth_motion(1.0)[1])
    motion = _complete(run.image.info.width, grounding, reading, source, request.law)
    if motion.cue == "trail":
        with run.cpu():
            scene = run.scene_of(grounding, motion.cue)
            motion = along_trail(scene, grounding, motion, run, reading.speed is not None)
    # What nobody said: how fast a throw is, and the scale of lengths in metres.
    if motion.kind == "projectile" and not isinstance(reading.speed, Quantity) and not motion.trail:
        warnings.append(
            f"How far a throw goes depends on its speed: {motion.speed:.0f} px/s was assumed; `motion.speed` sets it."
        )
    lengths = [each for each in (reading.speed, reading.distance) if isinstance(each, Quantity)]
    if motion.metres_per_pixel.source == "default" and any(each.unit in ("m", "m/s") for each in lengths):
        warnings.append(
            f"Lengths in metres were taken at {motion.metres_per_pixel.value:.4f} m per pixel, which was assumed; "
            "`motion.metres_per_pixel` sets it."
        )
    return StageResult(value=motion, warnings=tuple(warnings))


def _way_seen(run: Run[SimulateRequest], scene: Scene, grounding: Grounding) -> SeenWay:
    """What the image shows of the way of the mover. To be called with `cpu` held."""
    way, words = run.question.way, run.backends.words()
    arrow, front = scene.arrow_at(grounding.bbox), None
    if way.forward is not None and grounding.prior is not None and grounding.prior.elongated:
        front = facing(scene.clean, scene.silhouette(grounding.bbox), grounding.bbox)
    goals = [each for each in grounding.others if way.towards and words.likeness(way.towards, each.object) == "same"]
    has_trail = trail_of(scene.trails, grounding.bbox) is not None
    return SeenWay(None if arrow is None else arrow.direction, goals[0] if len(goals) == 1 else None, front, has_trail)


# --- what the request says


def _given_motion(request: SimulateRequest, grounding: Grounding) -> MotionReading | None:
    """What the request says of the motion; None where it leaves that to the reader.

    A given path amounts to a motion from its first point towards its last, at its mean speed (px/s).
    """
    given, path = request.stated_motion, request.trajectory
    if given is not None:
        # A direction in the image leaves open how far a throw leads into its depth.
        is_open = given.stated_kind == "projectile" and "depth" not in given.model_fields_set
        deviation = given.depth_deviation if given.depth_deviation is not None or is_open else 0.0
        return MotionReading(
            given.stated_kind or "linear", given.direction, "request", depth=given.depth, depth_deviation=deviation
        )
    if path is not None:
        (x0, y0), last = path.points[0], path.points[-1]
        way = sum(math.dist(a, b) for a, b in pairwise(path.points))
        if way < 1e-6:
            return MotionReading("static", None, "request")
        # The first move of a path that ends where it began.
        x, y = next(point for point in (last, *path.points) if math.dist(point, (x0, y0)) > 1e-6)
        speed = Quantity(way * path.fps / (len(path.points) - 1), "px/s")
        return MotionReading("linear", (x - x0, y - y0), "request", speed=speed)
    if grounding.source == "request" and placed_mover(grounding) is not None:
        return MotionReading("place", None, "request")
    return None


def _with_request(reading: MotionReading, given: MotionRequest, grounding: Grounding) -> MotionReading:
    """The reading with what a request says of speed, length, scale and other movers.

    Raises `InvalidRequest` for another mover that was not located.
    """
    others: list[OtherMotionReading] = []
    for index, each in enumerate(given.others):
        found = [other for other in grounding.others if same_name(other.object, each.object)]
        if len(found) != 1:
            seen = ", ".join(f"'{other.object}'" for other in grounding.others) or "none"
            pointer = f"/motion/others/{index}/object"
            detail = f"'{each.object}' matches {len(found)} of the located objects ({seen})"
            raise InvalidRequest(
                f"`{field_of(pointer)}`: {detail}: give it in `objects` under this name.",
                errors=(FieldError(pointer, detail),),
            )
        speed = _quantity(each.speed, "px/s")
        others.append(OtherMotionReading(found[0], each.stated_kind, each.direction, None, each.depth, speed))
    scale = given.metres_per_pixel
    said = {
        "speed": _quantity(given.speed, "px/s"),
        "speed_deviation": given.speed_deviation,
        "distance": _quantity(given.distance, "px"),
        "duration": given.duration,
        "until": given.until,
        "rises": given.rises or None,
        "steps": tuple(
            StepReading(step.direction, step.depth, _quantity(step.distance, "px"), step.duration)
            for step in given.steps
        ),
        "metres_per_pixel": None if scale is None else records.MetresPerPixel(value=scale, source="request"),
        "others": tuple(others),
    }
    return replace(reading, **{name: value for name, value in said.items() if value not in (None, ())})


def _quantity(value: float | None, unit: Literal["px", "px/s"]) -> Quantity | None:
    return None if value is None else Quantity(value, unit)


def scale_of(
    run: Run[SimulateRequest], grounding: Grounding, reading: MotionReading
) -> tuple[records.MetresPerPixel | None, list[str]]:
    """Metres per pixel at the mover, and doubts: by a depth map in metres, else as given, else by sizes that are given,
    else as read of it or others.

    What stands elsewhere on the floor is nearer or farther, by the camera as far as it is known. None where nobody
    says anything of it.
    """
    given = reading.metres_per_pixel
    told = {} if given is None else {"metres_per_pixel": given.value}
    things = [LocatedObject(object=grounding.object, bbox=grounding.bbox, prior=grounding.prior), *grounding.others]
    width, height = run.image.info.width, run.image.info.height
    fit, depth_map = given_camera((width, height), reading.down, run.request.camera, run.focal), run.depth
    mapped = None
    if depth_map is not None and run.request.law == "contact" and run.request.trajectory is None:
        mapped = depth_map.metres_per_pixel(grounding.bbox, math.exp(fit.mean[1]) * width)
    if mapped is not None:
        told["the depth map, which is taken"] = mapped
    camera = FloorCamera(width, height, math.exp(fit.mean[1]) * width, float(fit.mean[0]), fit.roll, 1.0)
    depths = camera.floor_points(np.array([((x0 + x1) / 2, y1) for x0, _, x1, y1 in (each.bbox for each in things)]))
    sizes: list[tuple[float, float, bool]] = []  # log of the metres per pixel at the mover, deviation, taken as exact
    for each, depth in zip(things, depths[:, 2] / depths[0, 2], strict=True):
        size = None if each.prior is None else each.prior.size
        if size is None or not size.value > 0:
            continue
        in_air = reading.kind in records.FALLING_KINDS or (each.prior is not None and each.prior.stands_on == "air")
        nearer = 1.0 if in_air or not math.isfinite(depth) else float(depth)
        x0, y0, x1, y1 = each.bbox
        value = size.value / max(x1 - x0, y1 - y0) / nearer
        elsewhere = 0.0 if each is things[0] else ELSEWHERE_SIGMA
        sizes.append((math.log(value), size.deviation / size.value + elsewhere, size.deviation == 0))
        told[f"the size of '{each.object}'"] = value
    doubts: list[str] = []
    if told and max(told.values()) > MOST_APART * min(told.values()):
        said = ", ".join(f"{value:.4g} by {name}" for name, value in told.items())
        doubts = [f"The given sizes disagree by more than a factor of two, in metres per pixel: {said}."]
    if mapped is not None:
        return records.MetresPerPixel(value=mapped, source="depth"), doubts
    exact = [each for each in sizes if each[2]]
    if (given is not None and (given.source == "request" or not exact)) or not sizes:
        return given, doubts
    weights = np.array([1 / (deviation + LEAST_SIZE_SIGMA) ** 2 for _, deviation, _ in exact or sizes])
    value = math.exp(float(weights @ [each[0] for each in exact or sizes] / weights.sum()))
    source = "request" if exact else "reference"
    return records.MetresPerPixel(value=value, source=source, note="by the sizes of objects"), doubts


def _is_up_the_floor(reading: MotionReading, grounding: Grounding, law: Law) -> bool:
    """Whether words alone say that something moves up that may stand on the floor."""
    said = reading.kind == "linear" and reading.cue == "text" and reading.depth == 0 and reading.towards is None
    in_air = reading.rises or (grounding.prior is not None and grounding.prior.stands_on == "air")
    if not said or in_air or law != "contact" or reading.direction is None:
        return False
    return reading.direction[1] < -abs(reading.direction[0]) / math.sqrt(3)


# --- in pixels and seconds


def throw_speed(bbox: BBox, scale: records.MetresPerPixel) -> float:
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


def _pixels(quantity: Quantity, scale: records.MetresPerPixel, image_width: int) -> float:
    """px, or px/s."""
    match quantity.unit:
        case "px" | "px/s":
            return quantity.value
        case "m" | "m/s":
            return quantity.value / scale.value
        case "widths" | "widths/s":
            return quantity.value * image_width


def _moving(
    thing: LocatedObject,
    said: MotionReading | OtherMotionReading,
    scale: records.MetresPerPixel,
    law: Law,
    image_width: int,
    usual_deviation: float,
) -> records.AlsoMoving:
    """What a thing does; kinds of motion that have no direction have no speed either."""
    moves, speed = said.kind in records.DIRECTED_KINDS, DEFAULT_SPEED * image_width
    deviation = SPEED_DEVIATIONS.get(said.kind, 0.0)  # of what is assumed; 0 for a number in pixels
    if said.kind == "projectile" and law == "contact":
        speed = throw_speed(thing.bbox, scale)
    if isinstance(said.speed, Quantity):
        speed = _pixels(said.speed, scale, image_width)
        deviation = SCALE_DEVIATION if said.speed.unit == "m/s" and scale.source == "default" else 0.0
    elif said.speed is not None:
        speed *= SPEED_FACTORS[said.speed]
    return records.AlsoMoving(
        object=thing,
        kind=said.kind,
        direction=_unit(said.direction) if moves and said.direction is not None else None,
        direction_deviation=usual_deviation if said.direction_deviation is None else said.direction_deviation,
        depth=said.depth if moves else 0.0,
        towards=said.towards if moves else None,
        speed=speed if moves else 0.0,
        speed_deviation=deviation,
    )


def _complete(image_width: int, grounding: Grounding, reading: MotionReading, source: Source, law: Law) -> Motion:
    """Adds what a reading leaves open: scale, speed, deviations, gravity and the sentence."""
    scale = reading.metres_per_pixel or records.MetresPerPixel(
        value=DEFAULT_SCENE_WIDTH / image_width,
        source="default",
        note=f"the image is taken to be {DEFAULT_SCENE_WIDTH:g} m wide at the object",
    )
    moves, falls = reading.kind in records.DIRECTED_KINDS, reading.kind in records.FALLING_KINDS
    thing = LocatedObject(object=grounding.object, bbox=grounding.bbox)
    mover = _moving(thing, reading, scale, law, image_width, DIRECTION_DEVIATIONS[reading.cue])
    depth_deviation = THROW_DEPTH_DEVIATION if reading.kind == "projectile" else 0.0
    speed_deviation = mover.speed_deviation if moves else 0.0
    if moves and reading.depth_deviation is not None:
        depth_deviation = reading.depth_deviation
    if moves and reading.speed_deviation is not None:
        speed_deviation = reading.speed_deviation
    steps = tuple(
        records.MotionStep(
            direction=_unit(step.direction),
            depth=step.depth,
            distance=None if step.distance is None else _pixels(step.distance, scale, image_width),
            duration=step.duration,
        )
        for step in reading.steps
    )
    also: list[str] = []
    for other in reading.others:
        verb = {"projectile": "is thrown", "fall": "falls", "static": "stays where it is"}.get(other.kind, "moves")
        way = "" if other.kind in ("fall", "static") else direction_words(other.direction, other.depth)
        also.append(f"{bare_name(other.object.object)} {verb} {way}".rstrip())
    gravity = GRAVITY / scale.value  # px/s^2
    return Motion(
        kind=reading.kind,
        law=law,
        direction=mover.direction,
        direction_deviation=mover.direction_deviation,
        other_direction=None if reading.other_direction is None else _unit(reading.other_direction),
        depth=mover.depth,
        depth_deviation=depth_deviation,
        towards=mover.towards,
        rises=reading.rises and reading.kind == "linear",
        cue=reading.cue,
        along_arrow=reading.along_arrow,
        speed=mover.speed,
        speed_deviation=speed_deviation,
        distance=None if reading.distance is None else _pixels(reading.distance, scale, image_width),
        duration=reading.duration,
        until=reading.until,
        steps=steps,
        trail=reading.trail,
        others=tuple(
            _moving(other.object, other, scale, law, image_width, mover.direction_deviation) for other in reading.others
        ),
        gravity=(reading.down[0] * gravity, reading.down[1] * gravity) if falls else (0.0, 0.0),
        down=reading.down,
        metres_per_pixel=scale,
        sentence=motion_sentence(
            grounding.object,
            reading.kind,
            law,
            mover.direction,
            mover.depth,
            reading.sentence,
            towards=None if mover.towards is None else mover.towards.object,
            further=[direction_words(step.direction, step.depth) for step in reading.steps],
            stops=any(value is not None for value in (reading.distance, reading.duration, reading.until)),
            also=also,
        ),
        source=source,
    )


def along_trail(
    scene: Scene, grounding: Grounding, motion: Motion, run: Run[SimulateRequest], speed_given: bool
) -> Motion:
    """A motion read from a trail, with speed, direction and depth as the trail at the mover measures them."""
    trail = trail_of(scene.trails, grounding.bbox)
    if trail is None:
        return motion
    measured: dict[str, object] = {"trail": tuple(position.centre for position in trail.older)}
    if motion.kind == "linear":
        measured["direction"] = straight_direction(trail.positions)
        measured["direction_deviation"] = DIRECTION_DEVIATIONS["trail"]
    throw = None
    if motion.kind == "projectile":
        shadow, size = find_shadow(scene, grounding.bbox), (scene.width, scene.height)
        fit = given_camera(size, motion.down, run.request.camera, run.focal)
        fit = fit if shadow is None else fit_shadow(fit, grounding.bbox, shadow, size) or fit
        throw = fit_throw(trail.positions, fit, size)
    if throw is not None:
        measured["direction"] = throw.direction
        measured["direction_deviation"] = DIRECTION_DEVIATIONS["trail"]
        measured["depth"] = math.sin(math.radians(throw.turn))
        measured["depth_deviation"] = min(throw.turn_deviation, 90.0)
    if throw is not None and not speed_given:
        square = throw.froude * GRAVITY * _radius(grounding.bbox) / motion.metres_per_pixel.value
        measured |= {"speed": math.sqrt(square), "speed_deviation": min(throw.speed_deviation, 3.0)}
    return motion.model_copy(update=measured)


def motion_sentence(
    object: str,
    kind: MotionKind,
    law: Law,
    direction: Vector | None,
    depth: float,
    sentence: str | None = None,
    towards: str | None = None,
    further: Sequence[str] = (),
    stops: bool = False,
    also: Sequence[str] = (),
) -> str:
    """The motion in one line: a declarative `sentence` of a reader, or one made here; and that the camera stays.

    What obeys contacts only sets off that way: it may be stopped, turned or pushed later. `towards` names its goal,
    `further` are the directions of more legs in words, `also` what else moves, such as "car moves to the left".
    """
    text = load_prompt("motion-sentence").render(
        object=bare_name(object),
        kind=kind,
        law=law,
        words=direction_words(direction, depth) if towards is None else f"towards the {bare_name(towards)}",
        sentence="" if sentence is None else sentence.strip().rstrip(".") + ".",
        further=further,
        stops=stops,
        also=also,
    )
    return " ".join(text.split())
