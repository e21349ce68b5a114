"""Measures every pixel of an image against its wide surroundings: another hue, brighter, darker, or an edge."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np

from cow_service.vision.masks import dilated, lab_of, scaled
from cow_service.vision.types import Floats32, Image

CHROMA_STEP = 9.0  # Lab units from the surroundings: an object
BRIGHT_STEP = 5.0  # Lab lightness above the surroundings: an object
STRONG_CHROMA_STEP = 18.0  # Lab units from the surroundings: no wall or floor
EDGE_THRESHOLDS = ((1.0, 4.0), (0.6, 2.5))  # Lab units per px, and times the median gradient; the larger counts


@dataclass(frozen=True)
class View:
    """An image at the working size, against its surroundings."""

    lab: Floats32  # [h, w, 3] CIE Lab
    chroma: Floats32  # distance from grey in the a*b* plane
    chroma_gap: Floats32  # distance from the surroundings in the a*b* plane
    bright: Floats32  # lightness above the surroundings
    around: Floats32  # lightness of the surroundings
    edges: Floats32  # Lab gradient per px
    median_edge: float  # of the whole image
    edge_threshold: float  # gradient from which the outline of an object may lie on it

    def crop(self, window: tuple[slice, slice]) -> View:
        """The same measurements for a part of the image."""
        names = ("lab", "chroma", "chroma_gap", "bright", "around", "edges")
        return replace(self, **{name: getattr(self, name)[window] for name in names})


def view_of(small: Image) -> View:
    """Measures every pixel against a median over half the image around it."""
    smooth = cv2.bilateralFilter(small, 5, 25, 5)
    lab = lab_of(np.asarray(smooth, np.uint8))
    coarse = scaled(np.asarray(cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB), np.uint8), 0.25)
    wide = _wide_median(coarse)
    # Strong colours, seen in a first pass, are left out: a large object would count as its own surroundings.
    off = np.hypot(*np.moveaxis(coarse[..., 1:].astype(np.float32) - wide[..., 1:], 2, 0))
    plain = (~dilated(off > STRONG_CHROMA_STEP)).astype(np.float32)
    if plain.mean() >= 0.5 and not plain.all():
        side = (min(coarse.shape[:2]),) * 2
        filled = cv2.blur(coarse * plain[..., None], side) / np.maximum(cv2.blur(plain, side)[..., None], 1e-3)
        wide = _wide_median(np.where(plain[..., None] > 0, coarse, filled).astype(np.uint8))
    around = cv2.resize(wide, small.shape[1::-1], interpolation=cv2.INTER_LINEAR).astype(np.float32)
    (lightness, a, b), (around_l, around_a, around_b) = cv2.split(lab), cv2.split(around)
    around_l = around_l / np.float32(2.55)
    gap = cv2.magnitude(a - (around_a - 128), b - (around_b - 128))
    edges = lab_gradients(lab)[2]
    median_edge = float(np.median(edges))
    return View(
        lab=lab,
        chroma=np.asarray(cv2.magnitude(a, b), np.float32),
        chroma_gap=np.asarray(gap, np.float32),
        bright=np.asarray(lightness - around_l, np.float32),
        around=np.asarray(around_l, np.float32),
        edges=edges,
        median_edge=median_edge,
        edge_threshold=max(EDGE_THRESHOLDS[1][0], EDGE_THRESHOLDS[1][1] * median_edge),
    )


def lab_gradients(lab: Floats32) -> tuple[Floats32, Floats32, Floats32]:
    """Of an image in CIE Lab, per px: to the right and down [h, w, 3], and the length of all of them [h, w]."""
    blurred = cv2.GaussianBlur(lab, (0, 0), 1.0)
    dx, dy = (np.asarray(cv2.Sobel(blurred, cv2.CV_32F, *order, scale=1 / 8), np.float32) for order in ((1, 0), (0, 1)))
    return dx, dy, np.asarray(cv2.sqrt(cv2.transform(dx * dx + dy * dy, np.ones((1, 3), np.float32))), np.float32)


def _wide_median(coarse: Image) -> Image:
    """The median over half the image around every pixel of an 8-bit Lab image [h, w, 3]."""
    side = int(0.5 * min(coarse.shape[:2])) | 1
    pad = side // 2
    padded = cv2.copyMakeBorder(coarse, pad, pad, pad, pad, cv2.BORDER_REFLECT)
    median = cv2.medianBlur(padded, side)[pad : pad + coarse.shape[0], pad : pad + coarse.shape[1]]
    return np.asarray(median, np.uint8)


CHROMATIC = 9.0  # Lab chroma from which a surface has a hue
BROWN_LIGHTNESS = 42.0  # below it and muted, orange is called brown
BROWN_CHROMA = 36.0
RED_CHROMA = 34.0  # a paler red is called pink

GREYS = (28.0, 70.0)  # lightness of what people may call grey: white in shade too

# Upper end of each name's hue range, degrees in the a*b* plane.
HUES = (
    (20.0, "pink"),
    (48.0, "red"),
    (77.0, "orange"),
    (110.0, "yellow"),
    (178.0, "green"),
    (245.0, "cyan"),
    (298.0, "blue"),
    (334.0, "purple"),
    (360.0, "pink"),
)

HUE_MARGIN, CHROMA_MARGIN, LIGHTNESS_MARGIN = 7.0, 2.5, 5.0  # degrees, Lab units: near a border both names are valid


def colour_name(lightness: float, a: float, b: float) -> str:
    """The name of a Lab colour (lightness 0..100; a, b in CIE units)."""
    chroma = math.hypot(a, b)
    if chroma < CHROMATIC:
        return "black" if lightness < 28 else "white" if lightness > 52 else "grey"
    hue = math.degrees(math.atan2(b, a)) % 360
    name = next(name for end, name in HUES if hue <= end)
    if name == "red" and chroma < RED_CHROMA and lightness > 50:
        return "pink"
    if name in ("orange", "red") and chroma < BROWN_CHROMA and lightness < BROWN_LIGHTNESS:
        return "brown"
    return name


def colour_names(lightness: float, a: float, b: float) -> frozenset[str]:
    """Every name that people may give a Lab colour: its own, and that across a border it lies next to."""
    chroma, hue = math.hypot(a, b), math.atan2(b, a)
    names: set[str] = {"grey"} if chroma < CHROMATIC and GREYS[0] < lightness < GREYS[1] else set()
    for turn, more, lift in product((-1.0, 0.0, 1.0), repeat=3):
        angle, radius = hue + math.radians(turn * HUE_MARGIN), max(0.0, chroma + more * CHROMA_MARGIN)
        l_star = lightness + lift * LIGHTNESS_MARGIN
        names.add(colour_name(l_star, radius * math.cos(angle), radius * math.sin(angle)))
    return frozenset(names)
