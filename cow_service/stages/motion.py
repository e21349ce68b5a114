"""Stage 2: how the object moves."""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np

from cow_service import records
from cow_service.errors import CannotReadDirection, FieldError, InvalidRequest, MllmBadReply, MllmUnavailable, field_of
from cow_service.narration.words import bare_name, direction_words, place_words, same_name
from cow_service.perception.facing import facing
from cow_service.physics.ballistic import DEFAULT_SCENE_WIDTH, DEFAULT_SPEED, GRAVITY
from cow_service.physics.camera import FloorCamera, depth_motion, fit_shadow, given_camera, way_to
from cow_service.physics.lift import DIRECTION_DEVIATIONS
from cow_service.physics.trail_fit import fit_throw, is_thrown, straight_direction
from cow_service.readers.base import GIVE_DIRECTION
from cow_service.readers.prompts import load_prompt
from cow_service.records import DIRECTED_KINDS, BBox, Grounding, LocatedObject, Motion, MotionRequest, Vector
from cow_service.requests import SimulateRequest
from cow_service.stages.grounding import others_of, placed_mover
from cow_service.stages.keys import StageResult
from cow_service.stages.run import Run
from cow_service.stages.settling import Objections, SeenWay, settle_way
from cow_service.vision.scene import Scene, arrow_fault
from cow_service.vision.shadows import find_shadow
from cow_service.vision.trails import trail_of

THROW_SPEED, THROW_RADIUS = 1.8, 0.15  # m/s, m: of a toy that is thrown, where no speed is given
THROW_DEPTH_DEVIATION = 20.0  # degrees: words and arrows tell a throw's heading in the image alone
SPEED_DEVIATIONS: dict[records.MotionKind, float] = {
    "linear": 0.25,
    "projectile": 0.28,
}  # of the logarithm of a default speed
SPEED_FACTORS: dict[records.SpeedWord, float] = {"slow": 0.5, "normal": 1.0, "fast": 2.0}  # of the default speed
SCALE_DEVIATION = 0.25  # of the logarithm of metres per pixel, where nobody gave them
ELSEWHERE_SIGMA = 0.3  # of the logarithm of a scale that is told by the size of what stands elsewhere
LEAST_SIZE_SIGMA = 0.05
MOST_APART = 2.0  # factor between two scales from which they disagree


def settle_motion(run: Run[SimulateRequest], grounding: Grounding, read: MotionRequest | None) -> StageResult[Motion]:
    """The motion: what the request says of it goes before what was read, and what was measured before both.

    `read` is what the reader said while it looked for the object; where the request leaves the motion open and nothing
    was read, the reader is asked. Raises what the reader raises, `CannotReadDirection` where nothing tells which way,
    and `InvalidRequest` for a second mover that is none of the `objects`.
    """
    request = run.request
    given, warnings = given_motion(request, grounding), list[str]()
    source: records.Source = "request"
    if given is not None and given.is_whole:  # a direction that is given stays, whatever its spread
        said = given if given.direction is not None else settled_way(run, grounding, given, given)[0]
    else:
        source, (said, warnings) = run.reader.source, read_way(run, grounding, read, given)
    unused = [name for name in records.OF_A_LINE if getattr(said, name) not in (None, ())]
    if said.stated_kind != "linear" and unused:
        said = said.model_copy(update={"distance": None, "duration": None, "until": None, "steps": ()})
        ends = f"a {said.stated_kind} ends where it hits something"
        warnings.append(f"The {' and '.join(unused)} of the motion was not used: {ends}.")
    scale, doubts = scale_of(run, grounding, said)
    warnings += doubts
    if is_up_the_floor(said, grounding, request.law):
        warnings.append(
            f"'Up' was read as along the floor, away from the camera. If the {bare_name(grounding.object)} leaves "
            "the floor, say that it is lifted or thrown, or give `motion.rises`."
        )
        said = said.model_copy(update={"depth": depth_motion(1.0)[1]})
    motion = completed(run, grounding, said, scale, source)
    if motion.cue == "trail":
        with run.cpu():
            scene = run.scene_of(grounding, motion.cue)
            motion = along_trail(scene, grounding, motion, run, said.speed is not None)
    return StageResult(value=motion, warnings=(*warnings, *assumed(motion, said)))


