"""Measures every pixel of an image against its wide surroundings: another hue, brighter, darker, or an edge."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np

from cow_service.media.masks import dilated, lab_of, scaled
from cow_service.media.types import Floats32, Image


class ViewRules(NamedTuple):
    """How pixels are told from their surroundings.

    Set by hand on rendered scenes of the first family; no single number has a measurement of its own.
    """

    working_side: int = 512  # px: images are measured and searched at this size
    chroma_step: float = 9.0  # Lab units from the surroundings: an object
    bright_step: float = 5.0  # Lab lightness above the surroundings: an object
    strong_chroma_step: float = 18.0  # Lab units from the surroundings: no wall or floor
    wide: float = 0.5  # of the image's shorter side: the window of the surroundings
    strip: tuple[float, float] = (1.2, 0.16)  # of the same side, across and down: a lower window
    median_side: int = 15  # px: windows are squeezed to this size
    spread_limit: float = 25.0  # Lab lightness: what differs by more is no texture
    # Lab units per px, and times the median gradient; the larger counts
    edges: tuple[tuple[float, float], tuple[float, float]] = ((1.0, 4.0), (0.6, 2.5))


VIEW = ViewRules()


LIGHT_OFFSET = np.float32(16.0)  # L* + 16 is proportional to the cube root of the light, as a* and b* are


@dataclass(frozen=True)
class View:
    """An image at the working size, against its surroundings."""

    lab: Floats32  # [h, w, 3] CIE Lab
    chroma: Floats32  # distance from grey in the a*b* plane
    chroma_gap: Floats32  # distance in the a*b* plane from the surroundings, lit or shaded as the pixel is
    bright: Floats32  # lightness above the surroundings
    around: Floats32  # lightness of the surroundings
    spread: Floats32  # how far the lightness of the surroundings varies: the texture of a floor is no thing
    edges: Floats32  # length of all Lab gradients, per px
    median_edge: float  # of the whole image
    edge_threshold: float  # gradient from which the outline of an object may lie on it

    @cached_property
    def light(self) -> Floats32:
        """Share (0..1 and more) of the surroundings' light that a pixel gets if it is of the same matter, cube root."""
        return np.asarray((self.lab[..., 0] + LIGHT_OFFSET) / (self.around + LIGHT_OFFSET), np.float32)

    def crop(self, window: tuple[slice, slice]) -> View:
        """The same measurements for a part of the image."""
        names = ("lab", "chroma", "chroma_gap", "bright", "around", "spread", "edges")
        return replace(self, **{name: getattr(self, name)[window] for name in names})


def view_of(small: Image) -> View:
    """Measures every pixel against the surface around it: the nearer in colour of two medians.

    One is over half the image around the pixel. The other is over a strip as wide and much lower, so that on either
    side of the line between floor and wall each is compared with itself. Light scales L* + 16, a* and b* alike, so
    that a shadow and the texture of a floor differ from it in lightness alone.
    """
    smooth = cv2.bilateralFilter(small, 5, 25, 5)
    lab = lab_of(np.asarray(smooth, np.uint8))
    coarse = scaled(np.asarray(cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB), np.uint8), 0.25)
    wide = _median(coarse, VIEW.wide, VIEW.wide)
    # Strong colours, seen in a first pass, are left out: a large object would count as its own surroundings.
    off = np.hypot(*np.moveaxis(coarse[..., 1:].astype(np.float32) - wide[..., 1:], 2, 0))
    plain = (~dilated(off > VIEW.strong_chroma_step)).astype(np.float32)
    if plain.mean() >= 0.5 and not plain.all():
        side = (min(coarse.shape[:2]),) * 2
        filled = cv2.blur(coarse * plain[..., None], side) / np.maximum(cv2.blur(plain, side)[..., None], 1e-3)
        coarse = np.where(plain[..., None] > 0, coarse, filled).astype(np.uint8)
        wide = _median(coarse, VIEW.wide, VIEW.wide)
    strip = _median(coarse, *VIEW.strip)
    planes = [np.asarray(plane, np.float32) for plane in cv2.split(lab)]
    distance, gap, around = _against(planes, wide)
    # The line is known to a pixel of the strip.
    for shifted in (np.concatenate([strip[1:], strip[-1:]]), np.concatenate([strip[:1], strip[:-1]])):
        other = _against(planes, shifted)
        nearer = other[0] < distance
        distance, gap, around = (np.where(nearer, *pair) for pair in zip(other, (distance, gap, around), strict=True))
    bright = np.asarray(planes[0] - around, np.float32)
    off_light = np.where(gap < VIEW.chroma_step, np.minimum(np.abs(bright), VIEW.spread_limit), 0)
    deviation = scaled(np.asarray(off_light * (255 / VIEW.spread_limit), np.uint8), 0.25)
    typical = np.maximum(_median(deviation, VIEW.wide, VIEW.wide), _median(deviation, *VIEW.strip)).astype(np.float32)
    spread = cv2.resize(typical * np.float32(1.48 * VIEW.spread_limit / 255), small.shape[1::-1])
    edges = lab_gradients(lab)[2]
    median_edge = float(np.median(edges))
    return View(
        lab=lab,
        chroma=np.asarray(cv2.magnitude(*planes[1:]), np.float32),
        chroma_gap=np.asarray(gap, np.float32),
        bright=bright,
        around=np.asarray(around, np.float32),
        spread=np.asarray(spread, np.float32),
        edges=edges,
        median_edge=median_edge,
        edge_threshold=max(VIEW.edges[1][0], VIEW.edges[1][1] * median_edge),
    )


