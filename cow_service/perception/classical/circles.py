"""Finds circles among the edges of an image, whole or in part: the outlines of balls, also of balls that overlap.

Every edge pixel votes for the centres that lie along its gradient (Hough transform for circles, Duda and Hart, 1972);
what has most votes is fitted to the edges by least squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from cow_service.media.masks import lab_of, scaled
from cow_service.media.types import Floats, Image, Mask
from cow_service.perception.classical.contrast import VIEW, lab_gradients
from cow_service.records import Point


class CircleRules(NamedTuple):
    """Which edges are a circle.

    Set by hand on trails of the first family of rendered scenes and on drawn ones; lengths in px are at the working
    size. No single number has a measurement of its own.
    """

    edge: tuple[float, float] = (1.0, 2.2)  # Lab units per px, and times the median gradient; the larger counts
    max_edges: int = 12_000  # edge pixels: an image with more is too cluttered to be searched
    least_radius: float = 5.0  # px
    most_radius: float = 80.0  # px
    radius_step: float = 1.08  # between the radii that are voted for
    cell: int = 2  # px: side of a cell that votes are gathered in
    least_votes: float = 0.2  # of the circumference
    least_on: int = 8  # edges: fewer tell no circle
    first_reach: float = 0.12  # of the radius: edges this close to a circle are fitted
    second_reach: float = 0.06  # the same, when it is fitted again
    line: float = 1e-9  # 1 - r^2 of points on a line, through which no circle goes
    least_arc: float = 0.1  # of the circumference that lies on edges
    max_circles: int = 32  # that are tried
    near: tuple[float, float] = (0.035, 1.0)  # of the radius, px: edges this close to a circle lie on it
    facing: float = 0.93  # cosine of the angle between an edge's gradient and the radius
    notch_facing: float = 0.7  # of a notch, at most: cosine between an edge's gradient and the line of both centres
    notch_reach: float = 1.5  # px beyond the notch's depth in which edges are of it
    least_notch: int = 4  # edges
    same: float = 0.15  # of the radius, by which centres and radii of one circle may differ


CIRCLE = CircleRules()


BINS = 72  # of the circumference


@dataclass(frozen=True)
class Circle:
    """A circle of the image, and which parts of its circumference lie on edges."""

    x: float  # px, of the image: pixel centres lie at halves
    y: float
    radius: float
    on_edges: frozenset[int]  # bins of the circumference, clockwise from the right

    @property
    def centre(self) -> Point:
        """px."""
        return self.x, self.y

    @property
    def support(self) -> float:
        """Share of the circumference that lies on edges."""
        return len(self.on_edges) / BINS

    def is_same(self, other: Circle) -> bool:
        """Whether another circle is about the same."""
        apart = math.dist(self.centre, other.centre)
        return apart < CIRCLE.same * other.radius and abs(self.radius - other.radius) < CIRCLE.same * other.radius


@dataclass(frozen=True, eq=False)
class Edges:
    """The edges of an image at the working size, one point per pixel along them."""

    points: Floats  # [N, 2] px, from the top down
    normals: Floats  # [N, 2] unit vectors across the edge
    shape: tuple[int, int]  # height and width, px
    stretch: tuple[float, float]  # back to the image's size: x and y

    @staticmethod
    def of(image: Image) -> Edges | None:
        """The edges of an RGB image [H, W, 3]; None if it is too cluttered, or plain."""
        dx, dy, total = lab_gradients(lab_of(scaled(image, min(1.0, VIEW.working_side / max(image.shape[:2])))))
        strong = total > max(CIRCLE.edge[0], CIRCLE.edge[1] * float(np.median(total[::2, ::2])))
        strong[:2] = strong[-2:] = False
        strong[:, :2] = strong[:, -2:] = False
        rows, columns = np.nonzero(strong)
        gx, gy = dx[rows, columns], dy[rows, columns]
        each, channel = np.arange(len(rows)), (gx * gx + gy * gy).argmax(axis=1)
        normals = np.stack([gx[each, channel], gy[each, channel]], axis=1).astype(np.float64)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-6)
        points = np.stack([columns, rows], axis=1).astype(np.float64)
        # Where the gradient is strongest across the edge: at the vertex of a parabola.
        here = total[rows, columns].astype(np.float64)
        x, y = np.concatenate([points + normals, points - normals]).T
        left, top = x.astype(np.int64), y.astype(np.int64)
        u, v = x - left, y - top
        upper = (1 - u) * total[top, left] + u * total[top, left + 1]
        lower = (1 - u) * total[top + 1, left] + u * total[top + 1, left + 1]
        ahead, behind = np.split((1 - v) * upper + v * lower, 2)
        peak = (here >= ahead) & (here > behind)
        if not 20 <= np.count_nonzero(peak) <= CIRCLE.max_edges:
            return None
        here, ahead, behind, points, normals = (values[peak] for values in (here, ahead, behind, points, normals))
        bend = np.maximum(2 * here - ahead - behind, 1e-6)
        points += np.clip(0.5 * (ahead - behind) / bend, -0.5, 0.5)[:, None] * normals
        down, (height, width) = np.argsort(points[:, 1], kind="stable"), total.shape
        stretch = image.shape[1] / width, image.shape[0] / height
        return Edges(points[down], normals[down], (height, width), stretch)

    def circles(self) -> tuple[Circle, ...]:
        """The circles that stand out, those with most edges on them first."""
        least, step = CIRCLE.least_radius, CIRCLE.radius_step
        most = max(least, min(CIRCLE.most_radius, min(self.shape) / 2))
        radii = least * step ** np.arange(int(np.log(most / least) / np.log(step)) + 1)
        rows, columns = self.shape[0] // CIRCLE.cell + 1, self.shape[1] // CIRCLE.cell + 1
        scores = np.zeros((len(radii), rows, columns), np.float32)
        x, y = (np.concatenate([values, values]).astype(np.float32) / CIRCLE.cell + 0.5 for values in self.points.T)
        nx, ny = (np.concatenate([values, -values]).astype(np.float32) / CIRCLE.cell for values in self.normals.T)
        for i, radius in enumerate(radii.astype(np.float32)):
            column, row = np.floor(x + radius * nx).astype(np.int32), np.floor(y + radius * ny).astype(np.int32)
            inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
            index = (row * columns + column)[inside]
            votes = np.bincount(index, minlength=rows * columns).reshape(rows, columns).astype(np.float32)
            # Chance votes grow with the circumference as true ones do: weighed by its root, long arcs of large circles
            # come before whole circles of a few pixels.
            gathered = np.asarray(cv2.boxFilter(votes, -1, (3, 3), normalize=False), np.float32)
            gathered[gathered < CIRCLE.least_votes * 2 * np.pi * radius] = 0
            scores[i] = gathered / np.sqrt(2 * np.pi * radius)
        found: list[Circle] = []
        best = scores.max(axis=0)
        for _ in range(CIRCLE.max_circles):
            row, column = (int(v) for v in np.unravel_index(int(best.argmax()), best.shape))
            if best[row, column] <= 0:
                break
            i = int(scores[:, row, column].argmax())
            circle = self._fitted(float(column * CIRCLE.cell), float(row * CIRCLE.cell), float(radii[i]))
            if circle is not None and not any(circle.is_same(other) for other in found):
                found.append(circle)
            reach = max(1, round(0.2 * float(radii[i]) / CIRCLE.cell))
            near = slice(max(0, row - reach), row + reach + 1), slice(max(0, column - reach), column + reach + 1)
            scores[max(0, i - 3) : i + 4, *near] = 0
            best[near] = scores[:, *near].max(axis=0)
        return tuple(sorted(found, key=lambda circle: -circle.support))

    def fit(self, x: float, y: float, radius: float) -> Circle | None:
        """The circle near one of the image (px), if edges lie on it."""
        fx, fy = self.stretch
        return self._fitted(x / fx - 0.5, y / fy - 0.5, 2 * radius / (fx + fy))

    def notch(self, a: Circle, b: Circle) -> float | None:
        """How deep the outline is notched where two circles overlap: 1 as theirs is, 0 as straight as a bottle's side.

        None if no edges are seen there, or the circles lie apart.
        """
        stretch = np.array(self.stretch)
        start, end = (np.array([c.x, c.y]) / stretch - 0.5 for c in (a, b))
        first, last = (2 * c.radius / float(stretch.sum()) for c in (a, b))
        gap = float(np.linalg.norm(end - start))
        if gap > 1.9 * min(first, last):
            return None
        along = (end - start) / gap
        way = (self.points - start) @ along / gap
        aside = np.abs((self.points - start) @ np.array([-along[1], along[0]]))
        radius = first + (last - first) * way
        depth = radius - np.sqrt(np.maximum(radius**2 - (gap * np.minimum(np.abs(way), np.abs(1 - way))) ** 2, 0))
        facing = np.abs(self.normals @ along) < CIRCLE.notch_facing
        facing &= np.abs(aside - radius + depth / 2) < depth / 2 + CIRCLE.notch_reach
        between = facing & (np.abs(way - 0.5) < 0.22)
        beside = facing & (np.minimum(np.abs(way), np.abs(1 - way)) < 0.2)
        if min(np.count_nonzero(between), np.count_nonzero(beside)) < CIRCLE.least_notch:
            return None
        # Against the outline beside the centres: fitted radii are not exact to the notch's depth.
        step = float((aside - radius)[beside].mean() - (aside - radius)[between].mean())
        return step / max(float(depth[between].mean() - depth[beside].mean()), 1e-6)

    def _fitted(self, x: float, y: float, radius: float) -> Circle | None:
        """The circle by least squares over the edges near one of the working size, twice; None if few lie on it."""
        reach = 1.6 * radius
        first, last = np.searchsorted(self.points[:, 1], (y - reach, y + reach))
        columns = self.points[first:last, 0]
        near = first + np.nonzero((columns > x - reach) & (columns < x + reach))[0]
        points, normals = self.points[near], self.normals[near]
        for share in (CIRCLE.first_reach, CIRCLE.second_reach):
            on, across, down = _on_circle(points, normals, x, y, radius, max(2.0, share * radius))
            if np.count_nonzero(on) < CIRCLE.least_on:
                return None
            a, b, fitted = fit_circle(across[on], down[on])
            if not 0.7 * radius < fitted < 1.4 * radius or math.hypot(a, b) > 0.4 * radius:
                return None
            x, y, radius = x + a, y + b, fitted
        on, across, down = _on_circle(points, normals, x, y, radius, max(CIRCLE.near[1], CIRCLE.near[0] * radius))
        turns = np.arctan2(down[on], across[on]) / (2 * np.pi)
        bins = frozenset((np.floor(turns * BINS).astype(int) % BINS).tolist())
        if len(bins) < CIRCLE.least_arc * BINS:
            return None
        fx, fy = self.stretch
        return Circle(float((x + 0.5) * fx), float((y + 0.5) * fy), radius * (fx + fy) / 2, bins)


def fit_circle(across: Floats, down: Floats) -> tuple[float, float, float]:
    """Centre and radius of the circle x^2 + y^2 = 2ax + 2by + c through points [N], by its normal equations."""
    count = len(across)
    squares = across * across + down * down
    terms = np.stack([across, down, squares, np.ones(count)])
    (xx, xy, xz, x), (_, yy, yz, y), (_, _, _, z), _ = (terms @ terms.T).tolist()
    xx, xy, yy = xx - x * x / count, xy - x * y / count, yy - y * y / count
    xz, yz = xz - x * z / count, yz - y * z / count
    determinant = xx * yy - xy * xy
    if determinant <= CIRCLE.line * xx * yy:  # equal where all of them have the same x or y
        return math.inf, math.inf, math.inf
    a, b = (xz * yy - yz * xy) / determinant / 2, (yz * xx - xz * xy) / determinant / 2
    return a, b, math.sqrt(max((z - 2 * a * x - 2 * b * y) / count + a * a + b * b, 0.0))


def _on_circle(
    points: Floats, normals: Floats, x: float, y: float, radius: float, reach: float
) -> tuple[Mask, Floats, Floats]:
    """Which edges [N] lie within `reach` px of a circle and face it, and how far right and below its centre all are."""
    across, down = points[:, 0] - x, points[:, 1] - y
    distance = np.sqrt(across * across + down * down)
    facing = np.abs(across * normals[:, 0] + down * normals[:, 1]) > CIRCLE.facing * distance
    return (np.abs(distance - radius) < reach) & facing, across, down
