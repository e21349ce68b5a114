"""How a thing moves by the words of a question: its direction in the image, and what they say of speed and distance."""

import math
from collections.abc import Sequence

from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.perception.facing import facing
from cow_service.physics.camera import depth_motion, way_to
from cow_service.physics.trail_fit import is_thrown
from cow_service.readers.base import MotionReading, OtherMotionReading, Quantity, SpeedWord, StepReading
from cow_service.readers.embedded.english.lexicon import ObjectPhrase, QuantityWords
from cow_service.readers.embedded.english.noun_phrases import kind_of, prior_of
from cow_service.readers.embedded.english.questions import MotionWords, Question
from cow_service.readers.embedded.matching import best_matches, match_one, unclear
from cow_service.readers.remedies import GIVE_DIRECTION, GIVE_PLACE
from cow_service.records import DIRECTED_KINDS, FALLING_KINDS, BBox, Grounding, LocatedObject, MotionKind, Until, Vector
from cow_service.vision.masks import is_same_object
from cow_service.vision.scene import Scene, arrow_of
from cow_service.vision.trails import trail_of

NEARER = 0.75  # of the distance of the other end of a trail to what tells its last position: else neither is it
AGREES = 0.5  # cosine of the angle from which an arrow and a direction that is named are two things
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
    is_open = is_open or any(change.kind == "place" and not change.targets for change in question.changes)
    if asked is None or asked.among or asked.form.startswith("which") or is_open or not is_named:
        return None
    return words.kind


def quantities(
    words: Sequence[QuantityWords], way: float | None, bbox: BBox
) -> tuple[SpeedWord | Quantity | None, Quantity | None, float | None, Until | None]:
    """Speed, distance, duration (s) and end of one leg; `way`, px, is the distance to the goal; `bbox` is the mover's.

    Raises `CannotReadDirection`.
    """
    found: dict[str, QuantityWords] = {}
    for each in words:
        what = "distance" if each.what in {"share", "own_widths"} else each.what
        if found.setdefault(what, each) != each:
            raise _refused(f"The question names more than one {what} of the motion.")
    speed, length, duration = (found.get(what) for what in ("speed", "distance", "duration"))
    distance = None if length is None else Quantity(length.value, "m" if length.is_metric else "px")
    if length is not None and length.what == "share" and way is None:
        raise _refused("The question says that it moves part of the way, but not where to.")
    if length is not None and length.what != "distance":
        distance = Quantity(length.value * ((way or 0.0) if length.what == "share" else bbox[2] - bbox[0]), "px")
    pace = None if speed is None else speed.pace or Quantity(speed.value, "m/s" if speed.is_metric else "px/s")
    return pace, distance, None if duration is None else duration.value, "contact" if "until" in found else None


def _way(motion: MotionWords, direction: Vector | None = None) -> tuple[Vector, float]:
    direction = direction or motion.direction
    if direction is None and not motion.depth:
        raise _refused("Which way a part of the motion goes was not understood.")
    return depth_motion(motion.depth) if direction is None else (direction, motion.depth)


def step_readings(steps: Sequence[MotionWords], bbox: BBox) -> tuple[StepReading, ...]:
    """The legs behind the first of what has this box."""
    return tuple(StepReading(*_way(step), *quantities(step.quantities, None, bbox)[1:3]) for step in steps)


def other_readings(
    others: Sequence[tuple[ObjectPhrase, MotionWords]], scene: Scene, grounding: Grounding
) -> tuple[OtherMotionReading, ...]:
    """What else is set moving. Raises `CannotReadDirection` if it was not found, or which way is not said."""
    readings: list[OtherMotionReading] = []
    things = (*grounding.others, LocatedObject(object=grounding.object, bbox=grounding.bbox))
    for phrase, motion in others:
        found = next((each for each in grounding.others if each.object == phrase.text), None)
        goal = next((each for each in things if motion.towards and each.object == motion.towards.text), None)
        if found is None or motion.steps or any(each.what != "speed" for each in motion.quantities):
            raise _refused(f"'{phrase.text}' moves, too, and was not found, or how far it moves is said.")
        refuse_unclear_fall(scene, motion, found)
        kind = motion.kind or "linear"
        ahead = None if motion.direction or goal is None else way_to(goal.bbox, found.bbox, is_on_floor=False)
        way = _way(motion, ahead) if kind in DIRECTED_KINDS else (None, 0.0)
        speed = quantities(motion.quantities, None, found.bbox)[0]
        readings.append(OtherMotionReading(found, kind, way[0], None, way[1], speed, goal))
    return tuple(readings)


def refuse_unclear_fall(scene: Scene, words: MotionWords, thing: Grounding | LocatedObject) -> None:
    """Raises `CannotReadDirection` for what falls over where it stands, and for a fall of what may stand."""
    name, prior, region = thing.object, thing.prior, scene.region_of(thing.bbox)
    # The shadow of a ball tells how high it is.
    is_ball = prior_of(name).shape == "sphere" or (region is not None and region.is_disc)
    in_air = words.in_air or is_ball or scene.side_view is not None or (prior is not None and prior.stands_on == "air")
    if words.topples and not is_ball:
        raise _refused(f"The {name} would fall over where it stands, which is not simulated. Ask what a push does.")
    if words.kind == "fall" and not in_air:
        raise _refused(f"Whether the {name} stands or hangs cannot be seen. If it hangs, say that it is dropped.")


