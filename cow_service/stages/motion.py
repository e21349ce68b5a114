"""Stage 2: how the object moves."""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from cow_service import records
from cow_service.errors import CannotReadDirection, FieldError, InvalidRequest, MllmBadReply, MllmUnavailable, field_of
from cow_service.narration.words import bare_name, direction_words, place_words, same_name
from cow_service.perception.classical.facing import facing
from cow_service.perception.classical.trails import trail_of
from cow_service.perception.observation import Observation, arrow_fault
from cow_service.physics.ballistic import DEFAULT_SCENE_WIDTH, DEFAULT_SPEED, GRAVITY
from cow_service.physics.camera import FloorCamera, depth_motion, fit_shadow, given_camera, way_to
from cow_service.physics.lift import DIRECTION_DEVIATIONS
from cow_service.physics.trail_fit import fit_throw, is_thrown, straight_direction
from cow_service.readers.base import GIVE_DIRECTION, GIVE_OBJECT
from cow_service.readers.prompts import load_prompt
from cow_service.records import DIRECTED_KINDS, BBox, Grounding, LocatedObject, Motion, MotionRequest, Vector
from cow_service.requests import SimulateRequest
from cow_service.stages.depth import depth_map, focal_of
from cow_service.stages.grounding import look_again, others_of, placed_mover
from cow_service.stages.keys import EstimatedDepth, StageResult
from cow_service.stages.run import Run
from cow_service.stages.settling import Objections, SeenWay, settle_way

THROW_SPEED, THROW_RADIUS = 1.8, 0.15  # m/s, m: of a toy that is thrown, where no speed is given
THROW_DEPTH_DEVIATION = 20.0  # degrees: words and arrows tell a throw's heading in the image alone
# Of the logarithm of a default speed.
SPEED_DEVIATIONS: dict[records.MotionKind, float] = {"linear": 0.25, "projectile": 0.28}
SPEED_FACTORS: dict[records.SpeedWord, float] = {"slow": 0.5, "normal": 1.0, "fast": 2.0}  # of the default speed
SCALE_DEVIATION = 0.25  # of the logarithm of metres per pixel, where nobody gave them
ELSEWHERE_SIGMA = 0.3  # of the logarithm of a scale that is told by the size of what stands elsewhere
LEAST_SIZE_SIGMA = 0.05
MOST_APART = 2.0  # factor between two scales from which they disagree


def settle_motion(
    run: Run[SimulateRequest], grounding: Grounding, read: MotionRequest | None, depth: EstimatedDepth | None = None
) -> StageResult[Motion]:
    """The motion: what the request says of it goes before what is measured, and that before what was read.

    `read` is what the reader said while it looked for the object; where the request leaves the motion open and nothing
    was read, the reader is asked. Raises what the reader raises, `CannotReadDirection` where nothing tells which way,
    and `InvalidRequest` for a second mover that is none of the `objects`.
    """
    request = run.request
    given, warnings = given_motion(request, grounding), list[str]()
    source: records.Source = "request"
    if given is not None and given.is_whole:  # a direction that is given stays, whatever its spread
        told = run.words.reading.motion
        if given.kind is None and told is not None and told.kind in DIRECTED_KINDS:
            given = given.model_copy(update={"kind": told.kind})
        said = given if given.direction is not None else settled_way(run, grounding, given, given)[0]
    else:
        source, (said, warnings) = run.reader.source, read_way(run, grounding, read, given)
    unused = [name for name in records.OF_A_LINE if getattr(said, name) not in (None, ())]
    if said.stated_kind != "linear" and unused:
        said = said.model_copy(update={"distance": None, "duration": None, "until": None, "steps": ()})
        ends = f"a {said.stated_kind} ends where it hits something"
        is_one = "was" if len(unused) == 1 else "were"
        warnings.append(f"The {' and '.join(unused)} of the motion {is_one} not used: {ends}.")
    scale, doubts = scale_of(run, grounding, said, depth)
    warnings += doubts
    if is_up_the_floor(said, grounding, request.law):
        warnings.append(
            f"'Up' was read as along the floor, away from the camera. If the {bare_name(grounding.object)} leaves "
            "the floor, say that it is lifted or thrown, or give `motion.rises`."
        )
        said = said.model_copy(update={"depth": depth_motion(1.0)[1]})
    motion = completed(run, grounding, said, scale, source)
    refuse_too_much(motion)
    if motion.cue == "trail":
        with run.cpu():
            motion = along_trail(run, grounding, motion, depth, said.speed is not None)
    return StageResult(value=motion, warnings=(*warnings, *assumed(motion, said)))


