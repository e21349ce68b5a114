"""How well cameras explain line segments: by vanishing points of vertical and level edges, and by round rims.

Lengths in the image are in its widths, from its middle: x right, y down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cow_service.media.types import Floats
from cow_service.records import BBox, Shape

DIRECTION_SIGMA = math.radians(0.7)  # of a segment, however long
END_SIGMA = 0.0012  # of the image's longer side, of a segment's direction times its length
UPRIGHT_SIGMA = math.radians(2.5)  # of a side against the upright: things lean and taper, and pictures are cropped
APEX_SIGMA = math.radians(2.0)  # of a side of a cone against the way to the middle of its box's upper edge
RIM_SIGMA = math.radians(4.0)  # of a segment that approximates an arc
UPRIGHT, LEVEL, NEITHER = 0.3, 0.3, 0.4  # of the segments of a thing
END_OF_RIM = 0.93  # of half a thing's width: beyond it a rim is too curved for segments
MOST_SEGMENTS = 10  # of one thing: the longest; what is costly grows with their square
BY_CHANCE = 0.2  # of the things whose edges fit some camera: masts taper and things lean, so that they fit another one
WEIGHT = 0.7  # of the evidence: an edge is often seen as several segments


def lengths_of(segments: Floats) -> Floats:
    """Lengths [N] (px) of segments [N, 4] (px)."""
    return np.hypot(*(segments[:, 2:] - segments[:, :2]).T)


@dataclass(frozen=True)
class Segments:
    """Line segments of an image."""

    middle: Floats  # [S, 2]
    along: Floats  # [S, 2], unit vectors
    sigma: Floats  # [S], radians

    @staticmethod
    def of(ends: Floats, size: tuple[int, int]) -> Segments:
        """Those with ends [S, 4] (px) in an image of a size (width, height; px), longest first; not too many."""
        ends = ends[:MOST_SEGMENTS]
        length = lengths_of(ends)
        middle = (ends[:, :2] + ends[:, 2:] - np.array(size)) / 2 / size[0]
        along = (ends[:, 2:] - ends[:, :2]) / length[:, None]
        return Segments(middle, along, np.hypot(DIRECTION_SIGMA, END_SIGMA * max(size) / length))


@dataclass(frozen=True)
class Views:
    """K cameras that may have taken an image."""

    focal: Floats  # [K]
    axes: Floats  # [K, 3, 3], rows: right, up and ahead over the floor

    def sines_down(self, points: Floats) -> Floats:
        """Sines [K, N] of the angles at which rays through image points [N, 2] lead down."""
        up = self.axes[:, 1]
        across = (up[:, :2] @ points.T) / self.focal[:, None] + up[:, 2:]
        return -across / np.sqrt(1 + (points**2).sum(axis=1) / self.focal[:, None] ** 2)

    def towards(self, points: Floats, directions: Floats) -> Floats:
        """Unit vectors [K, C, S, 2] from image points [S, 2] to the vanishing points of directions [K, C, 3]."""
        focal, depth = self.focal[:, None, None], directions[..., 2, None]
        x, y = (focal * directions[..., axis, None] - points[:, axis] * depth for axis in (0, 1))
        return np.stack([x, y], axis=-1) / (np.sqrt(x * x + y * y) + 1e-12)[..., None]

    def explain(self, segments: Segments, bbox: BBox | None, shape: Shape | None, size: tuple[int, int]) -> Floats:
        """Log likelihood [K], to a constant, of segments of a thing in a box (px), or of what has none, as the floor.

        Where its shape is not known, any shape is as likely as another one.
        """
        # Of the small angles between segments the sines are taken.
        down = self.towards(segments.middle, -self.axes[:, None, 1])[:, 0]
        sigma = np.hypot(segments.sigma, UPRIGHT_SIGMA)
        upright = UPRIGHT * _normal(_cross(segments.along, down), sigma) + NEITHER / math.pi
        likely = [np.full(len(self.focal), -math.log(math.pi) * len(segments.sigma))]  # of a thing of another form
        if bbox is None or shape in (None, "box"):
            likely.append(self._explain_level(segments, upright))
        if bbox is not None and shape != "box":
            box = (np.array(bbox).reshape(2, 2) - np.array(size) / 2) / size[0]  # its corners
            arcs = self._arcs(segments, down, box)
            for form, sides in (("cylinder", upright), ("cone", _slanted(segments, box))):
                if shape in (None, form):
                    likely.append(np.log(sides + arcs).sum(axis=1))
        logs = WEIGHT * np.logaddexp.reduce(likely)
        found = np.exp(logs - logs.max())
        return np.log((1 - BY_CHANCE) * found + BY_CHANCE * found.mean())

    def _explain_level(self, segments: Segments, upright: Floats) -> Floats:
        """As edges of a thing with square corners: upright [K, S], or level along one of two directions.

        How it is turned is not known. Each segment proposes the turn at which it is one of its level edges itself.
        """
        (x, y), (dx, dy) = segments.middle.T, segments.along.T
        # The plane through the camera and the segment; the level direction in it.
        plane = np.stack(np.broadcast_arrays(-dy * self.focal[:, None], dx * self.focal[:, None], x * dy - y * dx), 2)
        up = self.axes[:, None, 1]
        first = np.cross(up, plane)
        first /= np.linalg.norm(first, axis=2, keepdims=True) + 1e-12
        level = np.zeros((*first.shape[:2], len(x)))
        for directions in (first, np.cross(up, first)):
            towards = self.towards(segments.middle, np.asarray(directions, np.float64))
            level += LEVEL / 2 * _normal(_cross(segments.along, towards), segments.sigma)
        return _log_mean(np.log(level + upright[:, None]).sum(axis=2))

    def _arcs(self, segments: Segments, down: Floats, box: Floats) -> Floats:
        """Likelihoods [K, S] of segments as the near or far half of a level circle around the axis of a thing.

        The thing fills a box with corners [2, 2]. A circle is seen as an ellipse whose axes have the ratio of the sine
        of the angle at which it is looked down on; `down` [K, S, 2] leads to the vanishing point of what is upright.
        """
        place = (segments.middle[:, 0] - box[:, 0].mean()) / (box[1, 0] - box[0, 0]) * 2
        inner = np.clip(place, -END_OF_RIM, END_OF_RIM)
        slope = np.clip(self.sines_down(segments.middle), 0, 1) * inner / np.sqrt(1 - inner**2)
        sideways = _cross(segments.along, down)  # positive: to the right where the segment leads down
        downwards = segments.along[:, 0] * down[..., 0] + segments.along[:, 1] * down[..., 1]
        sigma = np.hypot(segments.sigma, RIM_SIGMA)
        near, far = (_normal((downwards + side * sideways) / np.hypot(1, slope), sigma) for side in (slope, -slope))
        return LEVEL / 2 * (near + far) * (np.abs(place) < END_OF_RIM)


def _slanted(segments: Segments, box: Floats) -> Floats:
    """Likelihoods [1, S] of segments as sides of a cone in a box with corners [2, 2], or as not belonging to it."""
    apex = np.array([box[:, 0].mean(), box[0, 1]])
    way = apex - segments.middle
    way /= np.linalg.norm(way, axis=1, keepdims=True) + 1e-12
    return (UPRIGHT * _normal(_cross(segments.along, way), APEX_SIGMA) + NEITHER / math.pi)[None]


def _cross(one: Floats, other: Floats) -> Floats:
    """Sines [...] of the angles from unit vectors [S, 2] to others [..., S, 2]."""
    return one[:, 0] * other[..., 1] - one[:, 1] * other[..., 0]


def _normal(value: Floats, sigma: Floats | float) -> Floats:
    return np.exp(-0.5 * (value / sigma) ** 2) / (sigma * math.sqrt(2 * math.pi))


def _log_mean(logs: Floats) -> Floats:
    """Logarithm [K] of the mean of what logs [K, C] are of."""
    most = logs.max(axis=1)
    return most + np.log(np.exp(logs - most[:, None]).mean(axis=1))