def scene_of_mover(scene: Scene, question: Question) -> tuple[Scene, tuple[str, ...]]:
    """The scene in which the trail that the question may be about ends where the question says, and a warning.

    If neither the image nor the words show the end, it is the one whose path leads on to the object in question.
    Raises `CannotGround` if the thing that the words tell the end by was not found.
    """
    end, phrase = question.motion.trail_end, question.mover
    if phrase is None or phrase.is_given or not scene.trails:
        return scene, ()
    found = (trail_of(scene.trails, region.bbox) for region in best_matches(scene.regions, phrase))
    trails = [trail for trail in found if trail is not None]
    if len(trails) != 1:
        return scene, ()
    trail, warnings = trails[0], ()
    beside = [region for region in scene.regions if trail_of((trail,), region.bbox) is None]
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
    if trail is None:
        if words.trail:
            told = f"no three positions of the {grounding.object} one after another were found in the image"
            raise _refused(f"The question speaks of a trail, and {told}.")
        return None
    thrown = is_thrown(trail.positions) or words.kind in FALLING_KINDS
    earlier = tuple(position.centre for position in trail.older)
    return MotionReading("projectile" if thrown else "linear", trail.heading, "trail", trail=earlier)


def read_way(scene: Scene, question: Question, grounding: Grounding) -> MotionReading:
    """Kind and direction by the words, else by the only arrow or trail. Raises `CannotReadDirection`."""
    words, name = question.motion, grounding.object
    kind = words.kind or "linear"
    if question.unread_motion:
        unread = "', '".join(question.unread_motion)
        raise _refused(f"How the {name} moves was not understood: '{unread}'.")
    if words.is_contradictory or (kind == "static" and question.names_direction):
        raise _refused(f"What the question says of the motion of the {name} contradicts itself.")
    refuse_unclear_fall(scene, words, grounding)
    if kind not in DIRECTED_KINDS:
        return MotionReading(kind, None, "gravity" if kind == "fall" else "text")
    if scene.side_view is not None and words.direction == (0.0, 1.0) and kind == "linear":
        return MotionReading("fall", None, "gravity")  # down a slope, or over an edge, by its weight
    if scene.side_view is not None and words.depth:
        raise _refused("The image is a drawing seen from the side: nothing in it moves towards the viewer, or away.")
    said = _as_said(scene, words, kind, grounding)
    if said is not None:
        return said
    if words.forward is None:
        return along_trail(scene, grounding, words) or _along_arrow(scene, question, grounding, kind)
    # Forward or backward, by the way that a vehicle is seen to face.
    told = f"The question says that the {name} moves {'forward' if words.forward else 'backward'}."
    if not prior_of(name).elongated:
        raise _refused(f"{told} The embedded reader sees only of vehicles with wheels which way they face.")
    way = facing(scene.clean, scene.silhouette(grounding.bbox), grounding.bbox)
    if way is None:
        raise _refused(f"{told} Which way it faces could not be seen for certain.")
    return MotionReading(kind, way if words.forward else (-way[0], -way[1]), "orientation")


def _as_said(scene: Scene, words: MotionWords, kind: MotionKind, grounding: Grounding) -> MotionReading | None:
    """The motion whose direction the words give; None if they give none."""
    if words.along_arrow is not None:
        x, y = arrow_of(scene, grounding, GIVE_DIRECTION).direction
        x, y = (x, y) if words.along_arrow else (-x, -y)
        said = words.direction or (x, y)
        if x * said[0] + y * said[1] < AGREES * math.hypot(x, y) * math.hypot(*said):
            raise _refused("The question names the arrow and another direction, and the arrow does not point there.")
        return MotionReading(kind, (x, y), "arrow", along_arrow=words.along_arrow)
    on_floor = words.direction is not None and words.verb in _ON_FLOOR and words.direction[0] == 0.0 and not words.depth
    if words.direction is not None and not on_floor:
        rises = words.verb in _RISES and words.direction[1] < 0
        return MotionReading(kind, words.direction, "text", depth=words.depth, rises=rises)
    if words.depth or words.direction is not None:  # up the image is away on the floor
        up = 0.0 if words.direction is None else -math.copysign(1.0, words.direction[1])
        direction, depth = depth_motion(words.depth or up)
        return MotionReading(kind, direction, "text", depth=depth)
    if words.towards is not None:
        goal = goal_of(scene, words.towards, grounding)
        return MotionReading(kind, way_to(goal.bbox, grounding.bbox, kind == "linear"), "text", towards=goal)
    return None


def _along_arrow(scene: Scene, question: Question, grounding: Grounding, kind: MotionKind) -> MotionReading:
    """Along the only arrow drawn at the mover, where the question names no direction at all."""
    near = scene.arrows_near(grounding.bbox)
    if len(near) == 1 and not question.names_direction:
        note = "The question names no direction; the arrow drawn at the object was followed."
        return MotionReading(kind, near[0].direction, "arrow", along_arrow=True, warnings=(note,))
    raise _refused(
        "No direction was read in the question (left, right, up, down, towards, away, along the arrow), and the image "
        f"shows {len(near) or 'no'} arrow{'s' * (len(near) != 1)} at the {grounding.object}, and none was followed."
    )


def goal_of(scene: Scene, phrase: ObjectPhrase, grounding: Grounding) -> LocatedObject:
    """The thing that the mover moves towards. Raises `CannotReadDirection`."""
    goal = next((other for other in grounding.others if other.object == phrase.text), None)
    besides = [each for each in scene.regions if not is_same_object(each.bbox, grounding.bbox)]
    region = match_one(besides, phrase) if goal is None else None
    if goal is None and region is None:
        raise _refused(f"Where the {grounding.object} moves to is not clear: {unclear(phrase, besides)}.")
    return goal or LocatedObject(object=phrase.text, bbox=region.bbox if region is not None else grounding.bbox)
