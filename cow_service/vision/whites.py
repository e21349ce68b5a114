"""Completes white objects: faces in shade, as dark as the floor, that edges enclose below or beside a bright top."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.vision.masks import outline_of
from cow_service.vision.types import Mask
from cow_service.vision.view import BRIGHT_STEP, CHROMA_STEP, EDGE_THRESHOLDS, View

BRIGHT_REACH = 1.6  # Lab lightness above the surroundings: another lit face
LEAST_TOP, LEAST_WHITE = 20, 60  # px: a bright top, and one that is surely of something white
LEAST_SIDE = 12  # px
MAX_SIDE, MAX_RATIO = 0.1, 12  # of the image, and of the top's area: one shaded side
HANGS = 0.7  # of a side's width that lies below the top
SHARP_TOP = 0.7  # of a top's outline that lies on edges: with less it is a shine on the floor
WEAK_EDGES = (0.45, 1.8)  # as `EDGE_THRESHOLDS`: the sides of something surely white stand out by as little

_KERNEL = np.ones((3, 3), np.uint8)
_Box = tuple[int, int, int, int]  # x, y, width, height


class _Tops:
    """Bright patches, by their label."""

    def __init__(self, view: View, white: Mask) -> None:
        _, labels, stats, _ = cv2.connectedComponentsWithStats(white.astype(np.uint8), connectivity=8)
        self.white = white
        self.labels = np.asarray(labels, np.int32)
        self.boxes: list[_Box] = [(int(x), int(y), int(w), int(h)) for x, y, w, h in stats[:, :4]]
        self.areas = [int(area) for area in stats[:, 4]]
        self._near_edges = (
            cv2.dilate((view.edges > view.edge_threshold).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        )
        self._chroma = np.hypot(view.lab[..., 1], view.lab[..., 2])

    def is_sharp(self, top: int) -> bool:
        """Whether its outline lies on edges."""
        x, y, w, h = self.boxes[top]
        around = slice(max(0, y - 1), y + h + 1), slice(max(0, x - 1), x + w + 1)
        return float(np.mean(self._near_edges[around][outline_of(self.labels[around] == top)])) > SHARP_TOP

    def surely_white(self) -> frozenset[int]:
        """Those that have no colour of their own and a sharp outline."""
        tops = [top for top, area in enumerate(self.areas) if top and area >= LEAST_WHITE]
        return frozenset(top for top in tops if self._is_neutral(top) and self.is_sharp(top))

    def _is_neutral(self, top: int) -> bool:
        x, y, w, h = self.boxes[top]
        window = slice(y, y + h), slice(x, x + w)
        return float(np.median(self._chroma[window][self.labels[window] == top])) < CHROMA_STEP


def white_sides(view: View, core: Mask) -> Mask:
    """Patches enclosed by edges at a bright neutral top: the other faces of something white, lit or in shade.

    `core` [h, w] are the pixels that are surely of an object.
    """
    chroma = np.hypot(view.lab[..., 1], view.lab[..., 2])
    neutral = (chroma < 2 * CHROMA_STEP) | (view.chroma_gap < CHROMA_STEP)
    tops = _Tops(view, core & (view.bright > BRIGHT_STEP) & neutral)
    sides = _lit_fronts(view, tops)
    white = tops.surely_white()
    for thresholds in (*EDGE_THRESHOLDS, *([WEAK_EDGES] if white else [])):
        weak = thresholds == WEAK_EDGES
        for near, patch, box in _enclosed(view, *thresholds):
            if weak and float(np.median(chroma[near][patch > 0])) > CHROMA_STEP:
                continue
            touched = set(np.unique(tops.labels[near][cv2.dilate(patch, _KERNEL, iterations=4) > 0]).tolist()) - {0}
            lit = len(touched) > 0 and float(np.median(view.bright[near][patch > 0])) > BRIGHT_REACH
            if any(_belongs(tops, top, box, int(patch.sum()), lit) for top in (touched & white if weak else touched)):
                sides[near] |= cv2.dilate(patch, _KERNEL, iterations=2) > 0
    return sides


def _enclosed(view: View, floor: float, factor: float) -> Iterator[tuple[tuple[slice, slice], NDArray[np.uint8], _Box]]:
    """Patches between edges that do not reach the image's border: where they lie, their mask there, and their box."""
    height, width = view.edges.shape
    edge_threshold = max(floor, factor * view.median_edge)
    edges = cv2.morphologyEx((view.edges > edge_threshold).astype(np.uint8), cv2.MORPH_CLOSE, _KERNEL)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(1 - edges, connectivity=4)
    for i in range(1, count):
        x, y, w, h, area = (int(v) for v in stats[i])
        if area < LEAST_SIDE or area > MAX_SIDE * height * width:
            continue
        if x == 0 or y == 0 or x + w == width or y + h == height:
            continue
        near = slice(max(0, y - 4), y + h + 4), slice(max(0, x - 4), x + w + 4)
        yield near, (labels[near] == i).astype(np.uint8), (x, y, w, h)


def _belongs(tops: _Tops, top: int, side: _Box, area: int, lit: bool) -> bool:
    """Whether a side is a top's: small beside it, and lit or right below it."""
    x, y, w, _ = side
    tx, ty, tw, _ = tops.boxes[top]
    overlap = min(x + w, tx + tw + 3) - max(x, tx - 3)
    hangs = overlap > HANGS * w and y >= ty
    return tops.areas[top] >= LEAST_TOP and area < MAX_RATIO * tops.areas[top] and (lit or hangs)


def _lit_fronts(view: View, tops: _Tops) -> Mask:
    """Slightly lit pixels joined to a bright top, right below it and no further down than the top is wide."""
    lit = (cv2.GaussianBlur(view.bright, (0, 0), 1.5) > BRIGHT_REACH) | tops.white
    fronts = np.zeros(lit.shape, bool)
    for top, (x, y, w, h) in enumerate(tops.boxes):
        if top == 0 or tops.areas[top] < LEAST_TOP or not 0.2 * w < h < 0.8 * w or not tops.is_sharp(top):
            continue
        window = slice(y, y + h + w), slice(x, x + w)
        _, blobs = cv2.connectedComponents(lit[window].astype(np.uint8), connectivity=4)
        joined = np.unique(blobs[tops.labels[window] == top])
        fronts[window] |= np.isin(blobs, joined[joined > 0])
    return fronts
