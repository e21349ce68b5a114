"""What is said, seen and read of one thing, settled: the surer source decides, and what contradicts it is a doubt.

Pure functions, without a look at an image or a call of a model.
"""

import math
from dataclasses import dataclass, replace

from cow_service.physics.camera import way_to
from cow_service.physics.lift import DIRECTION_DEVIATIONS
from cow_service.readers.base import GroundingReading, MotionReading, QuestionReading, WayReading
from cow_service.records import Asked, BBox, Cue, LocatedObject, Vector

APART = 2.0  # spreads between two sources from which they contradict each other
WORDS_APART = 60.0  # degrees between a drawn arrow and a direction in words, which is a rough one: "to the right"


@dataclass(frozen=True)
class SeenWay:
    """What the image shows of the way of what moves."""

    arrow: Vector | None = None  # of the arrow that is drawn at it
    goal: LocatedObject | None = None  # where the thing is that the words have it move towards


def settle_way(read: MotionReading, said: WayReading, seen: SeenWay, mover: BBox) -> MotionReading:
    """The reading, with its direction by the surest source: a drawn arrow, then the words, then what was read.

    An arrow gives an axis. Its sense is that of the words, else as read. What is more than two spreads away from that
    makes the direction doubtful. A direction that was not estimated stays as it is.
    """
    if read.direction_deviation is None:
        return read
    settled = _by_arrow(read, said, seen.arrow) or _by_words(read, said, seen.goal, mover)
    if settled is None or settled.direction is None:
        return read
    warnings: list[str] = []
    words = said.direction
    if settled.cue == "arrow" and words is not None and angle(words, settled.direction) > WORDS_APART:
        warnings.append(
            "The question's words for the direction and the arrow drawn at the object contradict each other."
        )
    off = 0.0 if read.direction is None else angle(read.direction, settled.direction)
    if off > APART * math.hypot(read.direction_deviation, DIRECTION_DEVIATIONS[settled.cue]):
        taken = "the arrow drawn at the object" if settled.cue == "arrow" else "the question's words"
        warnings.append(f"The reader's direction is {off:.0f} degrees off what was taken, {taken}.")
    if not warnings:
        return settled
    # Its sentence was worded for another direction.
    return replace(settled, is_doubtful=True, sentence=None, warnings=(*read.warnings, *warnings))


def _by_arrow(read: MotionReading, said: WayReading, arrow: Vector | None) -> MotionReading | None:
    if arrow is None:
        return None
    along = read.along_arrow if said.along_arrow is None else said.along_arrow
    if along is None:
        rough = said.direction or read.direction
        along = rough is None or angle(rough, arrow) <= 90
    sign = 1.0 if along else -1.0
    return _taken(read, (sign * arrow[0], sign * arrow[1]), "arrow", along)


def _by_words(read: MotionReading, said: WayReading, goal: LocatedObject | None, mover: BBox) -> MotionReading | None:
    if said.direction is not None:
        return _taken(read, said.direction, "text")
    if goal is None:
        return None
    return replace(_taken(read, way_to(goal.bbox, mover, is_on_floor=read.kind == "linear"), "text"), towards=goal)


def _taken(read: MotionReading, direction: Vector, cue: Cue, along: bool | None = None) -> MotionReading:
    return replace(read, direction=direction, cue=cue, along_arrow=along, direction_deviation=None)


def settle_question(
    given: Asked | None, read: GroundingReading, said: QuestionReading
) -> tuple[Asked | None, tuple[str, ...]]:
    """What is asked, and what speaks against how the question was read: its words decide what they plainly say.

    What is given needs no reading. Names stay as they were read: the things that were found have them. Words that were
    not understood say nothing.
    """
    asked, plain, doubts = read.asked or said.asked, said.asked, list[str]()
    if given is not None:
        asked = given
    elif asked is not None and plain is not None:
        words = {"form": plain.form, "relation": plain.relation, "negated": plain.negated}
        followed = asked.model_copy(update=words)
        if followed != asked:
            doubts.append("The reader takes the question for another one than its words say: the words were followed.")
            asked = followed
    removed = [sum(each.kind == "remove" for each in changes) for changes in (said.changes, read.interventions)]
    if removed[0] != removed[1]:
        doubts.append("The question's words take {} things away beforehand, the reader {}.".format(*removed))
    return asked, tuple(doubts)


def angle(a: Vector, b: Vector) -> float:
    """Degrees between two vectors, 0 to 180."""
    return abs(math.degrees(math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])))
