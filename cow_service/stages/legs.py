"""Further legs of a motion, and other things that move at the same time: from what is said to records."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cow_service.errors import FieldError, InvalidRequest
from cow_service.readers.base import OtherMotionReading, Quantity, StepReading
from cow_service.readers.question.wording import bare_name, direction_words, same_name
from cow_service.records import DIRECTED_KINDS, AlsoMoving, Grounding, LocatedObject, MotionStep, Vector
from cow_service.requests import MotionStepRequest, OtherMotionRequest
from cow_service.stages.quantities import Measures


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
