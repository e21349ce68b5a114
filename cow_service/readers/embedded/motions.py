"""How a thing moves by the words of a question: its direction in the image, and what they say of speed and distance."""

import math
from collections.abc import Sequence
from typing import TypedDict, TypeVar

from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.perception.facing import facing
from cow_service.physics.camera import depth_motion, way_to
from cow_service.physics.trail_fit import is_thrown
from cow_service.readers.base import MotionReading, OtherMotionReading, Quantity, SpeedWord, StepReading
from cow_service.readers.embedded.english.lexicon import ObjectPhrase, QuantityWords
from cow_service.readers.embedded.english.noun_phrases import is_vehicle, shape_of
from cow_service.readers.embedded.english.questions import MotionWords, Question, StepWords
from cow_service.readers.embedded.matching import best_matches, describe, match_one, unclear
from cow_service.readers.remedies import GIVE_DIRECTION, GIVE_PLACE
from cow_service.records import DIRECTED_KINDS, FALLING_KINDS, BBox, Grounding, LocatedObject, MotionKind, Until, Vector
from cow_service.vision.masks import is_same_object
from cow_service.vision.scene import Scene, arrow_of
from cow_service.vision.trails import trail_of

NEARER = 0.75  # of the distance of the other end of a trail to what tells its last position: else neither is it
AGREES = 0.5  # cosine of the angle from which an arrow and a direction that is named are two things
_ON_FLOOR = frozenset({"slide", "roll", "drive", "glide", "skid"})  # such an object keeps touching its support
_RISES = frozenset({"lift", "raise", "rise", "ascend", "float"})  # what does so upwards leaves it

_T = TypeVar("_T")


class Said(TypedDict):
    """What the words say of how fast, how far and how long; fields of `MotionReading`."""

    speed: SpeedWord | Quantity | None
    distance: Quantity | None
    duration: float | None
    until: Until | None


def quantities(words: Sequence[QuantityWords], way: float | None, bbox: BBox | None = None) -> Said:
    """The quantities of one leg; `way`, px, is the distance to the goal; `bbox` is the moving object's.

    Raises `CannotReadDirection`.
    """
    distances = [each.distance for each in words if each.distance is not None]
    shares = [each.share for each in words if each.share is not None]
    if shares and way is None:
        raise CannotReadDirection(
            "The question says that it moves part of the way, but not where to.",
            remedy=f"{GIVE_DIRECTION} Or give `motion.distance`.",
        )
    distances += [Quantity(share * (way or 0.0), "px") for share in shares]
    if bbox is not None:
        x0, _, x1, _ = bbox
        distances += [Quantity(each.own_widths * (x1 - x0), "px") for each in words if each.own_widths is not None]
    speeds: list[SpeedWord | Quantity] = [each.speed for each in words if each.speed is not None]
    ends: list[Until] = [each.until for each in words if each.until is not None]
    return Said(
        speed=_one("speed", speeds),
        distance=_one("distance", distances),
        duration=_one("duration", [each.duration for each in words if each.duration is not None]),
        until=_one("end", ends),
    )


def _one(name: str, values: list[_T]) -> _T | None:
    if len(set(values)) > 1:
        raise CannotReadDirection(f"The question names more than one {name} of the motion.", remedy=GIVE_DIRECTION)
    return values[0] if values else None


def step_readings(steps: Sequence[StepWords], bbox: BBox) -> tuple[StepReading, ...]:
    """The legs behind the first of what has this box."""
    readings: list[StepReading] = []
    for step in steps:
        direction, depth = _way(step.direction, step.depth)
        said = quantities(step.quantities, None, bbox)
        readings.append(StepReading(direction, depth, said["distance"], said["duration"]))
    return tuple(readings)


def refuse_unclear_fall(scene: Scene, words: MotionWords, thing: Grounding | LocatedObject) -> None:
    """Raises `CannotReadDirection` for what falls over where it stands, and for a fall of what may stand."""
    name, prior, region = thing.object, thing.prior, scene.region_of(thing.bbox)
    is_ball = shape_of(name) == "sphere" or (region is not None and region.is_disc)  # its shadow tells how high it is
    in_air = words.in_air or is_ball or scene.side_view is not None or (prior is not None and prior.stands_on == "air")
    if words.topples and not is_ball:
        fault = f"The {name} would fall over where it stands, which is not simulated. Ask what happens if it is pushed."
    elif words.kind == "fall" and not in_air:
        fault = f"The reader cannot see whether the {name} stands or hangs. If it hangs, ask what happens if it drops."
    else:
        return
    raise CannotReadDirection(fault, remedy=GIVE_DIRECTION)


