"""Checks what a multimodal LLM says of places and directions against what can be measured in the image."""

from __future__ import annotations

import math
from dataclasses import replace

from cow_service.readers.base import MotionReading
from cow_service.readers.embedded.english.motion import ArrowSense
from cow_service.records import BBox, Vector
from cow_service.vision.arrow_choice import arrow_at
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU
from cow_service.vision.scene import Scene

ARROW_TOLERANCE = 25.0  # degrees between an arrow and what was read of it; past that the arrow is right
MAX_BOX_SHARE = 0.9  # of the image: a box that covers so much is hardly that of one object


def follow_arrow(scene: Scene, bbox: BBox, reading: MotionReading, sense: ArrowSense | None) -> MotionReading:
    """The reading, with the direction of the arrow drawn at the object where the two are at odds.

    For questions that speak of an arrow. `sense` is what the question says in words: along it, against it, or
    nothing that rules can read; then the reading's own `along_arrow` counts, and without one only the axis does.
    """
    arrow = arrow_at(scene, bbox)
    if arrow is None or reading.direction is None:
        return reading
    along = sense == "along" if sense is not None else reading.along_arrow
    if along is None:
        along = angle(reading.direction, arrow.direction) <= 90
    sign = 1.0 if along else -1.0
    drawn = sign * arrow.direction[0], sign * arrow.direction[1]
    off = angle(reading.direction, drawn)
    if off <= ARROW_TOLERANCE:
        return reading
    warning = (
        f"The reader's direction is {off:.0f} degrees off the arrow drawn at the object "
        f"(followed {'along' if along else 'against'} it): the arrow was taken."
    )
    return replace(
        reading,
        direction=drawn,
        cue="arrow",
        along_arrow=along,
        sentence=None,  # it was worded for another direction
        warnings=(*reading.warnings, warning),
    )


def box_warnings(scene: Scene, bbox: BBox, colour: str | None, clipped: bool) -> tuple[str, ...]:
    """What speaks against a box that was given for an object of a colour; empty where nothing does.

    `clipped`: the box reached over the image's edge.
    """
    found: list[str] = []
    if clipped:
        found.append("The reader's box reaches over the image's edge; it was cut off there.")
    if covers_image(scene.width, scene.height, bbox):
        found.append("The reader's box covers nearly the whole image: it may not be that of one object.")
    here = None if colour is None else scene.region_of(bbox)
    if here is not None and colour not in {here.colour, *here.colours}:
        matching = [r for r in scene.regions if r.colour == colour and iou(r.bbox, bbox) < SAME_OBJECT_IOU]
        if matching:
            x, y = matching[0].centre
            found.append(
                f"The reader's box is around something {here.colour}, while something {colour} is at "
                f"({x:.0f}, {y:.0f}): the box may be wrong."
            )
    return tuple(found)


def covers_image(width: int, height: int, bbox: BBox) -> bool:
    """Whether a box covers nearly the whole image of `width` x `height` px."""
    x0, y0, x1, y1 = bbox
    return (x1 - x0) * (y1 - y0) > MAX_BOX_SHARE * width * height


def angle(a: Vector, b: Vector) -> float:
    """Degrees between two vectors, 0 to 180."""
    return abs(math.degrees(math.atan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1])))
