"""Finds arrows drawn over an image: one flat colour, a straight shaft, a head that is open or filled.

No trained model is used. A candidate is a connected patch of one colour; it is an arrow if its width along its own axis
is that of a shaft followed by a head that tapers to a tip, and if an ideal arrow of those measures covers the patch.
Objects of a scene (bottles, cones, pencils) fail one of the two.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media.masks import lab_of, mask_iou
from cow_service.media.types import Floats, Image, Mask
from cow_service.perception.classical.strokes import STROKE, Stroke, WorkingImage, drawing_mask
from cow_service.records import BBox, Point


class ArrowRules(NamedTuple):
    """When a stroke is an arrow.

    Set by hand on the open, filled and hollow arrows of 18 rendered scenes of the first family, and on bottles, cones,
    pencils and cans that must not pass. No single number has a measurement of its own.
    """

    fit: float = 0.73  # intersection over union with the ideal arrow
    certain_fit: float = 0.88  # from here on, later strokes at the same place are skipped
    hollow_fit: float = 0.88  # the same for a hollow drawing, whose head may be small
    head: float = 1.8  # of the shaft's width: the least width of a head
    hollow_head: float = 1.3  # the same of a hollow drawing
    slender: float = 5.0  # of the shaft's width: the least length without a rim; the side of a can is shorter


ARROW = ArrowRules()


class BoxRules(NamedTuple):
    """When a stroke is a drawn box.

    Set by hand on boxes drawn into pictures; no single number has a measurement of its own.
    """

    side: int = 14  # px at the working size
    on_outline: float = 0.93  # share of the stroke that lies on its own bounding rectangle
    covered: float = 0.85  # share of that rectangle's outline that the stroke covers: dashes are fine
    fringe: int = 2  # px of what resampling blurs
    between: float = 12.0  # Lab units within which a colour is a mixture of two others


BOX = BoxRules()


@dataclass(frozen=True)
class Arrow:
    """A drawn arrow, in pixels of the image it was found in. It says where the drawing points, not what moves."""

    tail: Point
    tip: Point
    mask: Mask  # [H, W]: the drawing with its outline and its fringe
    fit: float  # intersection over union with the ideal arrow, 0..1

    @property
    def direction(self) -> tuple[float, float]:
        """Unit vector from tail to tip."""
        dx, dy = self.tip[0] - self.tail[0], self.tip[1] - self.tail[1]
        length = float(np.hypot(dx, dy))
        return dx / length, dy / length

    def gap(self, bbox: BBox) -> float:
        """Distance from a box to the nearer end, in sizes of the box."""
        x0, y0, x1, y1 = bbox
        ends = (self.tail, self.tip)
        away = min(math.hypot(max(x0 - x, 0, x - x1), max(y0 - y, 0, y - y1)) for x, y in ends)
        return away / max(x1 - x0, y1 - y0)


def find_arrows(image: WorkingImage, strokes: Iterable[Stroke]) -> tuple[Arrow, ...]:
    """Drawn arrows among the strokes of an image; overlapping findings are one."""
    found: list[tuple[float, _Profile, Stroke]] = []
    for stroke in strokes:
        corners = np.array([stroke.x, stroke.y, *stroke.patch.shape])  # drawings can be found twice
        known = [other for fit, _, other in found if fit > ARROW.certain_fit]
        if any((np.abs(corners - [other.x, other.y, *other.patch.shape]) <= 3).all() for other in known):
            continue
        fitted = fit_arrow(stroke.patch, stroke.hollow)
        if fitted is not None:
            found.append((*fitted, stroke))
    found.sort(key=lambda item: -item[0] * np.linalg.norm(item[1].tip - item[1].tail) ** 0.25)
    arrows: list[Arrow] = []
    taken = np.zeros(image.pixels.shape[:2], bool)
    for fit, shape, stroke in found:
        h, w = stroke.patch.shape
        if (taken[stroke.y : stroke.y + h, stroke.x : stroke.x + w] & stroke.patch).sum() > 0.2 * stroke.patch.sum():
            continue
        mask = drawing_mask(image.pixels, stroke)
        taken |= mask
        offset = np.array([stroke.x, stroke.y])
        tail, tip = (((point + offset + 0.5) / image.scale - 0.5).tolist() for point in (shape.tail, shape.tip))
        arrows.append(Arrow(tuple(tail), tuple(tip), image.full(mask), fit))
    return tuple(arrows)


def fit_arrow(patch: Mask, hollow: bool) -> tuple[float, _Profile] | None:
    """How well a patch [h, w] fits the arrow that it is, and that arrow in the patch's coordinates; None for no arrow.

    A `hollow` drawing has two flat colours, which no object of a scene has: its head need not be much wider than its
    shaft. Shaft and head are read off the width profile along an axis from tail to tip, which is refined on the shaft.
    """
    least_head, least_fit = (ARROW.hollow_head, ARROW.hollow_fit) if hollow else (ARROW.head, ARROW.fit)
    ys, xs = np.nonzero(patch)
    points = np.stack([xs, ys], axis=1).astype(np.float64)
    centre = points.mean(axis=0)
    _, vectors = np.linalg.eigh(np.cov((points - centre).T))
    hull = cv2.convexHull(points.astype(np.float32))[:, 0]
    gaps = hull[:, None] - hull[None]
    i, j = np.unravel_index(int((gaps**2).sum(axis=2).argmax()), (len(hull), len(hull)))
    diameter = (hull[i] - hull[j]).astype(np.float64)
    best: tuple[float, _Profile] | None = None
    for axis, sign in itertools.product((vectors[:, 1], diameter / np.linalg.norm(diameter)), (1.0, -1.0)):
        profile = _profile(points, centre, sign * axis, least_head)
        for _ in range(2):
            if profile is not None:
                profile = _profile(points, profile.centre, profile.axis, least_head)
        if profile is None or not profile.is_arrow_like():
            continue
        if not hollow and len(profile.extent) < ARROW.slender * profile.thickness:
            continue
        fit = max(profile.overlap(patch, filled) for filled in (True, False))
        if fit >= least_fit and (best is None or fit > best[0]):
            best = fit, profile
    return best


@dataclass(frozen=True)
class _Profile:
    """The width of a patch along an axis from tail to tip, and the axis that its shaft then has."""

    extent: Floats  # [n] px: the width at every px along the axis; NaN where nothing lies
    tail: Floats
    tip: Floats
    thickness: float
    head_width: float
    peak: int  # where along the axis it is widest
    neck: int  # where the head begins
    middle: float  # px beside the axis: the middle of the head
    axis: Floats  # unit vector along the shaft
    centre: Floats  # a point on it

    def is_arrow_like(self) -> bool:
        """Whether the shaft keeps its width, and the head is symmetric, of plausible length and tapers to a tip."""
        extent, thickness, head_width, peak = self.extent, self.thickness, self.head_width, self.peak
        n = len(extent)
        shaft_extent = extent[max(1, n // 20) : max(self.neck - 1, n // 3)]
        steady = float(np.nanmean(np.abs(shaft_extent - thickness) <= max(1.6, 0.3 * thickness)))
        head_length = n - 1 - peak
        return not (
            steady < 0.75
            or len(shaft_extent) < 0.25 * n
            or head_length < 0.35 * (head_width - thickness) / 2
            or head_length > min(0.7 * n, 2.5 * head_width)
            or abs(self.middle) > 0.22 * head_width + 1
            or float(np.nanmean(np.diff(extent[peak:]) <= 1.5)) < 0.9
            or extent[-1] > 0.45 * head_width + thickness
        )

    def overlap(self, patch: Mask, filled: bool) -> float:
        """Intersection over union of a patch and the ideal arrow of these measures."""
        tail, tip, thickness = self.tail, self.tip, self.thickness
        axis = (tip - tail) / np.linalg.norm(tip - tail)
        normal = np.array([-axis[1], axis[0]])
        pad = int(thickness) + 3
        ideal = np.zeros((patch.shape[0] + 2 * pad, patch.shape[1] + 2 * pad), np.uint8)

        def fixed(*points: Floats) -> NDArray[np.int32]:
            return np.round((np.array(points) + pad) * 16).astype(np.int32)

        half = self.head_width / 2 if filled else max(0.0, (self.head_width - thickness) / 2)
        base = tip - axis * (len(self.extent) - 1 - self.peak)
        barbs = base + normal * half, base - normal * half
        across = normal * max(0.5, thickness / 2 - 0.25)
        point = tip - axis * thickness / 2
        shaft_end = base if filled else point
        shaft = fixed(tail + across, shaft_end + across, shaft_end - across, tail - across)
        cv2.fillPoly(ideal, [shaft], 1, cv2.LINE_8, 4)
        if filled:
            cv2.fillPoly(ideal, [fixed(barbs[0], tip, barbs[1])], 1, cv2.LINE_8, 4)
        else:
            for barb in barbs:
                start, end = fixed(barb, point).tolist()
                cv2.line(ideal, start, end, 1, max(1, round(thickness)), cv2.LINE_8, 4)
        return mask_iou(np.pad(patch, pad), ideal > 0)


def _profile(points: Floats, centre: Floats, axis: Floats, least_head: float) -> _Profile | None:
    """The widths of a patch's points [N, 2] along an axis, or None if they are no shaft followed by a wider head."""
    normal = np.array([-axis[1], axis[0]])
    along, across = (points - centre) @ axis, (points - centre) @ normal
    length = float(along.max() - along.min())
    if length < STROKE.length:
        return None
    bins = np.clip((along - along.min()).astype(int), 0, int(length))
    n = int(length) + 1
    high, low = np.full(n, -1e9), np.full(n, 1e9)
    np.maximum.at(high, bins, across)
    np.minimum.at(low, bins, across)
    filled_bins = high > -1e8
    if filled_bins.mean() < 0.95:
        return None
    extent = np.where(filled_bins, high - low + 1, np.nan)
    shaft_end = int(0.45 * n)
    thickness = float(np.nanmedian(extent[max(1, n // 12) : shaft_end]))
    peak = int(np.nanargmax(extent))
    head_width = float(extent[peak])
    if peak < 0.4 * n or head_width < max(least_head * thickness, thickness + 4):
        return None
    wide = np.nonzero(extent[:peak] > thickness + max(2.0, 0.35 * thickness))[0]
    wide = wide[wide > 0.3 * n]
    neck = int(wide.min()) if len(wide) else peak
    shaft = (bins > n // 20) & (bins < max(neck - 1, n // 3))
    if shaft.sum() < 12:
        return None
    fitted = cv2.fitLine(points[shaft].astype(np.float32), cv2.DIST_L2, 0, 0.01, 0.01).ravel().astype(np.float64)
    line, origin = fitted[:2], fitted[2:]
    line = line if line[0] * axis[0] + line[1] * axis[1] > 0 else -line
    middle = float(high[peak] + low[peak]) / 2
    along = (points - origin) @ line
    tail, tip = origin + line * along.min(), origin + line * along.max()
    return _Profile(extent, tail, tip, thickness, head_width, peak, neck, middle, line, origin)


@dataclass(frozen=True)
class DrawnBox:
    """A rectangle drawn over the image to mark something. It does not say what."""

    bbox: BBox  # x0, y0, x1, y1, px: inside the line
    mask: Mask  # [H, W]: the line with its fringe


def find_boxes(image: WorkingImage, strokes: Iterable[Stroke]) -> tuple[DrawnBox, ...]:
    """Drawn boxes among the strokes of an image, largest first."""
    boxes: list[DrawnBox] = []
    for stroke in strokes:
        patch, (h, w) = stroke.patch, stroke.patch.shape
        if stroke.hollow or min(h, w) < BOX.side:  # a box is drawn around something: its inside is not drawn
            continue
        sides = (patch[:, w // 2], patch[:, w // 2][::-1], patch[h // 2], patch[h // 2][::-1])
        line = int(np.median([_line_width(side) for side in sides]))
        if not 1 <= line <= 0.2 * min(h, w):
            continue
        frame = np.ones((h, w), bool)
        frame[line + 1 : h - line - 1, line + 1 : w - line - 1] = False
        rim = [patch[:line].any(0), patch[-line:].any(0), patch[:, :line].any(1), patch[:, -line:].any(1)]
        if patch[frame].sum() < BOX.on_outline * patch.sum() or np.concatenate(rim).mean() < BOX.covered:
            continue
        if line <= BOX.fringe and is_fringe(image.pixels, stroke):
            continue
        inner = (stroke.x + line, stroke.y + line, stroke.x + w - line, stroke.y + h - line)
        x0, y0, x1, y1 = (value / image.scale for value in inner)
        if all(np.abs(np.array(box.bbox) - (x0, y0, x1, y1)).max() >= 8 / image.scale for box in boxes):
            boxes.append(DrawnBox((x0, y0, x1, y1), image.full(drawing_mask(image.pixels, stroke))))
    return tuple(sorted(boxes, key=lambda box: -(box.bbox[2] - box.bbox[0]) * (box.bbox[3] - box.bbox[1])))


def is_fringe(pixels: Image, stroke: Stroke) -> bool:
    """Whether a thin frame is the fringe of a block: of a colour between that of the block and that around it."""
    (h, w), far, fringe = stroke.patch.shape, 2 * BOX.fringe, BOX.fringe
    window, patch = stroke.surroundings(pixels, far)
    lab = lab_of(np.ascontiguousarray(pixels[window])).astype(np.float64)
    inner, outer = np.zeros(patch.shape, bool), np.ones(patch.shape, bool)
    top, left = min(far, stroke.y), min(far, stroke.x)
    outer[max(0, top - fringe) : top + h + fringe, max(0, left - fringe) : left + w + fringe] = False
    inner[top + far : top + h - far, left + far : left + w - far] = True
    if not (inner.any() and outer.any()):
        return False
    inside, outside, own = (np.median(lab[where], axis=0) for where in (inner, outer, patch > 0))
    across = inside - outside
    length = float(np.linalg.norm(across))
    if length < BOX.between:
        return False
    share = float((own - outside) @ across) / length**2
    return 0 < share < 1 and float(np.linalg.norm(own - outside - share * across)) < BOX.between


def _line_width(side: Mask) -> int:
    """How wide the line is with which a cut [n] through a stroke begins; 0 for none within a fringe of 2 px."""
    start = int(np.argmax(side))
    return start + int(np.argmin(side[start:])) if side[start] and start <= 2 else 0