def other_readings(
    scene: Scene, others: Sequence[tuple[ObjectPhrase, MotionWords]], grounding: Grounding
) -> tuple[OtherMotionReading, ...]:
    """What else is set moving. Raises `CannotReadDirection` if it was not found, or which way is not said."""
    readings: list[OtherMotionReading] = []
    for phrase, motion in others:
        name, kind = phrase.text, motion.kind or "linear"
        found = next((each for each in grounding.others if each.object == name), None)
        if found is None:
            raise CannotReadDirection(f"'{name}' moves, too, and was not found.", remedy=GIVE_DIRECTION)
        refuse_unclear_fall(scene, motion, found)
        way, goal = (None, 0.0), None
        if kind in DIRECTED_KINDS:
            direction = motion.direction
            if direction is None and motion.towards is not None:
                things = (*grounding.others, LocatedObject(object=grounding.object, bbox=grounding.bbox))
                goal = next((each for each in things if each.object == motion.towards.text), None)
                if goal is not None:  # from centre to centre
                    (x0, y0, x1, y1), start = goal.bbox, found.bbox
                    direction = (x0 + x1 - start[0] - start[2]) / 2, (y0 + y1 - start[1] - start[3]) / 2
            way = _way(direction, motion.depth)
        speed = quantities(motion.quantities, None)["speed"]
        readings.append(OtherMotionReading(found, kind, way[0], None, way[1], speed, goal))
    return tuple(readings)


def _way(direction: Vector | None, depth: float) -> tuple[Vector, float]:
    if direction is None and depth:
        return depth_motion(depth)
    if direction is None:
        raise CannotReadDirection("Which way a part of the motion goes was not understood.", remedy=GIVE_DIRECTION)
    return direction, depth


def scene_of_mover(scene: Scene, question: Question) -> tuple[Scene, tuple[str, ...]]:
    """The scene in which the trail that the question may be about ends where the question says, and a warning.

    If neither the image nor the words show the end, it is the one whose path leads on to the object in question.
    Raises `CannotGround` if the thing that the words tell the end by was not found.
    """
    words, phrase = question.motion.trail, question.mover
    if phrase is None or not scene.trails:
        return scene, ()
    fitting = best_matches(scene.regions, phrase, question.others)
    trails = [trail for trail in (trail_of(scene.trails, region.bbox) for region in fitting) if trail is not None]
    if len(trails) != 1:
        return scene, ()
    trail, warnings = trails[0], ()
    beside = [region for region in scene.regions if trail_of((trail,), region.bbox) is None]
    if words is not None:
        near = None if words.near is None else match_one(beside, words.near)
        ends = (trail.positions[0], trail.positions[-1]) if near else ()
        gaps = sorted(math.dist(end.centre, near.centre) for end in ends if near)
        if words.near is not None and (not gaps or gaps[0] > NEARER * gaps[1]):
            raise CannotGround(
                f"The question tells the end of the trail by '{words.near.text}', which was not found, not for "
                f"certain, or about as far from either end. Seen: {describe(scene.regions)}.",
                remedy=GIVE_PLACE,
            )
        trail = trail.ending(None if near is None else near.bbox, words.side)
    if not trail.end_known:
        # What may lie ahead: the first thing that is asked about, else the middle of the image.
        asked = ((each.text, match_one(beside, each)) for each in question.others)
        x, y = scene.width / 2, scene.height / 2
        ahead = ((name, region.bbox) for name, region in asked if region is not None)
        name, bbox = next(ahead, ("middle of the image", (x, y, x, y)))
        trail = trail.ending(bbox)
        warnings = (
            f"The image shows the {phrase.text} in {len(trail.positions)} places one after another, and neither they "
            f"nor the question tell which is the last: the one nearest to the {name} was taken for it. Say otherwise "
            f'like "on along its trail, the last of which is the leftmost". {GIVE_PLACE}',
        )
    return scene.with_mover(trail.present.bbox), warnings


def along_trail(scene: Scene, grounding: Grounding, words: MotionWords) -> MotionReading | None:
    """On from the present position of the trail at the mover; None if there is none.

    Raises `CannotReadDirection` if the words speak of one all the same.
    """
    trail = trail_of(scene.trails, grounding.bbox)
    if trail is not None:
        thrown = is_thrown(trail.positions) or words.kind in FALLING_KINDS
        earlier = tuple(position.centre for position in trail.older)
        return MotionReading("projectile" if thrown else "linear", trail.heading, "trail", trail=earlier)
    if words.trail is None:
        return None
    raise CannotReadDirection(
        f"The question speaks of a trail, and no three positions of the {grounding.object} one after another were "
        f"found in the image.",
        remedy=GIVE_DIRECTION,
    )


