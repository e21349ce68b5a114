"""Trustworthy outlines: those on which two prompts agree. A single one may be a fragment of an object."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from cow_service.media.masks import CroppedMask, bbox_of, iou, mask_iou
from cow_service.media.types import Image, Mask
from cow_service.perception.base import Detector, Embedded, Prompt, Segment, Thing
from cow_service.perception.classical.regions import thing_of
from cow_service.perception.classical.segmentation import mask_from_bbox
from cow_service.records import BBox, Point


class OutlineRules(NamedTuple):
    """When a mask of a segmenter is trusted.

    Set by hand with simulated segmenters, whose errors are known; real ones were not measured.
    """

    agree: float = 0.8  # IoU from which two masks are one
    least_score: float = 0.5  # of a candidate
    fills: float = 0.5  # IoU of a box that was given and that of its mask: less is something else
    is_whole: float = 0.75  # the same: less is a part
    rival: float = 0.05  # of the score: a candidate that is so close to the best is meant as well
    most_share: float = 0.95  # of the image: more is no thing


OUTLINE = OutlineRules()
MOST_FOUND = 24  # things that are outlined, best first
SAME_THING = 0.7  # IoU from which two masks are one thing's


@dataclass(frozen=True)
class Outline:
    """What a segmenter takes for a thing."""

    mask: CroppedMask
    score: float
    is_sure: bool  # two prompts agree on it

    @property
    def bbox(self) -> BBox:
        """Tight, px."""
        return self.mask.bbox


def outlines_in(image: Embedded, boxes: Sequence[BBox]) -> list[Outline | None]:
    """What is in each box; None if nothing fills it.

    It is sure where it fills the box well, and the point deepest inside of its mask gives the same mask again.
    """
    size, best = image.size, [_first(found) for found in image.segment([Prompt(bbox=box) for box in boxes])]
    again = iter(image.segment([Prompt(point=_inmost(each.mask, size)) for each in best if each is not None]))
    outlines: list[Outline | None] = []
    for box, segment in zip(boxes, best, strict=True):
        if segment is None:
            outlines.append(None)
            continue
        agrees = any(mask_iou(segment.mask, other.mask) >= OUTLINE.agree for other in next(again))
        mask = segment.enlarged(*size)
        fills = iou(mask.bbox, box) if mask.area else 0.0
        outline = Outline(mask, segment.score, agrees and fills >= OUTLINE.is_whole)
        outlines.append(outline if fills >= OUTLINE.fills else None)
    return outlines


def outlines_at(image: Embedded, point: Point) -> list[Outline]:
    """The things that a point may mean, best first; empty if no two prompts agree.

    More than one are things within each other that are about as good; else the first alone is meant.
    """
    (candidates,) = image.segment([Prompt(point=point)])
    possible = [each for each in candidates if _first((each,)) is not None]
    again = image.segment([Prompt(bbox=_scaled_box(each.mask, image.size)) for each in possible])
    agreed = [
        each
        for each, found in zip(possible, again, strict=True)
        if (best := _first(found)) is not None and mask_iou(each.mask, best.mask) >= OUTLINE.agree
    ]
    agreed.sort(key=lambda each: -each.score)
    chosen: list[Segment] = []
    for each in agreed:
        if all(mask_iou(each.mask, other.mask) < OUTLINE.agree for other in chosen):
            chosen.append(each)
    close = [each for each in chosen if each.score >= chosen[0].score - OUTLINE.rival]
    outlines = [Outline(each.enlarged(*image.size), each.score, True) for each in close]
    return [each for each in outlines if each.mask.area]


def find_named(
    detector: Detector, embedded: Embedded | None, image: Image, clean: Image, names: Sequence[str]
) -> tuple[Thing, ...]:
    """What a detector finds by some names in an image without drawings on it, outlined as well as can be.

    One thing under two names is one thing. Without a segmenter outlines are cut by boxes, in the `clean` image, which
    lacks earlier positions of a trail as well.
    """
    found = detector.detect(image, names)[:MOST_FOUND] if names else ()
    boxes = [each.bbox for each in found]
    if embedded is None:
        masks = [CroppedMask.of(mask) if (mask := mask_from_bbox(clean, box)).any() else None for box in boxes]
    else:
        masks = [each.mask if each and each.is_sure else None for each in outlines_in(embedded, boxes)]
    things = list[Thing]()
    for each, mask in zip(found, masks, strict=True):
        if mask is None:
            continue
        full = mask.full()
        twin = next((at for at, one in enumerate(things) if mask_iou(one.mask.full(), full) > SAME_THING), None)
        if twin is None:
            things.append(replace(thing_of(clean, mask), is_disc=False, called=frozenset((each.phrase,))))
        else:
            things[twin] = replace(things[twin], called=things[twin].called | {each.phrase})
    return tuple(things)


def _first(candidates: Sequence[Segment]) -> Segment | None:
    """The best of some candidates that is good enough to be a thing."""
    good = (each for each in candidates if each.score >= OUTLINE.least_score)
    return next((each for each in good if 0 < each.mask.mean() <= OUTLINE.most_share), None)


def _inmost(mask: Mask, size: tuple[int, int]) -> Point:
    """The point, px of the image, that lies deepest inside of a mask [h, w] that is not empty."""
    depth = cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
    y, x = np.unravel_index(int(depth.argmax()), depth.shape)
    return (float(x) + 0.5) * size[0] / mask.shape[1], (float(y) + 0.5) * size[1] / mask.shape[0]


def _scaled_box(mask: Mask, size: tuple[int, int]) -> BBox:
    """The tight box, px of the image, of a mask [h, w]."""
    x0, y0, x1, y1 = bbox_of(mask)
    across, down = size[0] / mask.shape[1], size[1] / mask.shape[0]
    return x0 * across, y0 * down, x1 * across, y1 * down