def refuse_too_much(motion: Motion) -> None:
    """Raises `InvalidRequest` for speeds and lengths beyond those of requests, whoever said them in whatever unit."""
    speeds = {"/motion/speed": motion.speed}
    speeds |= {f"/motion/others/{index}/speed": each.speed for index, each in enumerate(motion.others)}
    lengths = {"/motion/distance": motion.distance}
    lengths |= {f"/motion/steps/{index}/distance": each.distance for index, each in enumerate(motion.steps)}
    for pointer, value, most, unit in (
        *((pointer, speed, records.MAX_SPEED, "px/s") for pointer, speed in speeds.items()),
        *((pointer, length, records.MAX_DISTANCE, "px") for pointer, length in lengths.items()),
    ):
        if value is not None and value > most:
            detail = f"amounts to {value:.3g} {unit} in this image, more than {most:,} {unit}"
            raise InvalidRequest(f"`{field_of(pointer)}` {detail}.", errors=(FieldError(pointer, detail),))


def assumed(motion: Motion, said: MotionRequest) -> list[str]:
    """Warnings of a direction given twice, and of what nobody said: a throw's speed, the scale of metres."""
    warnings = list[str]()
    if motion.other_direction is not None and motion.source == "request":
        warnings.append("The request gives a second direction (`motion.other_direction`), so no answer is sure.")
    if motion.kind == "projectile" and (said.speed is None or isinstance(said.speed, str)) and not motion.trail:
        warnings.append(
            f"How far a throw goes depends on its speed: {motion.speed:.0f} px/s was assumed; `motion.speed` sets it."
        )
    units = [each.unit for each in (said.speed, said.distance) if isinstance(each, records.Quantity)]
    if motion.metres_per_pixel.source == "default" and not {"m", "m/s"}.isdisjoint(units):
        warnings.append(
            f"Lengths in metres were taken at {motion.metres_per_pixel.value:.4f} m per pixel, which was assumed; "
            "`motion.metres_per_pixel` sets it."
        )
    return warnings


# --- which way


def read_way(
    run: Run[SimulateRequest], grounding: Grounding, read: MotionRequest | None, given: MotionRequest | None
) -> tuple[MotionRequest, list[str]]:
    """The motion as it was read, with what is given in its place, settled; and warnings.

    A reader that may be wrong is asked once more with what speaks against its reading.
    """
    reader, warnings = run.reader, list[str]()
    place = records.GroundingRequest(object=grounding.object, bbox=grounding.bbox)
    known = tuple(map(records.as_said, grounding.others))
    with run.cpu():
        observation = look_again(run, grounding, None if read is None else read.cue)
    asking = run.reader_input("motion", observation, known=known)
    asking = replace(asking, given=asking.given.model_copy(update={"grounding": place, "motion": read or given}))
    if read is None:
        result = reader.read(asking)
        read, warnings = result.reading.motion or MotionRequest(), [*result.warnings]
    words = run.words.reading.motion or MotionRequest()

    def settled(read: MotionRequest) -> tuple[MotionRequest, Objections]:
        way, objections = settled_way(run, grounding, records.merged(given, read) or read, words, observation)
        return records.merged(given, way) or way, objections  # what is given stays

    way, objections = settled(read)
    if objections and reader.heeds_objections:
        open_way = read.model_copy(update={"direction": None, "along_arrow": None, "cue": None, "depth": 0.0})
        again = asking.given.model_copy(update={"motion": open_way})
        with suppress(CannotReadDirection, MllmBadReply, MllmUnavailable):
            result = reader.read(replace(asking, given=again, objections=objections))
            way, objections = settled(records.merged(result.reading.motion, open_way) or open_way)
            warnings += result.warnings
    if way.cue == "arrow" and not words.has_way and way.along_arrow and read.direction_deviation is None:
        warnings.append("The question names no direction; the arrow drawn at the object was followed.")
    return way, [*warnings, *objections]