def read_way(scene: Scene, question: Question, grounding: Grounding) -> MotionReading:
    """Kind and direction by the words, else by the only arrow or trail. Raises `CannotReadDirection`."""
    words, name = question.motion, grounding.object
    kind = words.kind or "linear"
    if question.unread_motion:
        unread = "', '".join(question.unread_motion)
        raise CannotReadDirection(f"How the {name} moves was not understood: '{unread}'.", remedy=GIVE_DIRECTION)
    if kind == "static" and question.names_direction:
        raise CannotReadDirection(
            f"The question says that the {name} does not move, and speaks of a direction all the same: "
            f"which is meant was not understood.",
            remedy=GIVE_DIRECTION,
        )
    if words.is_contradictory:
        raise CannotReadDirection(
            f"The verb '{words.verb}' and the direction that the question gives for the {name} contradict "
            f"each other: which is meant was not understood.",
            remedy=GIVE_DIRECTION,
        )
    refuse_unclear_fall(scene, words, grounding)
    if kind not in DIRECTED_KINDS:
        return MotionReading(kind, None, "gravity" if kind == "fall" else "text")
    if scene.side_view is not None and words.direction == (0.0, 1.0) and kind == "linear":
        return MotionReading("fall", None, "gravity")  # down a slope, or over an edge, by its weight
    if scene.side_view is not None and words.depth:
        raise CannotReadDirection(
            "The image is a drawing seen from the side: nothing in it moves towards the viewer, or away.",
            remedy=GIVE_DIRECTION,
        )
    said = _as_said(scene, words, kind, grounding)
    if said is not None:
        return said
    if words.forward is None:
        return along_trail(scene, grounding, words) or _along_arrow(scene, question, grounding, kind)
    # Forward or backward, by the way that a vehicle is seen to face.
    told = f"The question says that the {name} moves {'forward' if words.forward else 'backward'}."
    if not is_vehicle(name):
        raise CannotReadDirection(
            f"{told} The embedded reader sees only of vehicles with wheels which way they face.",
            remedy=GIVE_DIRECTION,
        )
    way = facing(scene.clean, scene.silhouette(grounding.bbox), grounding.bbox)
    if way is None:
        raise CannotReadDirection(f"{told} Which way it faces could not be seen for certain.", remedy=GIVE_DIRECTION)
    return MotionReading(kind, way if words.forward else (-way[0], -way[1]), "orientation")


def _as_said(scene: Scene, words: MotionWords, kind: MotionKind, grounding: Grounding) -> MotionReading | None:
    """The motion whose direction the words give; None if they give none."""
    if words.along_arrow is not None:
        x, y = arrow_of(scene, grounding, GIVE_DIRECTION).direction
        along = words.along_arrow
        x, y = (x, y) if along else (-x, -y)
        said = words.direction or (x, y)
        if x * said[0] + y * said[1] < AGREES * math.hypot(x, y) * math.hypot(*said):
            raise CannotReadDirection(
                "The question names the arrow and another direction, and the arrow does not point there.",
                remedy=GIVE_DIRECTION,
            )
        return MotionReading(kind, (x, y), "arrow", along_arrow=along)
    if words.direction is not None and words.verb in _ON_FLOOR and words.direction[0] == 0.0 and not words.depth:
        direction, depth = depth_motion(-math.copysign(1.0, words.direction[1]))  # up the image is away on the floor
        return MotionReading(kind, direction, "text", depth=depth)
    if words.direction is not None:
        rises = words.verb in _RISES and words.direction[1] < 0
        return MotionReading(kind, words.direction, "text", depth=words.depth, rises=rises)
    if words.depth:
        direction, depth = depth_motion(words.depth)
        return MotionReading(kind, direction, "text", depth=depth)
    if words.towards is not None:
        goal = goal_of(scene, words.towards, grounding)
        return MotionReading(kind, way_to(goal.bbox, grounding.bbox, kind == "linear"), "text", towards=goal)
    return None


def _along_arrow(scene: Scene, question: Question, grounding: Grounding, kind: MotionKind) -> MotionReading:
    """Along the only arrow drawn at the mover, where the question names no direction at all."""
    near = scene.arrows_near(grounding.bbox)
    if near and question.names_direction:
        raise CannotReadDirection(
            "The question has words of direction that could not be read as the motion's, so the drawn arrow was "
            "not followed either.",
            remedy=GIVE_DIRECTION,
        )
    if len(near) != 1:
        raise CannotReadDirection(
            "The question names no direction (left, right, up, down, towards, away, along the arrow), and the "
            f"image shows {len(near) or 'no'} arrow{'s' if len(near) > 1 else ''} at the {grounding.object}.",
            remedy=GIVE_DIRECTION,
        )
    note = "The question names no direction; the arrow drawn at the object was followed."
    return MotionReading(kind, near[0].direction, "arrow", along_arrow=True, warnings=(note,))


def goal_of(scene: Scene, phrase: ObjectPhrase, grounding: Grounding) -> LocatedObject:
    """The thing that the mover moves towards. Raises `CannotReadDirection`."""
    goal = next((other for other in grounding.others if other.object == phrase.text), None)
    if goal is not None:
        return goal
    besides = [each for each in scene.regions if not is_same_object(each.bbox, grounding.bbox)]
    region = match_one(besides, phrase)
    if region is None:
        told = unclear(phrase, best_matches(besides, phrase), besides)
        raise CannotReadDirection(f"Where the {grounding.object} moves to is not clear: {told}.", remedy=GIVE_DIRECTION)
    return LocatedObject(object=phrase.text, bbox=region.bbox)
