"""How a thing moves by the words of a question: its direction in the image, and what they say of speed and distance."""

import math
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

from cow_service import records
from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.media.masks import is_same_object
from cow_service.perception.classical.trails import trail_of
from cow_service.perception.observation import Observation
from cow_service.physics.camera import depth_motion, way_to
from cow_service.readers.base import GIVE_DIRECTION, GIVE_PLACE
from cow_service.readers.embedded.english.lexicon import ObjectPhrase, QuantityWords
from cow_service.readers.embedded.english.noun_phrases import kind_of, prior_of
from cow_service.readers.embedded.english.questions import MotionWords, Question
from cow_service.readers.embedded.matching import best_matches, match_one, unclear
from cow_service.records import DIRECTED_KINDS, BBox, MotionKind, MotionRequest, ObjectRequest, Vector

NEARER = 0.75  # of the distance of the other end of a trail to what tells its last position: else neither is it
_ON_FLOOR = frozenset({"slide", "roll", "drive", "glide", "skid"})  # such an object keeps touching its support
_ANY_THING = frozenset({"object", "thing", "item"})
_RISES = frozenset({"lift", "raise", "rise", "ascend", "float"})  # what does so upwards leaves it


def _refused(fault: str) -> CannotReadDirection:
    return CannotReadDirection(fault, remedy=GIVE_DIRECTION)


def settled_kind(question: Question) -> MotionKind | None:
    """The kind of motion of a question whose words leave open only which way, and where the things are; else None.

    Open is also how fast, how far and along which trail something moves, whether what falls stands, and what is meant
    by words for several things, for any of some, or for none in particular.
    """
    words, asked = question.motion, question.asked
    changed = (each for change in question.changes for each in (change.object, *change.targets))
    is_named = all(
        each is not None and not each.is_other and each.head not in _ANY_THING and kind_of(each.text) is None
        for each in (question.mover, *question.others, *changed)
    )
    is_open = words.quantities or words.steps or words.others or words.trail or words.topples or words.is_contradictory
    is_open = is_open or (words.kind == "fall" and not words.in_air)
    is_open = is_open or not all(change.is_whole for change in question.changes)
    if asked is None or asked.among or asked.form.startswith("which") or is_open or not is_named:
        return None
    return words.kind


def quantities(
    words: Sequence[QuantityWords], way: float | None, bbox: BBox
) -> tuple[records.SpeedWord | records.Speed | None, records.Distance | None, float | None, records.Until | None]:
    """Speed, distance, duration (s) and end of one leg; `way`, px, is the distance to the goal; `bbox` is the mover's.

    Raises `CannotReadDirection`.
    """
    found: dict[str, QuantityWords] = {}
    for each in words:
        what = "distance" if each.what in {"share", "own_widths"} else each.what
        if found.setdefault(what, each) != each:
            raise _refused(f"The question names more than one {what} of the motion.")
    speed, length, duration = (found.get(what) for what in ("speed", "distance", "duration"))
    distance = None if length is None else records.Distance(value=length.value, unit="m" if length.is_metric else "px")
    if length is not None and length.what == "share" and way is None:
        raise _refused("The question says that it moves part of the way, but not where to.")
    if length is not None and length.what != "distance":
        whole = (way or 0.0) if length.what == "share" else bbox[2] - bbox[0]
        distance = records.Distance(value=length.value * whole, unit="px")
    pace = None if speed is None else speed.pace
    if speed is not None and pace is None:
        pace = records.Speed(value=speed.value, unit="m/s" if speed.is_metric else "px/s")
    return pace, distance, None if duration is None else duration.value, "contact" if "until" in found else None


def _way(motion: MotionWords, direction: Vector | None = None) -> tuple[Vector, float]:
    direction = direction or motion.direction
    if direction is None and not motion.depth:
        raise _refused("Which way a part of the motion goes was not understood.")
    return depth_motion(motion.depth) if direction is None else (direction, motion.depth)


def steps_of(steps: Sequence[MotionWords], bbox: BBox) -> tuple[records.MotionStepRequest, ...]:
    """The legs behind the first of what has this box."""
    found = list[records.MotionStepRequest]()
    for step in steps:
        direction, depth = _way(step)
        _, distance, duration, _ = quantities(step.quantities, None, bbox)
        found.append(records.MotionStepRequest(direction=direction, depth=depth, distance=distance, duration=duration))
    return tuple(found)