def assumed(motion: Motion, said: MotionRequest) -> list[str]:
    """Warnings of what nobody said: how fast a throw is, and the scale of lengths in metres."""
    warnings = list[str]()
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
    asking = run.reader_input("motion", run.scene_of(grounding, None if read is None else read.cue), known=known)
    asking = replace(asking, given=asking.given.model_copy(update={"grounding": place, "motion": read or given}))
    if read is None:
        result = reader.read(asking)
        read, warnings = result.reading.motion or MotionRequest(), [*result.warnings]
    words = run.words.reading.motion or MotionRequest()

    def settled(read: MotionRequest) -> tuple[MotionRequest, Objections]:
        return settled_way(run, grounding, records.merged(given, read) or read, words, asking.scene)

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
    scene: Scene | None = None,
) -> tuple[MotionRequest, Objections]:
    """The motion with its direction by the surest source. What is `said` in words, or given, decides.

    Raises `CannotReadDirection` where the arrow, the goal or the front by which it is told cannot be seen.
    """
    is_exact = read.direction is not None and read.direction_deviation is None
    if read.stated_kind not in (*DIRECTED_KINDS, "static", None) or is_exact:
        return read, ()
    with run.cpu():
        scene = scene or run.scene_of(grounding, read.cue)
        seen = seen_way(run, scene, grounding, read, said)
        way, objections = settle_way(read, said, seen, grounding.bbox)
        if way.direction is None and way.stated_kind in DIRECTED_KINDS:
            raise CannotReadDirection(fault_of(scene, grounding, said, seen), remedy=GIVE_DIRECTION)
    return way, objections


def seen_way(
    run: Run[SimulateRequest], scene: Scene, grounding: Grounding, read: MotionRequest, said: MotionRequest
) -> SeenWay:
    """What the image shows of the way of the mover. To be called with `cpu` held."""
    words, arrow, front = run.backends.words(), scene.arrow_at(grounding.bbox), None
    if said.forward is not None and grounding.prior is not None and grounding.prior.elongated:
        front = facing(scene.clean, scene.silhouette(grounding.bbox), grounding.bbox)
    goal = said.towards or read.towards
    others = others_of(grounding) if goal else ()
    goals = [each for each in others if same_name(each.object, goal or "")]
    goals = goals or [each for each in others if words.likeness(goal or "", each.object) == "same"]
    trail = trail_of(scene.trails, grounding.bbox)
    return SeenWay(
        arrow=None if arrow is None else arrow.direction,
        is_only_arrow=len(scene.arrows_near(grounding.bbox)) == 1,
        goal=goals[0].bbox if len(goals) == 1 else None,
        front=front,
        trail=None if trail is None else trail.heading,
        is_thrown=trail is not None and is_thrown(trail.positions),
    )


def fault_of(scene: Scene, grounding: Grounding, said: MotionRequest, seen: SeenWay) -> str:
    """Why nothing tells which way the mover goes."""
    name = grounding.object
    if said.along_arrow is not None:
        return arrow_fault(scene, grounding)
    if said.cue == "trail":
        fault = f"no three positions of the {name} one after another were found in the image"
        return f"The question speaks of a trail, and {fault}."
    if said.towards is not None:
        return f"Where the {name} moves to is not clear: '{said.towards}' was not found in the image."
    if said.forward is not None:
        told = f"The question says that the {name} moves {'forward' if said.forward else 'backward'}."
        if grounding.prior is None or not grounding.prior.elongated:
            return f"{told} Which way they face is seen of vehicles with wheels alone."
        return f"{told} Which way it faces could not be seen for certain."
    near = len(scene.arrows_near(grounding.bbox))
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
    if given is not None and given.is_whole:
        return given
    told = MotionRequest()
    if path is not None:
        (x0, y0), last = path.points[0], path.points[-1]
        way = sum(math.dist(a, b) for a, b in pairwise(path.points))
        if way < 1e-6:
            told = MotionRequest(kind="static")
        else:  # the first move of a path that ends where it began
            x, y = next(point for point in (last, *path.points) if math.dist(point, (x0, y0)) > 1e-6)
            speed = way * path.fps / (len(path.points) - 1)
            told = MotionRequest.model_construct(kind="linear", direction=(x - x0, y - y0), speed=speed)
    elif grounding.source == "request" and placed_mover(grounding) is not None:
        told = MotionRequest(kind="place")
    return records.merged(given, told)


def others_given(motion: MotionRequest, grounding: Grounding) -> list[tuple[records.OtherMotionRequest, LocatedObject]]:
    """What else moves, each with the thing of its name. Raises `InvalidRequest` for one that was not located."""
    found = list[tuple[records.OtherMotionRequest, LocatedObject]]()
    for index, each in enumerate(motion.others):
        things = [other for other in grounding.others if same_name(other.object, each.object)]
        if len(things) != 1:
            seen = ", ".join(f"'{other.object}'" for other in grounding.others) or "none"
            pointer = f"/motion/others/{index}/object"
            detail = f"'{each.object}' matches {len(things)} of the located objects ({seen})"
            raise InvalidRequest(
                f"`{field_of(pointer)}`: {detail}: give it in `objects` under this name.",
                errors=(FieldError(pointer, detail),),
            )
        found.append((each, things[0]))
    return found


