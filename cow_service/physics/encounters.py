"""What the mover meets: its silhouette swept along the path against the silhouettes of other objects.

Two things tell touching from passing: the silhouettes overlap, and on the floor the two stand as near to each other as
they are wide. What stands lower in the image stands nearer to the camera. An object in the air has no place on the
floor; it touches what it overlaps until it has sunk below that thing's foot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.physics.camera import PITCH
from cow_service.records import BBox, Encounter, EncounterKind
from cow_service.vision.masks import resized_mask
from cow_service.vision.obstacles import Obstacle

WORKING_SIDE = 320  # px: masks are swept at this size
LEAST_OVERLAP = 0.03  # of the smaller silhouette: less is a graze that nobody would call an encounter
REACH = 0.95  # of the summed half widths: corners and handles do not reach all around

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sweep:
    """The mover on its way: mask [H, W] and box in the image, then where its centre is and how large it appears."""

    mask: Mask
    bbox: BBox
    start: Floats  # [2] px: the centre in the image, where mask and box belong
    points: Floats  # [F, 2] px
    scale: Floats  # [F]
    visible: Mask  # [F]
    airborne: bool


def find_encounters(sweep: Sweep, obstacles: Sequence[Obstacle]) -> tuple[Encounter, ...]:
    """Encounters in the order of their first frame; of one object each kind once, and nothing after touching it."""
    height, width = sweep.mask.shape
    factor = min(1.0, WORKING_SIDE / max(height, width))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    mover = resized_mask(sweep.mask, size)
    found: list[Encounter] = []
    for obstacle in obstacles:
        other = obstacle.mask.at(size)
        seen: set[EncounterKind] = set()
        for frame, (point, scale, visible) in enumerate(zip(sweep.points, sweep.scale, sweep.visible, strict=True)):
            if not visible or not _boxes_meet(sweep, point, scale, obstacle.bbox):
                continue
            if not _overlaps(mover, sweep.start * factor, other, point * factor, scale):
                continue
            kind = _kind(sweep, point, scale, obstacle.bbox)
            if kind not in seen:
                seen.add(kind)
                found.append(Encounter(object=obstacle.name, bbox=obstacle.bbox, first_frame=frame, kind=kind))
            if kind == "touches":
                break
    return tuple(sorted(found, key=lambda encounter: encounter.first_frame))


def swept_mask(sweep: Sweep) -> Mask:
    """Mask [H, W] of every place that the mover covers on its way."""
    height, width = sweep.mask.shape
    factor = min(1.0, WORKING_SIDE / max(height, width))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    mover = resized_mask(sweep.mask, size)
    swept = np.zeros(mover.shape, np.uint8)
    whole = (0.0, 0.0, float(width), float(height))
    for point, scale in zip(sweep.points, sweep.scale, strict=True):
        if not _boxes_meet(sweep, point, scale, whole):
            continue
        swept |= _moved(mover, sweep.start * factor, point * factor, scale)
    return cv2.resize(swept, (width, height), interpolation=cv2.INTER_NEAREST) > 0


def foot_line(bbox: BBox) -> float:
    """The image row (px) on which something stands: what stands lower stands nearer."""
    return bbox[3]


def stands_nearer(mover: BBox, other: BBox, *, airborne: bool) -> bool:
    """Whether the mover is drawn in front of the other object; one in the air is, since nothing says how far it is."""
    return airborne or foot_line(mover) >= foot_line(other)


def floor_gap(box: BBox, other: BBox, squash: float) -> tuple[float, float, float]:
    """How far apart two boxes stand on the floor: sideways, in depth, and their summed half widths, all in px.

    `squash` is how much flatter than wide a circle on the floor is seen; depth is positive where the first is nearer.
    """
    width, other_width = box[2] - box[0], other[2] - other[0]
    middle, other_middle = foot_line(box) - squash * width / 2, foot_line(other) - squash * other_width / 2
    across = (box[0] + box[2] - other[0] - other[2]) / 2
    return across, (middle - other_middle) / squash, (width + other_width) / 2


def box_at(bbox: BBox, start: Floats, point: Floats, scale: float) -> BBox:
    """The mover's box when its centre has gone from `start` to `point` and it appears `scale` times as large."""
    left, top, right, bottom = bbox
    return (
        float(point[0] + (left - start[0]) * scale),
        float(point[1] + (top - start[1]) * scale),
        float(point[0] + (right - start[0]) * scale),
        float(point[1] + (bottom - start[1]) * scale),
    )


def _kind(sweep: Sweep, point: Floats, scale: float, other: BBox) -> EncounterKind:
    box = box_at(sweep.bbox, sweep.start, point, scale)
    if sweep.airborne:
        return "touches" if foot_line(box) <= foot_line(other) else "occludes"
    across, away, reach = floor_gap(box, other, float(np.sin(PITCH)))
    if float(np.hypot(across, away)) <= REACH * reach:
        return "touches"
    return "occludes" if stands_nearer(box, other, airborne=False) else "occluded-by"


def _boxes_meet(sweep: Sweep, point: Floats, scale: float, other: BBox) -> bool:
    box = box_at(sweep.bbox, sweep.start, point, scale)
    return box[0] < other[2] and other[0] < box[2] and box[1] < other[3] and other[1] < box[3]


def _overlaps(mover: Mask, start: Floats, other: Mask, point: Floats, scale: float) -> bool:
    """Whether the mover, moved and scaled, covers enough of the other mask or is covered enough by it."""
    both = int((other & (_moved(mover, start, point, scale) > 0)).sum())
    smaller = min(int(other.sum()), int(mover.sum() * scale * scale))
    return both > 0 and both >= LEAST_OVERLAP * smaller


def _moved(mover: Mask, start: Floats, point: Floats, scale: float) -> NDArray[np.uint8]:
    shift = point - scale * start
    transform = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]], np.float64)
    size = mover.shape[1], mover.shape[0]
    return np.asarray(cv2.warpAffine(mover.astype(np.uint8), transform, size, flags=cv2.INTER_NEAREST), np.uint8)
