"""Masks of objects: cropped to the object, because an image of many megapixels can hold many; and resizing."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.records import BBox

SAME_OBJECT_IOU = 0.5  # intersection over union from which two boxes are of one object
_FIRST_PIXEL = slice(0, 1), slice(0, 1)  # the window that stands for an empty mask


def scaled(image: Image, scale: float) -> Image:
    """An image [H, W, ...] resized by a scale of at most 1, each side at least 1 px; the same array for 1."""
    if scale >= 1:
        return image
    size = scaled_size(image.shape[1], image.shape[0], scale)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def scaled_size(width: int, height: int, scale: float) -> tuple[int, int]:
    """Width and height (px) resized by a scale, each at least 1."""
    return max(1, round(width * scale)), max(1, round(height * scale))


def resized_mask(mask: Mask, size: tuple[int, int]) -> Mask:
    """A mask [H, W] at a size (width, height): set where half of a pixel is; the same array for its own size."""
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    return cv2.resize(mask.astype(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA) >= 128


def lab_of(image: Image) -> Floats32:
    """An RGB image [h, w, 3] in CIE Lab."""
    return np.asarray(cv2.cvtColor(image.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), np.float32)


def three_channels(values: Floats32) -> Floats32:
    """Values [h, w] for each of three colours: broadcasting over the last axis is several times slower."""
    return np.asarray(cv2.merge((values, values, values)), np.float32)


def window_of(mask: Mask, margin: int = 0) -> tuple[slice, slice] | None:
    """Rows and columns that a mask [H, W] spans, with a margin (px) inside the image; None for an empty mask."""
    left, top, across, down = cv2.boundingRect(mask.view(np.uint8))
    if not across:
        return None
    rows = slice(max(0, top - margin), min(mask.shape[0], top + down + margin))
    return rows, slice(max(0, left - margin), min(mask.shape[1], left + across + margin))


def bbox_of(mask: Mask) -> BBox:
    """Tight box [x0, y0, x1, y1] of a mask that is not empty; x1 and y1 lie one past the last pixel."""
    rows, columns = window_of(mask) or _FIRST_PIXEL
    return float(columns.start), float(rows.start), float(columns.stop), float(rows.stop)


def iou(a: BBox, b: BBox) -> float:
    """Intersection over union of two boxes [x0, y0, x1, y1]."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    if width <= 0 or height <= 0:
        return 0.0
    both = (a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - width * height
    return width * height / both


def mask_iou(a: Mask, b: Mask) -> float:
    """Intersection over union of two masks [h, w]; 0 of two that are empty."""
    return float(np.count_nonzero(a & b) / max(1, np.count_nonzero(a | b)))


def is_same_object(a: BBox, b: BBox) -> bool:
    """Whether two boxes are of one object."""
    return iou(a, b) >= SAME_OBJECT_IOU


def is_among(bbox: BBox, others: Iterable[BBox]) -> bool:
    """Whether a box is of the same object as one of some others."""
    return any(is_same_object(bbox, other) for other in others)


def dilated(mask: Mask, width: int = 3, times: int = 1) -> Mask:
    """A mask [H, W] grown by a square of a width (px), repeatedly."""
    return cv2.dilate(mask.view(np.uint8), np.ones((width, width), np.uint8), iterations=times).view(np.bool_)


def eroded(mask: Mask, width: int = 3, beyond: int = 1) -> Mask:
    """A mask [H, W] less what a square of a width (px) takes off its rim; `beyond` the border it counts as 1 or 0."""
    return cv2.erode(mask.view(np.uint8), np.ones((width, width), np.uint8), borderValue=beyond).view(np.bool_)


def outline_of(mask: Mask) -> Mask:
    """The pixels [H, W] of a mask that have a neighbour outside it."""
    return mask & ~eroded(mask)


def outer_contour(mask: Mask) -> NDArray[np.int32]:
    """The points [N, 1, 2] (x, y, px) of the outer outline of a mask's largest patch. It must not be empty."""
    contours, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(max(contours, key=cv2.contourArea), np.int32)


def roundness_of(mask: Mask) -> float:
    """The share (0..1) of the smallest circle around a mask [h, w] that its outer contour encloses."""
    outline = outer_contour(mask)
    _, radius = cv2.minEnclosingCircle(outline)
    return float(cv2.contourArea(outline) / max(1.0, np.pi * radius * radius))


def half_width(mask: Mask) -> float:
    """Radius (px) of the largest circle inside a mask [h, w]."""
    return float(cv2.distanceTransform(np.pad(mask, 1).astype(np.uint8), cv2.DIST_L2, 3).max())


def hull(mask: Mask) -> Mask:
    """The convex hull [H, W] of a mask."""
    filled = np.zeros(mask.shape, np.uint8)
    rows = np.nonzero(mask.any(axis=1))[0]
    if len(rows):  # the first and the last pixel of each row are enough
        ends = mask[rows].argmax(axis=1), mask.shape[1] - 1 - mask[rows, ::-1].argmax(axis=1)
        points = np.stack([np.concatenate(ends), np.tile(rows, 2)], axis=1)
        cv2.fillConvexPoly(filled, cv2.convexHull(points.astype(np.int32)), 1)
    return filled > 0


def without_holes(mask: Mask) -> Mask:
    """The mask [H, W] with its holes filled."""
    outlines, _ = cv2.findContours(mask.view(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros(mask.shape, np.uint8), outlines, -1, 1, cv2.FILLED).view(np.bool_)


@dataclass(frozen=True, eq=False)
class CroppedMask:
    """A mask of an image; only the part that is not empty is stored."""

    shape: tuple[int, int]  # height and width of the image, px
    rows: slice
    columns: slice
    patch: Mask  # [rows, columns]

    @staticmethod
    def of(mask: Mask) -> CroppedMask:
        """A mask [H, W], cropped; one pixel large for an empty mask."""
        window = window_of(mask) or _FIRST_PIXEL
        return CroppedMask((mask.shape[0], mask.shape[1]), *window, mask[window].copy())

    @property
    def bbox(self) -> BBox:
        """Tight box [x0, y0, x1, y1], px; x1 and y1 lie one past the last pixel."""
        return float(self.columns.start), float(self.rows.start), float(self.columns.stop), float(self.rows.stop)

    @property
    def area(self) -> int:
        """Pixels."""
        return int(np.count_nonzero(self.patch))

    def full(self) -> Mask:
        """The mask [H, W] of the whole image, as a new array."""
        mask = np.zeros(self.shape, bool)
        mask[self.rows, self.columns] = self.patch
        return mask

    def at(self, size: tuple[int, int]) -> Mask:
        """The mask of the whole image at another size (width, height)."""
        return resized_mask(self.full(), size)

    def shared_with(self, mask: Mask) -> int:
        """How many pixels it shares with a mask [H, W]."""
        return int(np.count_nonzero(self.patch & mask[self.rows, self.columns]))

    def overlap(self, other: CroppedMask) -> int:
        """How many pixels it shares with another mask of the same image."""
        rows = slice(max(self.rows.start, other.rows.start), min(self.rows.stop, other.rows.stop))
        columns = slice(max(self.columns.start, other.columns.start), min(self.columns.stop, other.columns.stop))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return 0
        own, its = (
            one.patch[
                rows.start - one.rows.start : rows.stop - one.rows.start,
                columns.start - one.columns.start : columns.stop - one.columns.start,
            ]
            for one in (self, other)
        )
        return int(np.count_nonzero(own & its))

    def contains(self, x: int, y: int) -> bool:
        """Whether a pixel of the image is set."""
        inside = self.rows.start <= y < self.rows.stop and self.columns.start <= x < self.columns.stop
        return inside and bool(self.patch[y - self.rows.start, x - self.columns.start])

    def moved(self, start: Floats, to: Floats, scale: float, degrees: float) -> CroppedMask:
        """The mask when its point `start` [2] (px) has gone `to`, scaled and turned clockwise; inside the image."""
        turn = turning(scale, degrees)
        x0, y0, x1, y1 = self.bbox
        corners = to + (np.array([[x0, y0], [x1, y0], [x0, y1], [x1, y1]]) - start) @ turn.T
        low = np.clip(np.floor(corners.min(axis=0)), 0, self.shape[::-1]).astype(int)
        high = np.clip(np.ceil(corners.max(axis=0)), 0, self.shape[::-1]).astype(int)
        if (high <= low).any():
            return CroppedMask.of(np.zeros(self.shape, bool))
        shift = to + turn @ (np.array([x0, y0]) + 0.5 - start) - 0.5 - low
        size = int(high[0] - low[0]), int(high[1] - low[1])
        values = cv2.warpAffine(self.patch.astype(np.float32), np.column_stack([turn, shift]), size)
        found = np.zeros(self.shape, bool)
        found[low[1] : high[1], low[0] : high[0]] = np.asarray(values) > 0.5
        return CroppedMask.of(found)

    def add_to(self, mask: Mask) -> None:
        """Sets its pixels in a mask [H, W]."""
        mask[self.rows, self.columns] |= self.patch


def turning(scale: float, degrees: float) -> Floats:
    """Matrix [2, 2] that scales and turns clockwise in the image, whose y points down."""
    angle = math.radians(degrees)
    cosine, sine = math.cos(angle), math.sin(angle)
    return scale * np.array([[cosine, -sine], [sine, cosine]])


def enlarged(soft: Floats32, shape: tuple[int, int]) -> CroppedMask:
    """Where a smooth mask [h, w] of 0..1, not empty, exceeds one half when resized to an image [H, W] of `shape`."""
    fy, fx = shape[0] / soft.shape[0], shape[1] / soft.shape[1]
    rows, columns = window_of(soft > 0.05) or _FIRST_PIXEL
    y0, y1 = int(rows.start * fy), min(shape[0], int(np.ceil(rows.stop * fy)))
    x0, x1 = int(columns.start * fx), min(shape[1], int(np.ceil(columns.stop * fx)))
    # Pixel centres map to pixel centres, as in a resize of the whole.
    back = np.array([[1 / fx, 0, (x0 + 0.5) / fx - 0.5], [0, 1 / fy, (y0 + 0.5) / fy - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    values = cv2.warpAffine(soft, back, (x1 - x0, y1 - y0), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    patch = np.asarray(values) > 0.5
    tight = window_of(patch) or _FIRST_PIXEL
    rows, columns = (slice(o + s.start, o + s.stop) for o, s in zip((y0, x0), tight, strict=True))
    return CroppedMask(shape, rows, columns, patch[tight].copy())


def pieces_of(shape: CroppedMask) -> list[Floats32]:
    """A shape as convex pieces: corners [N, 2] each, px of the image; of what is not convex its rows, in slabs."""
    x0, y0, _, _ = shape.bbox
    patch = shape.patch
    outline = outer_contour(patch).reshape(-1, 2).astype(np.float32)
    hull = cv2.convexHull(outline).reshape(-1, 2)
    if shape.area > 0.94 * cv2.contourArea(hull):
        corners = cv2.approxPolyDP(hull, 0.75, True).reshape(-1, 2)
        return [(corners + np.array([x0, y0])).astype(np.float32)]
    slabs = list[tuple[int, int, int, int]]()  # left, top, right, bottom
    open_ones: dict[tuple[int, int], int] = {}
    even = max(2, patch.shape[1] // 30)
    for row in range(len(patch) + 1):
        edges = np.diff(np.pad(patch[row].astype(np.int8), 1)) if row < len(patch) else np.zeros(1, np.int8)
        runs = list(zip(np.nonzero(edges == 1)[0].tolist(), np.nonzero(edges == -1)[0].tolist(), strict=True))
        going: dict[tuple[int, int], int] = {}
        for left, right in runs:
            same = [run for run in open_ones if abs(run[0] - left) <= even and abs(run[1] - right) <= even]
            going[same[0] if same else (left, right)] = open_ones.pop(same[0]) if same else row
        slabs += [(left, top, right, row) for (left, right), top in open_ones.items()]
        open_ones = going
    corners = [[(left, top), (right, top), (right, low), (left, low)] for left, top, right, low in slabs]
    return [np.array(each, np.float32) + np.array([x0, y0], np.float32) for each in corners]