def settled_way(
    run: Run[SimulateRequest],
    grounding: Grounding,
    read: MotionRequest,
    said: MotionRequest,
    observation: Observation | None = None,
) -> tuple[MotionRequest, Objections]:
    """The motion with its direction by the surest source. What is `said` in words, or given, decides.

    Raises `CannotReadDirection` where the arrow, the goal or the front by which it is told cannot be seen.
    """
    is_exact = read.direction is not None and read.direction_deviation is None
    if read.stated_kind not in (*DIRECTED_KINDS, "static", None) or is_exact:
        return read, ()
    with run.cpu():
        observation = observation or look_again(run, grounding, read.cue)
        seen = seen_way(run, observation, grounding, read, said)
        way, objections = settle_way(read, said, seen, grounding.bbox)
        if way.direction is None and way.stated_kind in DIRECTED_KINDS:
            raise CannotReadDirection(fault_of(observation, grounding, said, seen), remedy=GIVE_DIRECTION)
    return way, objections


def seen_way(
    run: Run[SimulateRequest], observation: Observation, grounding: Grounding, read: MotionRequest, said: MotionRequest
) -> SeenWay:
    """What the image shows of the way of the mover. To be called with `cpu` held."""
    arrow, front = observation.arrow_at(grounding.bbox), None
    if said.forward is not None and grounding.prior is not None and grounding.prior.elongated:
        front = facing(observation.clean, observation.mask_in(grounding.bbox).full(), grounding.bbox)
    goal = goal_of(run, grounding, said.towards or read.towards, grounding.bbox)
    trail = trail_of(observation.trails, grounding.bbox)
    return SeenWay(
        arrow=None if arrow is None else arrow.direction,
        is_only_arrow=len(observation.arrows_near(grounding.bbox)) == 1,
        goal=None if goal is None else goal.bbox,
        front=front,
        trail=None if trail is None else trail.heading,
        is_thrown=trail is not None and is_thrown(trail.positions),
    )


def fault_of(observation: Observation, grounding: Grounding, said: MotionRequest, seen: SeenWay) -> str:
    """Why nothing tells which way the mover goes, whether the question or the request has said it."""
    name = grounding.object
    if said.along_arrow is not None:
        return arrow_fault(observation, grounding)
    if said.cue == "trail":
        return f"A trail is to tell the direction, but no three positions of the {name} one after another were found."
    if said.towards is not None:
        return f"Where the {name} moves to is not clear: '{said.towards}' was not located. {GIVE_OBJECT}"
    if said.forward is not None:
        told = f"The {name} is to move {'forward' if said.forward else 'backward'}."
        if grounding.prior is None or not grounding.prior.elongated:
            return f"{told} Which way a thing faces is seen only of vehicles with wheels."
        return f"{told} Which way it faces could not be seen for certain."
    near = len(observation.arrows_near(grounding.bbox))
    return (
        "No direction was read in the question (left, right, up, down, towards, away, along the arrow), and the image "
        f"shows {near or 'no'} arrow{'s' * (near != 1)} at the {name}, and none was followed."
    )


# --- what the request says