def scale_of(
    run: Run[SimulateRequest], grounding: Grounding, said: MotionRequest
) -> tuple[records.MetresPerPixel | None, list[str]]:
    """Metres per pixel at the mover, and doubts: by a depth map in metres, else as given, else by sizes that are given,
    else as read of it or others.

    What stands elsewhere on the floor is nearer or farther, by the camera as far as it is known. None where nobody
    says anything of it.
    """
    given = said.metres_per_pixel
    told = {} if given is None else {"metres_per_pixel": given}
    things = [LocatedObject(object=grounding.object, bbox=grounding.bbox, prior=grounding.prior), *grounding.others]
    width, height = run.image.info.width, run.image.info.height
    fit, depth_map = given_camera((width, height), said.down, run.request.camera, run.focal), run.depth
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
        in_air = said.kind in records.FALLING_KINDS or (each.prior is not None and each.prior.stands_on == "air")
        nearer = 1.0 if in_air or not math.isfinite(depth) else float(depth)
        x0, y0, x1, y1 = each.bbox
        value = size.value / max(x1 - x0, y1 - y0) / nearer
        elsewhere = 0.0 if each is things[0] else ELSEWHERE_SIGMA
        sizes.append((math.log(value), size.deviation / size.value + elsewhere, size.deviation == 0))
        told[f"the size of '{each.object}'"] = value
    doubts: list[str] = []
    if told and max(told.values()) > MOST_APART * min(told.values()):
        listed = ", ".join(f"{value:.4g} by {name}" for name, value in told.items())
        doubts = [f"The given sizes disagree by more than a factor of two, in metres per pixel: {listed}."]
    if mapped is not None:
        return records.MetresPerPixel(value=mapped, source="depth"), doubts
    exact = [each for each in sizes if each[2]]
    is_read = run.request.motion is None or run.request.motion.metres_per_pixel is None
    if given is not None and not (is_read and exact):
        x0, y0, x1, y1 = grounding.bbox
        span = max(x1 - x0, y1 - y0)
        if not is_read:
            return records.MetresPerPixel(value=given, source="request"), doubts
        note = f"{grounding.object}: {given * span:.3g} m over {span:.0f} px"
        return records.MetresPerPixel(value=given, source="reference", note=note), doubts
    if not sizes:
        return None, doubts
    weights = np.array([1 / (deviation + LEAST_SIZE_SIGMA) ** 2 for _, deviation, _ in exact or sizes])
    value = math.exp(float(weights @ [each[0] for each in exact or sizes] / weights.sum()))
    source = "request" if exact else "reference"
    return records.MetresPerPixel(value=value, source=source, note="by the sizes of objects"), doubts


def is_up_the_floor(reading: MotionRequest, grounding: Grounding, law: records.Law) -> bool:
    """Whether words alone say that something moves up that may stand on the floor."""
    said = reading.stated_kind == "linear" and reading.cue == "text" and reading.depth == 0 and reading.towards is None
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


def _pixels(said: float | records.Quantity, scale: records.MetresPerPixel, image_width: int) -> float:
    """px, or px/s."""
    value, unit = (said.value, said.unit) if isinstance(said, records.Quantity) else (said, "px")
    match unit:
        case "px" | "px/s":
            return value
        case "m" | "m/s":
            return value / scale.value
        case "widths" | "widths/s":
            return value * image_width


def speed_of(
    said: MotionRequest | records.OtherMotionRequest,
    bbox: BBox,
    scale: records.MetresPerPixel,
    law: records.Law,
    image_width: int,
) -> tuple[float, float]:
    """Speed (px/s) of what is in a box, and the deviation of its logarithm; kinds without a direction have none."""
    kind = said.stated_kind or "linear"
    if kind not in DIRECTED_KINDS:
        return 0.0, 0.0
    if said.speed is not None and not isinstance(said.speed, str):
        is_metric = isinstance(said.speed, records.Quantity) and said.speed.unit == "m/s"
        deviation = SCALE_DEVIATION if is_metric and scale.source == "default" else 0.0
        return _pixels(said.speed, scale, image_width), deviation
    usual = DEFAULT_SPEED * image_width
    if kind == "projectile" and law == "contact":
        usual = throw_speed(bbox, scale)
    return usual * SPEED_FACTORS[said.speed or "normal"], SPEED_DEVIATIONS[kind]


def other_motion(
    said: records.OtherMotionRequest,
    thing: LocatedObject,
    goal: LocatedObject | None,
    scale: records.MetresPerPixel,
    law: records.Law,
    image_width: int,
    usual_deviation: float,
) -> records.AlsoMoving:
    """What another thing does."""
    speed, deviation = speed_of(said, thing.bbox, scale, law, image_width)
    direction = None if goal is None else way_to(goal.bbox, thing.bbox, is_on_floor=False)
    direction = said.direction or direction
    return records.AlsoMoving(
        object=thing,
        kind=said.stated_kind,
        direction=None if direction is None else _unit(direction),
        direction_deviation=usual_deviation if said.direction_deviation is None else said.direction_deviation,
        depth=said.depth,
        towards=goal,
        speed=speed,
        speed_deviation=deviation if said.speed_deviation is None else said.speed_deviation,
    )


