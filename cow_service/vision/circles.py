"""Finds circles among the edges of an image, whole or in part: the outlines of balls, also of balls that overlap.

Every edge pixel votes for the centres that lie along its gradient (Hough transform for circles, Duda and Hart, 1972);
what has most votes is fitted to the edges by least squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from cow_service.records import BBox
from cow_service.vision.masks import scaled
from cow_service.vision.types import Floats, Floats32, Image

WORKING_SIDE = 512  # px: images are searched at this size
EDGE = 1.0, 2.2  # Lab units per px, and times the median gradient; the larger counts
MAX_EDGES = 12_000  # edge pixels: an image with more is too cluttered to be searched
LEAST_RADIUS, MOST_RADIUS = 5.0, 80.0  # px at the working size
RADIUS_STEP = 1.07  # between the radii that are voted for
CELL = 2  # px: side of a cell that votes are gathered in
LEAST_VOTES = 0.2  # of the circumference
LEAST_ARC = 0.1  # of the circumference that lies on edges
MAX_CIRCLES = 32
NEAR = 0.035, 1.0  # of the radius, px: edges this close to a circle lie on it
FACING = 0.93  # cosine of the angle between an edge's gradient and the radius
BINS = 72  # of the circumference
SAME = 0.15  # of the radius, by which centres and radii of one circle may differ


@dataclass(frozen=True)
class Circle:
    """A circle of the image, and which parts of its circumference lie on edges."""

    x: float  # px, of the image: pixel centres lie at halves
    y: float
    radius: float
    on_edges: frozenset[int]  # bins of the circumference, clockwise from the right

    @property
    def support(self) -> float:
        """Share of the circumference that lies on edges."""
        return len(self.on_edges) / BINS

    def is_same(self, other: Circle) -> bool:
        """Whether another circle is about the same."""
        apart = math.hypot(self.x - other.x, self.y - other.y)
        return apart < SAME * other.radius and abs(self.radius - other.radius) < SAME * other.radius


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of an image at the working size, one point per pixel along them."""

    points: Floats  # [N, 2] px
    normals: Floats  # [N, 2] unit vectors across the edge
    shape: tuple[int, int]  # height and width, px
    stretch: tuple[float, float]  # back to the image's size: x and y

    @staticmethod
    def of(image: Image) -> Edges | None:
        """The edges of an RGB image [H, W, 3]; None where it is too cluttered, or plain."""
        small = scaled(image, min(1.0, WORKING_SIDE / max(image.shape[:2])))
        points, normals = _edges(small)
        if not 20 <= len(points) <= MAX_EDGES:
            return None
        height, width = small.shape[:2]
        return Edges(points, normals, (height, width), (image.shape[1] / width, image.shape[0] / height))

    def circles(self) -> tuple[Circle, ...]:
        """The circles that stand out, those with most edges on them first."""
        found: list[Circle] = []
        for x, y, radius in _voted(self.points, self.normals, self.shape):
            fitted = _fitted(self.points, self.normals, x, y, radius)
            circle = None if fitted is None else self._enlarged(*fitted)
            if circle is not None and not any(circle.is_same(other) for other in found):
                found.append(circle)
        return tuple(sorted(found, key=lambda circle: -circle.support))

    def within(self, box: BBox) -> Edges:
        """Those in a box [x0, y0, x1, y1] of the image (px)."""
        stretch = np.array(self.stretch)
        inside = ((self.points > np.array(box[:2]) / stretch) & (self.points < np.array(box[2:]) / stretch)).all(axis=1)
        return replace(self, points=self.points[inside], normals=self.normals[inside])

    def fit(self, x: float, y: float, radius: float) -> Circle | None:
        """The circle near one of the image (px), if edges lie on it."""
        fx, fy = self.stretch
        x, y, radius = x / fx - 0.5, y / fy - 0.5, 2 * radius / (fx + fy)
        away = np.abs(self.points - np.array([x, y]))
        near = (away[:, 0] < 1.6 * radius) & (away[:, 1] < 1.6 * radius)
        fitted = _fitted(self.points[near], self.normals[near], x, y, radius)
        return None if fitted is None else self._enlarged(*fitted)

    def _enlarged(self, x: float, y: float, radius: float, on: frozenset[int]) -> Circle:
        fx, fy = self.stretch
        return Circle(float((x + 0.5) * fx), float((y + 0.5) * fy), radius * (fx + fy) / 2, on)