def others_of(
    others: Sequence[tuple[ObjectPhrase, MotionWords]], observation: Observation, things: Sequence[ObjectRequest]
) -> tuple[records.OtherMotionRequest, ...]:
    """What else is set moving. Raises `CannotReadDirection` if it was not found, or which way is not said."""
    readings: list[records.OtherMotionRequest] = []
    for phrase, motion in others:
        found = next((each for each in things if each.object == phrase.text), None)
        if found is None or motion.steps or any(each.what != "speed" for each in motion.quantities):
            raise _refused(f"'{phrase.text}' moves, too, and was not found, or how far it moves is said.")
        refuse_unclear_fall(observation, motion, found)
        kind, said = motion.kind or "linear", dict[str, Any]()
        if kind in DIRECTED_KINDS:
            goal = None if motion.direction or motion.towards is None else motion.towards.text
            said |= {"towards": goal} if goal else dict(zip(("direction", "depth"), _way(motion), strict=True))
            said["speed"] = quantities(motion.quantities, None, found.bbox or (0.0, 0.0, 0.0, 0.0))[0]
        readings.append(records.OtherMotionRequest.model_validate({"object": phrase.text, "kind": kind, **said}))
    return tuple(readings)


def refuse_unclear_fall(
    observation: Observation, words: MotionWords, thing: records.GroundingRequest | ObjectRequest
) -> None:
    """Raises `CannotReadDirection` for what falls over where it stands, and for a fall of what may stand."""
    name = thing.object or ""
    found = None if thing.bbox is None else observation.thing_in(thing.bbox)
    # The shadow of a ball tells how high it is.
    is_ball = prior_of(name).shape == "sphere" or (found is not None and found.is_disc)
    in_air = words.in_air or is_ball or observation.side_view is not None or thing.stands_on == "air"
    if words.topples and not is_ball:
        raise _refused(f"The {name} would fall over where it stands, which is not simulated. Ask what a push does.")
    if words.kind == "fall" and not in_air:
        raise _refused(f"Whether the {name} stands or hangs cannot be seen. If it hangs, say that it is dropped.")


def with_trail_as_said(observation: Observation, question: Question) -> tuple[Observation, tuple[str, ...]]:
    """What is seen where the trail that the question may be about ends where it says, and a warning.

    If neither the image nor the words show the end, it is the one whose path leads on to the object in question.
    Raises `CannotGround` if the thing that the words tell the end by was not found.
    """
    end, phrase = question.motion.trail_end, question.mover
    if phrase is None or phrase.is_given or not observation.trails:
        return observation, ()
    found = (trail_of(observation.trails, thing.bbox) for thing in best_matches(observation.things, phrase))
    trails = [trail for trail in found if trail is not None]
    if len(trails) != 1:
        return observation, ()
    trail, warnings = trails[0], ()
    beside = [thing for thing in observation.things if trail_of((trail,), thing.bbox) is None]
    if isinstance(end, ObjectPhrase):
        near = match_one(beside, end)
        gaps = sorted(math.dist(trail.positions[at].centre, near.centre) for at in (0, -1)) if near else []
        if near is None or gaps[0] > NEARER * gaps[1]:
            told = f"'{end.text}', which was not found for certain, or is about as far from either end"
            raise CannotGround(f"The question tells the end of the trail by {told}.", remedy=GIVE_PLACE)
        trail = trail.ending(near.bbox)
    elif question.motion.trail:
        trail = trail.ending(None, end or question.motion.direction)
    if not trail.end_known:
        # What may lie ahead: the first thing that is asked about, else the middle of the image.
        asked = ((each.text, match_one(beside, each)) for each in question.others)
        x, y = observation.width / 2, observation.height / 2
        ahead = ((name, thing.bbox) for name, thing in asked if thing is not None)
        name, bbox = next(ahead, ("middle of the image", (x, y, x, y)))
        trail = trail.ending(bbox)
        warnings = (
            f"The image shows the {phrase.text} in {len(trail.positions)} places one after another, and neither they "
            f"nor the question tell which is the last: the one nearest to the {name} was taken for it. Say otherwise "
            f'like "on along its trail, the last of which is the leftmost". {GIVE_PLACE}',
        )
    return observation.with_mover(trail.present.bbox), warnings