def completed(
    run: Run[SimulateRequest],
    grounding: Grounding,
    said: MotionRequest,
    scale: records.MetresPerPixel | None,
    source: records.Source,
) -> Motion:
    """The motion with what nobody said of it: scale, speed, deviations, gravity and the sentence."""
    image_width, law, kind = run.image.info.width, run.request.law, said.stated_kind or "linear"
    scale = scale or records.MetresPerPixel(
        value=DEFAULT_SCENE_WIDTH / image_width,
        source="default",
        note=f"the image is taken to be {DEFAULT_SCENE_WIDTH:g} m wide at the object",
    )
    moves, falls = kind in DIRECTED_KINDS, kind in records.FALLING_KINDS
    cue = said.cue or ("request" if source == "request" else CUES.get(kind, "text"))
    speed, speed_deviation = speed_of(said, grounding.bbox, scale, law, image_width)
    usual = DIRECTION_DEVIATIONS[cue]
    things = (LocatedObject(object=grounding.object, bbox=grounding.bbox), *others_of(grounding))

    def goal_of(name: str | None) -> LocatedObject | None:
        return next((each for each in things if name is not None and same_name(each.object, name)), None)

    # A direction in the image leaves open how far a throw leads into its depth.
    is_open = kind == "projectile" and not (source == "request" and "depth" in said.model_fields_set)
    depth_deviation = said.depth_deviation if said.depth_deviation is not None else THROW_DEPTH_DEVIATION * is_open
    steps = tuple(
        records.MotionStep(
            direction=_unit(step.direction),
            depth=step.depth,
            distance=None if step.distance is None else _pixels(step.distance, scale, image_width),
            duration=step.duration,
        )
        for step in said.steps
    )
    others = tuple(
        other_motion(each, thing, goal_of(each.towards), scale, law, image_width, said.direction_deviation or usual)
        for each, thing in others_given(said, grounding)
    )
    gravity, towards, down = GRAVITY / scale.value, goal_of(said.towards), _unit(said.down)  # px/s^2
    direction = None if said.direction is None or not moves else _unit(said.direction)
    return Motion(
        kind=kind,
        law=law,
        direction=direction,
        direction_deviation=usual if said.direction_deviation is None else said.direction_deviation,
        other_direction=None if said.other_direction is None else _unit(said.other_direction),
        depth=said.depth if moves else 0.0,
        depth_deviation=depth_deviation if moves else 0.0,
        towards=towards if moves else None,
        rises=said.rises and kind == "linear",
        cue=cue,
        along_arrow=said.along_arrow,
        speed=speed,
        speed_deviation=speed_deviation if said.speed_deviation is None or not moves else said.speed_deviation,
        distance=None if said.distance is None else _pixels(said.distance, scale, image_width),
        duration=said.duration,
        until=said.until,
        steps=steps,
        others=others,
        gravity=(down[0] * gravity, down[1] * gravity) if falls else (0.0, 0.0),
        down=down,
        metres_per_pixel=scale,
        sentence=sentence_of(grounding, kind, law, direction, said, steps, others),
        source=source,
    )


CUES: dict[records.MotionKind, records.Cue] = {
    "fall": "gravity",
    "projectile": "gravity",
}  # of a motion whose direction none tells


def sentence_of(
    grounding: Grounding,
    kind: records.MotionKind,
    law: records.Law,
    direction: Vector | None,
    said: MotionRequest,
    steps: Sequence[records.MotionStep],
    others: Sequence[records.AlsoMoving],
) -> str:
    """The motion in one line."""
    placed, told = placed_mover(grounding), None
    if placed is not None and kind == "place":
        told = f"The {bare_name(grounding.object)} is lifted, carried over and put {place_words(placed)}"
    also: list[str] = []
    for other in others:
        verb = {"projectile": "is thrown", "fall": "falls", "static": "stays where it is"}.get(other.kind, "moves")
        way = "" if other.kind in ("fall", "static") else direction_words(other.direction, other.depth)
        also.append(f"{bare_name(other.object.object)} {verb} {way}".rstrip())
    return motion_sentence(
        grounding.object,
        kind,
        law,
        direction,
        said.depth,
        told,
        towards=said.towards,
        further=[direction_words(step.direction, step.depth) for step in steps],
        stops=any(value is not None for value in (said.distance, said.duration, said.until)),
        also=also,
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
    kind: records.MotionKind,
    law: records.Law,
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
