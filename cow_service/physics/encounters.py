"""What the mover encounters: its silhouette swept along the path against the silhouettes of other objects.

The mover touches an object where the silhouettes overlap and the two stand, on the floor, within the sum of their half
widths. What stands lower in the image is nearer to the camera. An object in the air has no place on the floor; it
touches what it overlaps until it has sunk below that object's lower edge.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.physics.camera import PITCH
from cow_service.records import BBox, Encounter, EncounterKind
from cow_service.vision.masks import resized_mask, scaled_size
from cow_service.vision.obstacles import Obstacle
from cow_service.vision.types import Floats, Mask

WORKING_SIDE = 320  # px: masks are swept at this size
LEAST_OVERLAP = 0.03  # of the smaller silhouette: less is no encounter
REACH = 0.95  # of the summed half widths: corners and handles do not reach all around


@dataclass(frozen=True)
class Sweep:
    """The mover on its path: mask [H, W] and box in the image, then its centre and apparent size per frame."""

    mask: Mask
    bbox: BBox
    start: Floats  # [2] px: the centre in the image, where mask and box belong
    points: Floats  # [F, 2] px
    scale: Floats  # [F]
    visible: Mask  # [F]
    airborne: bool

    @cached_property
    def _factor(self) -> float:
        return min(1.0, WORKING_SIDE / max(self.mask.shape))

    @cached_property
    def small(self) -> Mask:
        """The mask at the working size."""
        height, width = self.mask.shape
        return resized_mask(self.mask, scaled_size(width, height, self._factor))

    def box(self, frame: int) -> BBox:
        """The mover's box (px) at a frame."""
        return box_at(self.bbox, self.start, self.points[frame], float(self.scale[frame]))

    def moved(self, frame: int) -> NDArray[np.uint8]:
        """The mover's mask (0 and 1) at a frame, at the working size."""
        scale = float(self.scale[frame])
        shift = self.points[frame] * self._factor - scale * (self.start * self._factor)
        transform = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]], np.float64)
        size = self.small.shape[1], self.small.shape[0]
        small = self.small.astype(np.uint8)
        return np.asarray(cv2.warpAffine(small, transform, size, flags=cv2.INTER_NEAREST), np.uint8)


def find_encounters(sweep: Sweep, obstacles: Sequence[Obstacle]) -> tuple[Encounter, ...]:
    """Encounters in the order of their first frame; of one object each kind once, and nothing after touching it."""
    size = sweep.small.shape[1], sweep.small.shape[0]
    found: list[Encounter] = []
    for obstacle in obstacles:
        other = obstacle.mask.at(size)
        seen: set[EncounterKind] = set()
        for frame in np.nonzero(sweep.visible)[0].tolist():
            if not boxes_overlap(sweep.box(frame), obstacle.bbox) or not _overlaps(sweep, frame, other):
                continue
            kind = _kind(sweep, frame, obstacle.bbox)
            if kind not in seen:
                seen.add(kind)
                found.append(Encounter(object=obstacle.name, bbox=obstacle.bbox, first_frame=frame, kind=kind))
            if kind == "touches":
                break
    return tuple(sorted(found, key=lambda encounter: encounter.first_frame))


def swept_mask(sweep: Sweep) -> Mask:
    """Mask [H, W] of every place that the mover covers on its path."""
    height, width = sweep.mask.shape
    swept = np.zeros(sweep.small.shape, np.uint8)
    for frame in range(len(sweep.points)):
        if boxes_overlap(sweep.box(frame), (0, 0, width, height)):
            swept |= sweep.moved(frame)
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


def boxes_overlap(a: BBox, b: BBox) -> bool:
    """Whether two boxes [x0, y0, x1, y1] have area in common."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _kind(sweep: Sweep, frame: int, other: BBox) -> EncounterKind:
    box = sweep.box(frame)
    if sweep.airborne:
        return "touches" if foot_line(box) <= foot_line(other) else "occludes"
    across, away, reach = floor_gap(box, other, float(np.sin(PITCH)))
    if float(np.hypot(across, away)) <= REACH * reach:
        return "touches"
    return "occludes" if stands_nearer(box, other, airborne=False) else "occluded-by"


def _overlaps(sweep: Sweep, frame: int, other: Mask) -> bool:
    """Whether the mover covers enough of the other mask or is covered enough by it."""
    both = int((other & (sweep.moved(frame) > 0)).sum())
    scale = float(sweep.scale[frame])
    smaller = min(int(other.sum()), int(sweep.small.sum() * scale * scale))
    return both > 0 and both >= LEAST_OVERLAP * smaller