def given_motion(request: SimulateRequest, grounding: Grounding) -> MotionRequest | None:
    """What the request says of the motion.

    A given path amounts to a motion from its first point towards its last, at its mean speed (px/s). What the request
    puts somewhere moves so, where nothing else is said of it.
    """
    given, path = request.motion, request.trajectory
    if path is None and given is not None and given.is_whole:
        return given
    told = MotionRequest()
    if path is not None:
        (x0, y0), last = path.points[0], path.points[-1]
        way = sum(math.dist(a, b) for a, b in pairwise(path.points))
        if way < 1e-6:
            told = MotionRequest(kind="static")
        else:  # the first move of a path that ends where it began
            x, y = next(point for point in (last, *path.points) if math.dist(point, (x0, y0)) > 1e-6)
            speed = min(way * path.fps / (len(path.points) - 1), records.MAX_SPEED)
            told = MotionRequest(kind="linear", direction=(x - x0, y - y0), speed=speed)
        return (given or told).model_copy(update={name: getattr(told, name) for name in told.model_fields_set})
    elif grounding.source == "request" and placed_mover(grounding) is not None:
        told = MotionRequest(kind="place")
    return records.merged(given, told)


class SizeScale(NamedTuple):
    """Metres per pixel at the mover, by the size of one thing."""

    name: str
    value: float
    deviation: float  # of its logarithm
    is_exact: bool


def scales_by_size(grounding: Grounding, camera: FloorCamera, mover_in_air: bool) -> list[SizeScale]:
    """By each thing of a known size. What stands elsewhere on the floor is nearer or farther than the mover."""
    things = [LocatedObject(object=grounding.object, bbox=grounding.bbox, prior=grounding.prior), *grounding.others]
    feet = np.array([((x0 + x1) / 2, y1) for x0, _, x1, y1 in (each.bbox for each in things)])
    depths = camera.floor_points(feet)[:, 2]
    scales = list[SizeScale]()
    for each, depth in zip(things, depths / depths[0], strict=True):
        prior = each.prior
        if prior is None or prior.size is None or not prior.size.value > 0:
            continue
        is_as_near = mover_in_air or prior.stands_on == "air" or not math.isfinite(depth)
        value = prior.size.value / _longest_side(each.bbox) / (1.0 if is_as_near else float(depth))
        deviation = prior.size.deviation / prior.size.value + ELSEWHERE_SIGMA * (each is not things[0])
        scales.append(SizeScale(each.object, value, deviation, prior.size.deviation == 0))
    return scales


def scale_of(
    run: Run[SimulateRequest], grounding: Grounding, said: MotionRequest, estimated: EstimatedDepth | None
) -> tuple[records.MetresPerPixel, list[str]]:
    """Metres per pixel at the mover, and doubts: by a depth map in metres, else as given, else by sizes that are given,
    else as read of it or others, else of an image of the usual width.
    """
    request, given, width, height = run.request, said.metres_per_pixel, run.image.info.width, run.image.info.height
    depth, mapped = depth_map(run, estimated), None
    fit = given_camera((width, height), said.down, request.camera, focal_of(run, depth))
    camera = FloorCamera(width, height, math.exp(fit.mean[1]) * width, float(fit.mean[0]), fit.roll, 1.0)
    if depth is not None and request.law == "contact" and request.trajectory is None:
        mapped = depth.metres_per_pixel(grounding.bbox, camera.focal)
    sizes = scales_by_size(grounding, camera, said.kind in records.FALLING_KINDS)
    told = {"metres_per_pixel": given, "the depth map, which is taken": mapped}
    told |= {f"the size of '{each.name}'": each.value for each in sizes}
    doubts = scale_doubts({name: value for name, value in told.items() if value is not None})
    is_given = request.motion is not None and request.motion.metres_per_pixel is not None
    if mapped is not None:
        return records.MetresPerPixel(value=mapped, source="depth"), doubts
    if given is not None and is_given:
        return records.MetresPerPixel(value=given, source="request"), doubts
    if given is not None and not any(each.is_exact for each in sizes):
        span = _longest_side(grounding.bbox)
        note = f"{grounding.object}: {given * span:.3g} m over {span:.0f} px"
        return records.MetresPerPixel(value=given, source="reference", note=note), doubts
    if sizes:
        return mean_scale(sizes), doubts
    note = f"the image is taken to be {DEFAULT_SCENE_WIDTH:g} m wide at the object"
    return records.MetresPerPixel(value=DEFAULT_SCENE_WIDTH / width, source="default", note=note), doubts