def said_way(words: MotionWords, kind: MotionKind) -> dict[str, object]:
    """Fields of a motion: which way it leads by its words alone, if they say it."""
    way, towards, said = words.direction, words.towards, dict[str, object]()
    on_floor = way is not None and words.verb in _ON_FLOOR and way[0] == 0.0 and not words.depth
    if kind not in DIRECTED_KINDS:
        return {}
    if words.trail:
        said = {"cue": "trail"}
    elif words.along_arrow is not None:
        said = {"along_arrow": words.along_arrow, "direction": way}
    elif way is not None and not on_floor:
        rises = kind == "linear" and words.verb in _RISES and way[1] < 0
        said = {"direction": way, "cue": "text", "depth": words.depth or None, "rises": rises or None}
    elif words.depth or way is not None:  # up the image is away on the floor
        direction, depth = depth_motion(words.depth or (0.0 if way is None else -math.copysign(1.0, way[1])))
        said = {"direction": direction, "depth": depth, "cue": "text"}
    else:
        said = {"towards": None if towards is None else towards.text, "forward": words.forward}
    return {name: value for name, value in said.items() if value is not None}


def read_motion(
    question: Question, observation: Observation, mover: records.GroundingRequest, things: Sequence[ObjectRequest]
) -> MotionRequest:
    """How the mover moves by the words, without the image's say in which way. Raises `CannotReadDirection`."""
    words, name, bbox = question.motion, mover.object, mover.bbox or (0.0, 0.0, 0.0, 0.0)
    kind = words.kind or "linear"
    if question.unread_motion:
        unread = "', '".join(question.unread_motion)
        raise _refused(f"How the {name} moves was not understood: '{unread}'.")
    if words.is_contradictory or (kind == "static" and question.names_direction):
        raise _refused(f"What the question says of the motion of the {name} contradicts itself.")
    refuse_unclear_fall(observation, words, mover)
    if kind in DIRECTED_KINDS and observation.side_view is not None:
        if words.direction == (0.0, 1.0) and kind == "linear":
            kind = "fall"  # down a slope, or over an edge, by its weight
        elif words.depth:
            raise _refused("The image is a drawing seen from the side: nothing moves towards the viewer, or away.")
    way = said_way(words, kind)
    if words.along_arrow is not None:  # which is surer than the words beside it
        way.pop("direction", None)
    if kind in DIRECTED_KINDS and not way and question.names_direction:
        unread = "', '".join(question.unread)
        raise _refused(f"Which way the {name} moves was not understood: '{unread}'.")
    goal = goal_of(observation, words.towards, mover, things) if "towards" in way and words.towards else None
    ahead = None if goal is None else way_to(goal, bbox, kind == "linear")
    if ahead is not None and all(each.object != way["towards"] for each in things):  # only here it is known where
        way |= {"direction": ahead, "cue": "text"}
    far = None if ahead is None else math.hypot(*ahead)
    try:
        speed, distance, duration, until = quantities(words.quantities, far, bbox)
        said = {"speed": speed if kind in DIRECTED_KINDS else None, "distance": distance, "duration": duration}
        said |= {
            "until": until,
            "steps": steps_of(words.steps, bbox),
            "others": others_of(words.others, observation, things),
        }
        return MotionRequest.model_validate({"kind": kind, **way, **{k: v for k, v in said.items() if v}})
    except ValidationError as error:
        fault = error.errors()[0]
        raise _refused(f"How far, how fast or how long the {name} moves cannot be used: {fault['msg']}.") from error


def goal_of(
    observation: Observation, phrase: ObjectPhrase, mover: records.GroundingRequest, things: Sequence[ObjectRequest]
) -> BBox:
    """The box of the thing that the mover moves towards. Raises `CannotReadDirection`."""
    goal = next((each.bbox for each in things if each.object == phrase.text), None)
    besides = [each for each in observation.things if not is_same_object(each.bbox, mover.bbox or each.bbox)]
    thing = match_one(besides, phrase)
    if goal is not None:
        return goal
    if thing is None:
        raise _refused(f"Where the {mover.object} moves to is not clear: {unclear(phrase, besides)}.")
    return thing.bbox
