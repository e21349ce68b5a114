"""Holds what a multimodal LLM says of places and directions against what can be measured in the image."""

from __future__ import annotations

import math

from cow_service.readers.base import MotionReading
from cow_service.readers.question.arrow_words import ArrowSense
from cow_service.readers.question.phrases import ObjectPhrase
from cow_service.records import BBox, Vector
from cow_service.vision.arrow_choice import gap
from cow_service.vision.arrows import Arrow
from cow_service.vision.scene import SAME_OBJECT, Scene, iou

ARROW_AGREES = 25.0  # degrees between an arrow and what was read of it; past that the arrow is right
AT_OBJECT = 1.5  # sizes of the object: an arrow further away is not its own
NEARER = 0.6  # of the distance of any other arrow, for one to be the object's for certain
TOO_LARGE = 0.9  # of the image: a box that covers so much is hardly that of one object


def follow_arrow(scene: Scene, bbox: BBox, reading: MotionReading, sense: ArrowSense | None) -> MotionReading:
    """The reading, with the direction of the arrow drawn at the object where the two are at odds.

    For questions that speak of an arrow. `sense` is what the question says in words: along it, against it, or
    nothing that rules can read; then the reading's own word for it counts, and without one only the axis does.
    """
    arrow = _arrow_at(scene, bbox)
    if arrow is None or reading.direction is None or reading.depth:
        return reading
    along = sense == "along" if sense is not None else reading.along_arrow
    if along is None:
        along = angle(reading.direction, arrow.direction) <= 90
    sign = 1.0 if along else -1.0
    drawn = sign * arrow.direction[0], sign * arrow.direction[1]
    off = angle(reading.direction, drawn)
    if off <= ARROW_AGREES:
        return reading
    told = (
        f"The reader's direction is {off:.0f} degrees off the arrow drawn at the object "
        f"(followed {'along' if along else 'against'} it): the arrow was taken."
    )
    return MotionReading(
        kind=reading.kind,
        direction=drawn,
        cue="arrow",
        along_arrow=along,
        metres_per_pixel=reading.metres_per_pixel,
        down=reading.down,
        sentence=None,  # it was worded for another direction
        warnings=(*reading.warnings, told),
    )


def doubt_box(scene: Scene, bbox: BBox, phrase: ObjectPhrase | None, cut_off: bool) -> tuple[str, ...]:
    """What speaks against a box that was given for an object; empty where nothing does."""
    x0, y0, x1, y1 = bbox
    found: list[str] = []
    if cut_off:
        found.append("The reader's box reaches over the image's edge; it was cut off there.")
    if (x1 - x0) * (y1 - y0) > TOO_LARGE * scene.width * scene.height:
        found.append("The reader's box covers nearly the whole image: it may not be that of one object.")
    colour = None if phrase is None else phrase.colour
    if colour is not None:
        found += _doubt_colour(scene, bbox, colour)
    return tuple(found)


def angle(a: Vector, b: Vector) -> float:
    """Degrees between two vectors, 0 to 180."""
    return abs(math.degrees(math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])))


def _arrow_at(scene: Scene, bbox: BBox) -> Arrow | None:
    """The arrow drawn at an object; None where there is none, or it may be another's."""
    ranked = sorted(scene.arrows, key=lambda arrow: gap(arrow, bbox))
    if not ranked or gap(ranked[0], bbox) > AT_OBJECT:
        return None
    rivals = ranked[1:]
    return None if rivals and gap(ranked[0], bbox) > NEARER * gap(rivals[0], bbox) else ranked[0]


def _doubt_colour(scene: Scene, bbox: BBox, colour: str) -> list[str]:
    """Whether what is in the box has another colour while something elsewhere has the right one."""
    here = scene.region_of(bbox)
    elsewhere = [r for r in scene.regions if r.colour == colour and iou(r.bbox, bbox) < SAME_OBJECT]
    if here is None or colour in {here.colour, *here.colours} or not elsewhere:
        return []
    x, y = elsewhere[0].centre
    return [
        f"The reader's box is around something {here.colour}, while something {colour} is at ({x:.0f}, {y:.0f}): "
        "the box may be wrong."
    ]