def _edges(small: Image) -> tuple[Floats, Floats]:
    """Points [N, 2] (px) where the gradient is strongest across the edge, and its unit vectors [N, 2]."""
    lab = np.asarray(cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), np.float32)
    blurred = cv2.GaussianBlur(lab, (0, 0), 1.0)
    dx, dy = (cv2.Sobel(blurred, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    strength = dx * dx + dy * dy
    channel = strength.argmax(axis=2)[..., None]
    gx, gy = (np.take_along_axis(values, channel, axis=2)[..., 0] for values in (dx, dy))
    total = np.sqrt(strength.sum(axis=2))
    length = np.maximum(np.hypot(gx, gy), 1e-6)
    nx, ny = gx / length, gy / length
    xs, ys = np.meshgrid(np.arange(total.shape[1], dtype=np.float32), np.arange(total.shape[0], dtype=np.float32))
    ahead, behind = (_at(total, xs + side * nx, ys + side * ny) for side in (1, -1))
    threshold = max(EDGE[0], EDGE[1] * float(np.median(total)))
    peak = (total > threshold) & (total >= ahead) & (total > behind)
    peak[:2] = peak[-2:] = False
    peak[:, :2] = peak[:, -2:] = False
    rows, columns = np.nonzero(peak)
    t, a, b = (values[rows, columns].astype(np.float64) for values in (total, ahead, behind))
    shift = np.clip(0.5 * (a - b) / np.maximum(2 * t - a - b, 1e-6), -0.5, 0.5)  # the vertex of a parabola
    normals = np.stack([nx[rows, columns], ny[rows, columns]], axis=1).astype(np.float64)
    return np.stack([columns, rows], axis=1) + shift[:, None] * normals, normals


def _at(values: Floats32, xs: Floats32, ys: Floats32) -> Floats32:
    return np.asarray(cv2.remap(values, xs, ys, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32)


def _voted(points: Floats, normals: Floats, shape: tuple[int, int]) -> list[tuple[float, float, float]]:
    """Centres and radii (px) with most votes for their size, the most first."""
    most = max(LEAST_RADIUS, min(MOST_RADIUS, min(shape) / 2))
    radii = LEAST_RADIUS * RADIUS_STEP ** np.arange(int(np.log(most / LEAST_RADIUS) / np.log(RADIUS_STEP)) + 1)
    rows, columns = shape[0] // CELL + 1, shape[1] // CELL + 1
    scores = np.zeros((len(radii), rows, columns), np.float32)
    for layer, radius in zip(scores, radii, strict=True):
        shift = radius * normals
        cells = (np.concatenate([points - shift, points + shift]) / CELL).round().astype(np.int64)
        inside = (cells >= 0).all(axis=1) & (cells[:, 0] < columns) & (cells[:, 1] < rows)
        index = cells[inside, 1] * columns + cells[inside, 0]
        votes = np.bincount(index, minlength=rows * columns).reshape(rows, columns).astype(np.float32)
        # Chance votes grow with the circumference as true ones do: weighed by its root, long arcs of large circles
        # come before whole circles of a few pixels.
        cv2.boxFilter(votes, -1, (3, 3), dst=layer, normalize=False)
        layer[layer < LEAST_VOTES * 2 * np.pi * radius] = 0
        layer /= np.float32(np.sqrt(2 * np.pi * radius))
    found: list[tuple[float, float, float]] = []
    best = scores.max(axis=0)
    while len(found) < MAX_CIRCLES:
        y, x = (int(v) for v in np.unravel_index(int(best.argmax()), best.shape))
        if best[y, x] <= 0:
            break
        i = int(scores[:, y, x].argmax())
        found.append((float(x * CELL), float(y * CELL), float(radii[i])))
        reach = max(1, round(0.2 * float(radii[i]) / CELL))
        near = slice(max(0, y - reach), y + reach + 1), slice(max(0, x - reach), x + reach + 1)
        scores[max(0, i - 3) : i + 4, *near] = 0
        best[near] = scores[:, *near].max(axis=0)
    return found


def _fitted(
    points: Floats, normals: Floats, x: float, y: float, radius: float
) -> tuple[float, float, float, frozenset[int]] | None:
    """The circle by least squares over the edges near one, twice; None where too few lie on it."""
    for reach in (0.12, 0.06):
        on, _ = _on_circle(points, normals, x, y, radius, max(2.0, reach * radius))
        if np.count_nonzero(on) < 8:
            return None
        chosen = points[on] - np.array([x, y])
        terms = np.column_stack([2 * chosen, np.ones(len(chosen))])  # x^2 + y^2 = 2ax + 2by + c, least squares
        a, b, c = np.linalg.lstsq(terms, (chosen**2).sum(axis=1), rcond=None)[0]
        fitted = float(np.sqrt(max(c + a * a + b * b, 0.0)))
        if not 0.7 * radius < fitted < 1.4 * radius or np.hypot(a, b) > 0.4 * radius:
            return None
        x, y, radius = float(x + a), float(y + b), fitted
    on, angles = _on_circle(points, normals, x, y, radius, max(NEAR[1], NEAR[0] * radius))
    bins = frozenset(int(v) % BINS for v in np.floor(angles[on] / (2 * np.pi) * BINS))
    return (x, y, radius, bins) if len(bins) >= LEAST_ARC * BINS else None


def _on_circle(
    points: Floats, normals: Floats, x: float, y: float, radius: float, reach: float
) -> tuple[np.ndarray[tuple[int], np.dtype[np.bool_]], Floats]:
    """Which edges [N] lie within `reach` px of a circle and face it, and the angles [N] of all of them (radians)."""
    away = points - np.array([x, y])
    distance = np.hypot(away[:, 0], away[:, 1])
    facing = np.abs((away * normals).sum(axis=1)) > FACING * distance
    return (np.abs(distance - radius) < reach) & facing, np.arctan2(away[:, 1], away[:, 0])