def _against(planes: Sequence[Floats32], surface: Image) -> tuple[Floats32, Floats32, Floats32]:
    """How far pixels, in three planes [h, w] of Lab, are from a surface's colours [h', w', 3], in the a*b* plane alone,
    and its lightness."""
    own, size = planes[0], planes[0].shape[1::-1]
    lightness, a, b = (
        cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR).astype(np.float32) for plane in cv2.split(surface)
    )
    lightness, a, b = lightness / np.float32(2.55), a - 128, b - 128
    light = (own + LIGHT_OFFSET) / (lightness + LIGHT_OFFSET)
    gap = np.asarray(cv2.magnitude(planes[1] - light * a, planes[2] - light * b), np.float32)
    return gap + np.float32(0.5) * np.abs(own - lightness), gap, lightness


def lab_gradients(lab: Floats32) -> tuple[Floats32, Floats32, Floats32]:
    """Of an image in CIE Lab, per px: to the right and down [h, w, 3], and the length of all of them [h, w]."""
    blurred = cv2.GaussianBlur(lab, (0, 0), 1.0)
    dx, dy = (np.asarray(cv2.Sobel(blurred, cv2.CV_32F, *order, scale=1 / 8), np.float32) for order in ((1, 0), (0, 1)))
    return dx, dy, np.asarray(cv2.sqrt(cv2.transform(dx * dx + dy * dy, np.ones((1, 3), np.float32))), np.float32)


def _median(coarse: Image, across: float, down: float) -> Image:
    """The median of an 8-bit image [h, w, ...] over a window around every pixel, in shares of the shorter side."""
    height, width = coarse.shape[:2]
    shorter = min(height, width)
    w, h = (
        min(side, max(1, round(side * VIEW.median_side / (share * shorter))))
        for side, share in ((width, across), (height, down))
    )
    small = cv2.resize(coarse, (w, h), interpolation=cv2.INTER_AREA)
    pad = VIEW.median_side // 2
    padded = cv2.copyMakeBorder(small, pad, pad, pad, pad, cv2.BORDER_REFLECT)
    median = cv2.medianBlur(padded, VIEW.median_side)[pad : pad + h, pad : pad + w]
    return np.asarray(cv2.resize(median, (width, height), interpolation=cv2.INTER_LINEAR), np.uint8)


class ColourRules(NamedTuple):
    """Where the names of colours end, in CIE Lab.

    Set by hand on the colours of rendered things and on the named colours of CSS, all of which keep their names.
    """

    chromatic: float = 9.0  # Lab chroma from which a surface has a hue
    brown_lightness: float = 42.0  # below it and muted, orange is called brown
    brown_chroma: float = 36.0  # below it
    red_chroma: float = 34.0  # a paler red is called pink
    # degrees, chroma over L* + 16: Lab bends the hue of the purest blues towards purple
    pure_blue: tuple[float, float] = (309.0, 1.6)
    dark_reds: float = 42.0  # lightness below which people may call red or orange brown
    olive: float = 60.0  # lightness below which people may call yellow green
    greys: tuple[float, float] = (28.0, 80.0)  # lightness of what people may call grey: white in shade too
    hue_margin: float = 7.0  # degrees: near a border both names are valid
    chroma_margin: float = 2.5  # the same
    lightness_margin: float = 5.0  # the same


COLOUR = ColourRules()


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


def colour_name(lightness: float, a: float, b: float) -> str:
    """The name of a Lab colour (lightness 0..100; a, b in CIE units)."""
    chroma = math.hypot(a, b)
    if chroma < COLOUR.chromatic:
        return "black" if lightness < 28 else "white" if lightness > 52 else "grey"
    hue = math.degrees(math.atan2(b, a)) % 360
    name = next(name for end, name in HUES if hue <= end)
    if name == "purple" and hue < COLOUR.pure_blue[0] and chroma > COLOUR.pure_blue[1] * (lightness + LIGHT_OFFSET):
        return "blue"
    if name == "red" and chroma < COLOUR.red_chroma and lightness > 50:
        return "pink"
    if name in ("orange", "red") and chroma < COLOUR.brown_chroma and lightness < COLOUR.brown_lightness:
        return "brown"
    return name


def colour_names(lightness: float, a: float, b: float) -> frozenset[str]:
    """Every name that people may give a Lab colour: its own, and that across a border it lies next to."""
    chroma, hue = math.hypot(a, b), math.atan2(b, a)
    names: set[str] = {"grey"} if chroma < COLOUR.chromatic and COLOUR.greys[0] < lightness < COLOUR.greys[1] else set()
    for turn, more, lift in product((-1.0, 0.0, 1.0), repeat=3):
        angle, radius = hue + math.radians(turn * COLOUR.hue_margin), max(0.0, chroma + more * COLOUR.chroma_margin)
        l_star = lightness + lift * COLOUR.lightness_margin
        names.add(colour_name(l_star, radius * math.cos(angle), radius * math.sin(angle)))
    if lightness < COLOUR.dark_reds and names & {"red", "orange"}:
        names.add("brown")
    if lightness < COLOUR.olive and "yellow" in names:
        names.add("green")
    return frozenset(names)