def scale_doubts(told: dict[str, float]) -> list[str]:
    """What speaks against scales, metres per pixel by what tells them: that they contradict each other."""
    if not told or max(told.values()) <= MOST_APART * min(told.values()):
        return []
    listed = ", ".join(f"{value:.4g} by {name}" for name, value in told.items())
    return [f"The given sizes disagree by more than a factor of two, in metres per pixel: {listed}."]


def mean_scale(sizes: list[SizeScale]) -> records.MetresPerPixel:
    """The weighted mean of the scales that are exact, else of all."""
    exact = [each for each in sizes if each.is_exact]
    weights = np.array([1 / (each.deviation + LEAST_SIZE_SIGMA) ** 2 for each in exact or sizes])
    value = math.exp(float(weights @ [math.log(each.value) for each in exact or sizes] / weights.sum()))
    source = "request" if exact else "reference"
    return records.MetresPerPixel(value=value, source=source, note="by the sizes of objects")


def is_up_the_floor(reading: MotionRequest, grounding: Grounding, law: records.Law) -> bool:
    """Whether words alone say that something moves up that may stand on the floor."""
    said = reading.stated_kind == "linear" and reading.cue == "text" and reading.depth == 0 and reading.towards is None
    in_air = reading.rises or (grounding.prior is not None and grounding.prior.stands_on == "air")
    if not said or in_air or law != "contact" or reading.direction is None:
        return False
    return reading.direction[1] < -abs(reading.direction[0]) / math.sqrt(3)


# --- in pixels and seconds


def _radius(bbox: BBox) -> float:
    x0, y0, x1, y1 = bbox
    return (x1 - x0 + y1 - y0) / 4  # px


def _longest_side(bbox: BBox) -> float:
    x0, y0, x1, y1 = bbox
    return max(x1 - x0, y1 - y0)  # px


def _unit(vector: Vector) -> Vector:
    length = math.hypot(*vector)
    return vector[0] / length, vector[1] / length


@dataclass(frozen=True)
class Units:
    """Turns what is said of lengths and speeds into pixels and seconds."""

    scale: records.MetresPerPixel
    image_width: int
    law: records.Law

    def pixels(self, said: float | records.Quantity) -> float:
        """px, or px/s."""
        value, unit = (said.value, said.unit) if isinstance(said, records.Quantity) else (said, "px")
        match unit:
            case "px" | "px/s":
                return value
            case "m" | "m/s":
                return value / self.scale.value
            case "widths" | "widths/s":
                return value * self.image_width

    def length(self, said: records.AnyDistance | None) -> float | None:
        """px; none where none is said."""
        return None if said is None else self.pixels(said)

    def way_of(
        self, said: MotionRequest | records.OtherMotionRequest, bbox: BBox, usual_deviation: float
    ) -> dict[str, Any]:
        """The fields of a motion that tell which way and how fast what is in a box sets out."""
        speed, deviation = self.speed_of(said, bbox)
        return {
            "kind": said.stated_kind or "linear",
            "direction": None if said.direction is None else _unit(said.direction),
            "direction_deviation": usual_deviation if said.direction_deviation is None else said.direction_deviation,
            "depth": said.depth,
            "speed": speed,
            "speed_deviation": deviation if said.speed_deviation is None else said.speed_deviation,
        }

    def speed_of(self, said: MotionRequest | records.OtherMotionRequest, bbox: BBox) -> tuple[float, float]:
        """Speed (px/s) of what is in a box, and the deviation of its logarithm; kinds without a direction have none.

        A throw whose speed nobody gave has v^2 / (g R) as of a toy of radius 0.15 m thrown at 1.8 m/s: how far it gets
        in the image, in its own radii, does then not depend on the scale, which is uncertain.
        """
        kind, speed = said.stated_kind or "linear", said.speed
        if kind not in DIRECTED_KINDS:
            return 0.0, 0.0
        if speed is not None and not isinstance(speed, str):
            is_assumed = isinstance(speed, records.Quantity) and speed.unit == "m/s" and self.scale.source == "default"
            return self.pixels(speed), SCALE_DEVIATION if is_assumed else 0.0
        usual = DEFAULT_SPEED * self.image_width
        if kind == "projectile" and self.law == "contact":
            gravity = GRAVITY / self.scale.value  # px/s^2
            usual = math.sqrt(THROW_SPEED**2 / (GRAVITY * THROW_RADIUS) * gravity * _radius(bbox))
        return usual * SPEED_FACTORS[speed or "normal"], SPEED_DEVIATIONS[kind]


