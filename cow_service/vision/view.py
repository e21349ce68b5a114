"""Measures every pixel of an image against its wide surroundings: another hue, brighter, darker, or an edge."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cow_service.vision.masks import scaled
from cow_service.vision.types import Floats32, Image

CHROMA_STEP = 9.0  # Lab units from the surroundings: an object
BRIGHT_STEP = 5.0  # Lab lightness above the surroundings: an object
STRONG_CHROMA_STEP = 18.0  # Lab units from the surroundings: no wall or floor
EDGE_THRESHOLDS = ((1.0, 4.0), (0.6, 2.5))  # Lab units per px, and times the median gradient; the larger counts


@dataclass(frozen=True)
class View:
    """An image at the working size, against its surroundings."""

    lab: Floats32  # [h, w, 3] CIE Lab
    chroma_gap: Floats32  # distance from the surroundings in the a*b* plane
    bright: Floats32  # lightness above the surroundings
    around: Floats32  # lightness of the surroundings
    edges: Floats32  # Lab gradient per px
    median_edge: float  # of the whole image
    edge_threshold: float  # gradient from which the outline of an object may lie on it

    def crop(self, window: tuple[slice, slice]) -> View:
        """The same measurements for a part of the image."""
        gap, bright, around, edges = (
            layer[window] for layer in (self.chroma_gap, self.bright, self.around, self.edges)
        )
        return View(self.lab[window], gap, bright, around, edges, self.median_edge, self.edge_threshold)


def view_of(small: Image) -> View:
    """Measures every pixel against a median over half the image around it."""
    smooth = cv2.bilateralFilter(small, 5, 25, 5)
    lab = np.asarray(cv2.cvtColor(smooth.astype(np.float32) / 255, cv2.COLOR_RGB2LAB), np.float32)
    coarse = scaled(np.asarray(cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB), np.uint8), 0.25)
    size = small.shape[1], small.shape[0]
    around = cv2.resize(_surroundings(coarse), size, interpolation=cv2.INTER_LINEAR).astype(np.float32)
    around_l: Floats32 = np.divide(around[..., 0], 2.55, dtype=np.float32)
    gap = np.hypot(lab[..., 1] - (around[..., 1] - 128), lab[..., 2] - (around[..., 2] - 128))
    blurred = cv2.GaussianBlur(lab, (0, 0), 1.0)
    dx, dy = cv2.Sobel(blurred, cv2.CV_32F, 1, 0) / 8, cv2.Sobel(blurred, cv2.CV_32F, 0, 1) / 8
    edges = np.sqrt((dx * dx + dy * dy).sum(axis=2))
    median_edge = float(np.median(edges))
    edge_threshold = max(EDGE_THRESHOLDS[1][0], EDGE_THRESHOLDS[1][1] * median_edge)
    return View(lab, gap, lab[..., 0] - around_l, around_l, edges, median_edge, edge_threshold)


def _surroundings(coarse: Image) -> Image:
    """The median over half the image around every pixel of an 8-bit Lab image [h, w, 3], strong colours left out.

    What is left out is seen in a first pass; without this a large object would count as its own surroundings.
    """
    first = _wide_median(coarse)
    off = np.hypot(*np.moveaxis(coarse[..., 1:].astype(np.float32) - first[..., 1:], 2, 0))
    plain = (cv2.dilate((off > STRONG_CHROMA_STEP).astype(np.uint8), np.ones((3, 3), np.uint8)) == 0).astype(np.float32)
    if plain.all() or plain.mean() < 0.5:
        return first
    side = (min(coarse.shape[:2]),) * 2
    filled = cv2.blur(coarse * plain[..., None], side) / np.maximum(cv2.blur(plain, side)[..., None], 1e-3)
    return _wide_median(np.where(plain[..., None] > 0, coarse, filled).astype(np.uint8))


def _wide_median(coarse: Image) -> Image:
    side = int(0.5 * min(coarse.shape[:2])) | 1
    pad = side // 2
    padded = cv2.copyMakeBorder(coarse, pad, pad, pad, pad, cv2.BORDER_REFLECT)
    median = cv2.medianBlur(padded, side)[pad : pad + coarse.shape[0], pad : pad + coarse.shape[1]]
    return np.asarray(median, np.uint8)
