"""Stage 1: which object moves, and where it is."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from cow_service.errors import FieldError, InvalidRequest
from cow_service.readers.base import Look
from cow_service.records import Artifact, BBox, Grounding, Point
from cow_service.requests import GroundingRequest
from cow_service.vision.scene import Scene

DEFAULT_NAME = "object"


def ground(
    scene: Scene,
    given: GroundingRequest | None,
    look: Callable[[], Look],
    keep_mask: Callable[[NDArray[np.bool_]], Artifact],
) -> tuple[Grounding, tuple[str, ...]]:
    """The mover, from the request where it says so, else from a reader's look; and warnings.

    Its mask [H, W] is kept.

    Raises `InvalidRequest` for a place outside the image, and what the reader raises.
    """
    if given is not None:
        bbox = _bbox_given(scene, given)
        name, others, point, source = given.object or DEFAULT_NAME, (), None, "request"
        warnings = _guessed(scene, given, bbox)
    else:
        reading = look().ground()
        bbox, name, others, point, source = (
            reading.bbox,
            reading.object,
            reading.others,
            reading.point,
            look().source,
        )
        warnings = reading.warnings
    grounding = Grounding(
        object=name,
        point=point or _centre(bbox),
        bbox=bbox,
        mask=keep_mask(scene.silhouette(bbox)),
        others=others,
        source=source,
    )
    return grounding, warnings


def _guessed(scene: Scene, given: GroundingRequest, bbox: BBox) -> tuple[str, ...]:
    """A doubt about an outline that was drawn around a point in a cluttered place."""
    if given.point is None or scene.region_of(bbox) is not None:
        return ()
    box = ", ".join(f"{value:.0f}" for value in bbox)
    return (f"The object around the point was guessed to be [{box}]; `grounding.bbox` says it for certain.",)


def _bbox_given(scene: Scene, given: GroundingRequest) -> BBox:
    if given.point is not None:
        x, y = given.point
        if not (0 <= x < scene.width and 0 <= y < scene.height):
            raise _outside("/grounding/point", list(given.point), scene)
        return scene.bbox_at(given.point)
    x0, y0, x1, y1 = given.bbox or (0.0, 0.0, 0.0, 0.0)
    clipped = max(0.0, x0), max(0.0, y0), min(float(scene.width), x1), min(float(scene.height), y1)
    if clipped[2] - clipped[0] < 2 or clipped[3] - clipped[1] < 2:
        raise _outside("/grounding/bbox", [x0, y0, x1, y1], scene)
    return clipped


def _outside(pointer: str, value: list[float], scene: Scene) -> InvalidRequest:
    detail = f"{value} lies outside the upright image of {scene.width} x {scene.height} px."
    return InvalidRequest(f"{detail} Give pixels, x right and y down.", errors=(FieldError(pointer, detail),))


def _centre(bbox: BBox) -> Point:
    return (bbox[0] + bbox[2]) / 2, (bbox[1] + bbox[3]) / 2