def goal_of(run: Run[SimulateRequest], grounding: Grounding, name: str | None, mover: BBox) -> LocatedObject | None:
    """What moves towards a name heads for: the one thing that has it, else the one that the name describes.

    None where there is none or several, and where it is not clear in which direction it lies from the mover's box.
    """
    if name is None:
        return None
    own, words = LocatedObject(object=grounding.object, bbox=grounding.bbox), run.backends.words()
    things = [each for each in (own, *others_of(grounding)) if each.bbox != mover]
    goals = [each for each in things if same_name(each.object, name)]
    goals = goals or [each for each in things if words.likeness(name, each.object) == "same"]
    is_clear = len(goals) == 1 and way_to(goals[0].bbox, mover, is_on_floor=False) != (0.0, 0.0)
    return goals[0] if is_clear else None


def others_moving(
    run: Run[SimulateRequest], grounding: Grounding, said: MotionRequest, units: Units, usual_deviation: float
) -> tuple[records.AlsoMoving, ...]:
    """What else moves, and how. Raises `InvalidRequest` for what was not located."""
    moving = list[records.AlsoMoving]()
    for index, each in enumerate(said.others):
        things = [other for other in grounding.others if same_name(other.object, each.object)]
        if len(things) != 1:
            seen = ", ".join(f"'{other.object}'" for other in grounding.others) or "none"
            pointer = f"/motion/others/{index}/object"
            detail = f"'{each.object}' matches {len(things)} of the located objects ({seen})"
            raise InvalidRequest(
                f"`{field_of(pointer)}`: {detail}: give it in `objects` under this name.",
                errors=(FieldError(pointer, detail),),
            )
        box, way = things[0].bbox, units.way_of(each, things[0].bbox, usual_deviation)
        goal = goal_of(run, grounding, each.towards, box)
        if each.towards is not None and each.direction is None and goal is None:
            pointer, detail = f"/motion/others/{index}/towards", f"'{each.towards}' was not located elsewhere"
            message = f"`{field_of(pointer)}`: {detail}: give its box in `objects` under this name."
            raise InvalidRequest(message, errors=(FieldError(pointer, detail),))
        if goal is not None and each.direction is None:
            way["direction"] = _unit(way_to(goal.bbox, box, is_on_floor=False))
        moving.append(records.AlsoMoving(object=things[0], towards=goal, **way))
    return tuple(moving)


