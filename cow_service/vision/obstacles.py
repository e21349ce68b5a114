"""The other objects of a scene: what the mover can meet, pass in front of, or be hidden by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cow_service.records import BBox, LocatedObject
from cow_service.vision.masks import CroppedMask, iou, without_holes
from cow_service.vision.regions import SAME_OBJECT_IOU, Region, region_of
from cow_service.vision.types import Mask

OWN_SHARE = 0.2  # of the mover's area: something smaller that touches it is its shadow or a part of it
DOUBTFUL = 0.75  # confidence below which the same holds of a small region that touches another obstacle


@dataclass(frozen=True)
class Obstacle:
    """Another object of the image."""

    name: str
    bbox: BBox
    mask: CroppedMask
    confidence: float = 1.0  # 0..1: how sure it is that it is there as one thing with this mask; 1 for what is given


def find_obstacles(
    regions: Sequence[Region], silhouette: Callable[[BBox], Mask], mover: BBox, named: Sequence[LocatedObject]
) -> tuple[Obstacle, ...]:
    """Everything but the mover: first what the question names, by that name, then other regions, by their colour.

    `silhouette` gives the mask [H, W] of the object in a box; of known regions their own mask, which is cheaper, is
    taken, unless a mask was given.
    """
    body = silhouette(mover)
    body_area, whole = np.count_nonzero(body), without_holes(body)
    near = cv2.dilate(body.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    obstacles: list[Obstacle] = []
    for other in named:
        if iou(other.bbox, mover) < SAME_OBJECT_IOU:
            region = None if other.mask is not None else region_of(regions, other.bbox)
            mask = CroppedMask.of(silhouette(other.bbox)) if region is None else region.mask
            found = region is not None and region.bbox == other.bbox  # here, not by the request or another reader
            confidence = region.confidence if region is not None and found else 1.0
            obstacles.append(Obstacle(other.object, other.bbox, mask, confidence))
    for region in regions:
        area = region.mask.area
        if iou(region.bbox, mover) >= SAME_OBJECT_IOU or region.mask.shared_with(whole) > 0.5 * area:
            continue
        if area < OWN_SHARE * body_area and region.mask.shared_with(near):
            continue
        if any(iou(region.bbox, other.bbox) >= SAME_OBJECT_IOU or _is_part(region, other) for other in obstacles):
            continue
        obstacles.append(Obstacle(f"{region.colour} object", region.bbox, region.mask, region.confidence))
    return tuple(obstacles)


def _is_part(region: Region, other: Obstacle) -> bool:
    """Whether a doubtful region is the shadow or a part of a larger obstacle that it touches."""
    if region.confidence >= DOUBTFUL or region.mask.area >= OWN_SHARE * other.mask.area:
        return False
    near = cv2.dilate(other.mask.full().astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    return bool(region.mask.shared_with(near))
