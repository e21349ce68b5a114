"""The other objects of a scene: what the mover can meet, pass in front of, or be hidden by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cow_service.records import BBox, LocatedObject
from cow_service.vision.cuttings import Cutting, cutting_of
from cow_service.vision.scene import SAME_OBJECT, Scene, iou

OWN_SHARE = 0.2  # of the mover's area: something smaller that clings to it is its shadow or a part of it


@dataclass(frozen=True)
class Obstacle:
    """Another object of the image."""

    name: str
    bbox: BBox
    cutting: Cutting  # its mask in the image


def obstacles_of(scene: Scene, mover: BBox, named: Sequence[LocatedObject] = ()) -> tuple[Obstacle, ...]:
    """Everything but the mover: first what the question names, by that name, then what else was seen, by its colour."""
    body = scene.silhouette(mover)
    near = cv2.dilate(body.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    obstacles = [
        Obstacle(other.object, other.bbox, _cutting_of(scene, other.bbox))
        for other in named
        if iou(other.bbox, mover) < SAME_OBJECT
    ]
    for region in scene.regions:
        area = region.cutting.area
        if iou(region.bbox, mover) >= SAME_OBJECT or region.cutting.shared_with(body) > 0.5 * area:
            continue
        if area < OWN_SHARE * body.sum() and region.cutting.shared_with(near):
            continue
        if any(iou(region.bbox, other.bbox) >= SAME_OBJECT for other in obstacles):
            continue
        obstacles.append(Obstacle(f"{region.colour} object", region.bbox, region.cutting))
    return tuple(obstacles)


def _cutting_of(scene: Scene, bbox: BBox) -> Cutting:
    """The region's cutting where one is known, which is cheaper than a fresh cut and as good for meeting it."""
    region = scene.region_of(bbox)
    return cutting_of(scene.silhouette(bbox)) if region is None else region.cutting