def completed(
    run: Run[SimulateRequest],
    grounding: Grounding,
    said: MotionRequest,
    scale: records.MetresPerPixel,
    source: records.Source,
) -> Motion:
    """The motion with what nobody said of it: scale, speed, deviations, gravity and the sentence."""
    kind, units = said.stated_kind or "linear", Units(scale, run.image.info.width, run.request.law)
    cue = said.cue or ("request" if source == "request" else CUES.get(kind, "text"))
    usual = DIRECTION_DEVIATIONS[cue]
    legs = (
        dict(each) | {"direction": _unit(each.direction), "distance": units.length(each.distance)}
        for each in said.steps
    )
    way = units.way_of(said, grounding.bbox, usual)
    if kind in DIRECTED_KINDS:
        # A direction in the image leaves open how far a throw leads into its depth.
        is_open = kind == "projectile" and not (source == "request" and "depth" in said.model_fields_set)
        usual_depth = THROW_DEPTH_DEVIATION if is_open else 0.0
        way["depth_deviation"] = usual_depth if said.depth_deviation is None else said.depth_deviation
        way["towards"] = goal_of(run, grounding, said.towards, grounding.bbox)
    else:
        way |= {"direction": None, "depth": 0.0, "speed_deviation": 0.0}
    down, gravity = _unit(said.down), GRAVITY / scale.value if kind in records.FALLING_KINDS else 0.0  # px/s^2
    motion = Motion(
        **way,
        law=run.request.law,
        other_direction=None if said.other_direction is None else _unit(said.other_direction),
        rises=said.rises and kind == "linear",
        cue=cue,
        along_arrow=said.along_arrow,
        distance=units.length(said.distance),
        duration=said.duration,
        until=said.until,
        steps=tuple(map(records.MotionStep.model_validate, legs)),
        others=others_moving(run, grounding, said, units, said.direction_deviation or usual),
        gravity=(down[0] * gravity, down[1] * gravity),
        down=down,
        metres_per_pixel=scale,
        sentence="",
        source=source,
    )
    return motion.model_copy(update={"sentence": motion_sentence(motion, grounding, said.towards)})


# The cue of a motion whose direction nothing tells.
CUES: dict[records.MotionKind, records.Cue] = {"fall": "gravity", "projectile": "gravity"}


def motion_sentence(motion: Motion, grounding: Grounding, towards: str | None = None) -> str:
    """The motion in one declarative line, and that the camera stays; `towards` names its goal.

    What obeys contacts only sets off that way: it may be stopped, turned or pushed later.
    """
    name, placed, sentence = bare_name(grounding.object), placed_mover(grounding), ""
    if placed is not None and motion.kind == "place":
        sentence = f"The {name} is lifted, carried over and put {place_words(placed)}."
    also = list[str]()
    for other in motion.others:
        verb = {"projectile": "is thrown", "fall": "falls", "static": "stays where it is"}.get(other.kind, "moves")
        way = "" if other.kind in ("fall", "static") else direction_words(other.direction, other.depth)
        also.append(f"{bare_name(other.object.object)} {verb} {way}".rstrip())
    words = direction_words(motion.direction, motion.depth) if towards is None else f"towards the {bare_name(towards)}"
    text = load_prompt("motion-sentence").render(
        object=name,
        kind=motion.kind,
        law=motion.law,
        words=words,
        sentence=sentence,
        further=[direction_words(step.direction, step.depth) for step in motion.steps],
        stops=any(value is not None for value in (motion.distance, motion.duration, motion.until)),
        also=also,
    )
    return " ".join(text.split())


def along_trail(
    run: Run[SimulateRequest], grounding: Grounding, motion: Motion, depth: EstimatedDepth | None, speed_given: bool
) -> Motion:
    """A motion read from a trail, with speed, direction and depth as the trail at the mover measures them."""
    observation = look_again(run, grounding, motion.cue)
    trail = trail_of(observation.trails, grounding.bbox)
    if trail is None:
        return motion
    measured: dict[str, object] = {"trail": tuple(position.centre for position in trail.older)}
    if motion.kind == "linear":
        measured["direction"] = straight_direction(trail.positions)
        measured["direction_deviation"] = DIRECTION_DEVIATIONS["trail"]
    throw = None
    if motion.kind == "projectile":
        shadow, size = observation.shadow_below(grounding.bbox), (observation.width, observation.height)
        fit = given_camera(size, motion.down, run.request.camera, focal_of(run, depth_map(run, depth)))
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
