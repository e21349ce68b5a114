"""Everything that can be seen in one image without a model, each thing looked at once and only when asked for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from threading import RLock

import numpy as np
from numpy.typing import NDArray

from cow_service.vision.arrows import Arrow, find_arrows
from cow_service.vision.boxes import DrawnBox, find_boxes
from cow_service.vision.fill import erase_drawing
from cow_service.vision.masks import BBox, bbox_of, mask_from_bbox, mask_from_point
from cow_service.vision.regions import Region, find_regions
from cow_service.vision.strokes import Stroke, WorkingImage, find_strokes, working_image

SAME_OBJECT = 0.5  # intersection over union from which a region is the object of a box

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Scene:
    """An upright RGB image [H, W, 3] and what was measured in it. It knows no question and no motion."""

    image: Image
    _masks: dict[BBox, Mask] = field(default_factory=dict, repr=False)
    _kept: dict[BBox, Callable[[], Mask]] = field(default_factory=dict, repr=False)
    _lock: RLock = field(default_factory=RLock, repr=False)

    @property
    def width(self) -> int:
        """Pixels."""
        return int(self.image.shape[1])

    @property
    def height(self) -> int:
        """Pixels."""
        return int(self.image.shape[0])

    @cached_property
    def _strokes(self) -> tuple[WorkingImage, tuple[Stroke, ...]]:
        small = working_image(self.image)
        return small, tuple(find_strokes(small.pixels))

    @cached_property
    def arrows(self) -> tuple[Arrow, ...]:
        """Arrows drawn over the image, best fit first."""
        return find_arrows(*self._strokes, (self.height, self.width))

    @cached_property
    def boxes(self) -> tuple[DrawnBox, ...]:
        """Boxes drawn over the image, largest first."""
        return find_boxes(*self._strokes, (self.height, self.width))

    @cached_property
    def cues(self) -> Mask:
        """Mask [H, W] of every arrow and box drawn over the image: cues for the reader, not part of the world."""
        mask = np.zeros((self.height, self.width), bool)
        for drawing in (*self.arrows, *self.boxes):
            mask |= drawing.mask
        return mask

    @cached_property
    def clean(self) -> Image:
        """The image [H, W, 3] without its cues."""
        return erase_drawing(self.image, self.cues)

    @cached_property
    def regions(self) -> tuple[Region, ...]:
        """Objects of the image, largest first; empty where it is too cluttered to tell."""
        return find_regions(self.clean)

    def region_of(self, bbox: BBox) -> Region | None:
        """The region that a box [x0, y0, x1, y1] is about, if there is one."""
        best = max(self.regions, key=lambda region: iou(region.bbox, bbox), default=None)
        return best if best is not None and iou(best.bbox, bbox) >= SAME_OBJECT else None

    def silhouette(self, bbox: BBox) -> Mask:
        """Mask [H, W] of the object in a box [x0, y0, x1, y1], cut from the image without its cues."""
        with self._lock:
            if bbox not in self._masks and bbox in self._kept:
                self._masks[bbox] = self._kept[bbox]()
            if bbox not in self._masks:
                region = self.region_of(bbox)
                known = region is not None and region.is_disc
                guess = None if region is None else region.cutting.full()
                self._masks[bbox] = guess if known and guess is not None else mask_from_bbox(self.clean, bbox, guess)
            return self._masks[bbox]

    def recall(self, bbox: BBox, mask: Callable[[], Mask]) -> None:
        """Says where to find a mask that was cut before: one cut again from its box may differ from one of a point."""
        with self._lock:
            self._kept[bbox] = mask

    def bbox_at(self, point: tuple[float, float]) -> BBox:
        """Tight box [x0, y0, x1, y1] of the object at a point [x, y]: the smallest region there, or a cut around it."""
        x = min(self.width - 1, max(0, int(point[0])))
        y = min(self.height - 1, max(0, int(point[1])))
        with self._lock:
            pixel = np.zeros((self.height, self.width), bool)
            pixel[y, x] = True
            under = [region for region in self.regions if region.cutting.shared_with(pixel)]
            if under:
                return min(under, key=lambda region: region.cutting.area).bbox
            mask = mask_from_point(self.clean, (float(x), float(y)))
            bbox = bbox_of(mask)
            self._masks[bbox] = mask
            return bbox


def iou(a: BBox, b: BBox) -> float:
    """Intersection over union of two boxes [x0, y0, x1, y1]."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    both = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - width * height
    return width * height / both
