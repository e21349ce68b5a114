"""Finds the shadow that a ball in the air casts on the floor: a patch of ellipse shape, darker than the floor about it.

In a shadow the floor keeps its hue and only darkens. A patch of another hue, shape or size, one that touches an object,
or one of several alike is not taken for the shadow: None is returned instead of a guess.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from cow_service.media.masks import CroppedMask, lab_of, resized_mask, scaled
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.perception.classical.inpainting import quadratic_terms
from cow_service.physics.bodies import Shadow
from cow_service.records import BBox


class ShadowRules(NamedTuple):
    """When a dark ellipse is the shadow of a ball in the air.

    Set by hand on throws and falls of the first family of rendered scenes: without it three of 18 answers there are not
    sure. No single number has a measurement of its own.
    """

    working_width: float = 32.0  # px: the image is searched at the size at which the object is so wide
    least_width: float = 14.0  # px in the image: a smaller shadow is lost in the floor's texture
    likely_width: float = 0.95  # of the object's width: shadows looked for; the fit settles the rest
    # of their own width: their heights, on a floor seen at a slant
    flatness: tuple[float, float, float, float] = (0.25, 0.36, 0.5, 0.66)
    ring: tuple[float, float] = (1.15, 1.5)  # of the ellipse: the floor about it that it is compared with
    tries: int = 40  # the darkest patches that are looked at
    candidates: int = 3  # so many that stand alone are measured
    rival_shade: float = 0.6  # of the darkest patch's shade: another one as dark leaves it open which is the shadow
    explained: float = 0.5  # of what a smooth floor leaves unexplained around the patch, by a soft ellipse in it
    # of the ellipse: the width of its edge. An object's is sharper, a smear of light wider
    softness: tuple[float, float] = (0.02, 0.3)
    most_soft: float = 0.9  # softness of that of a thing high above the floor, which is as wide as a smear's
    dark: float = 0.15  # shade from which it may be: it is far darker than a smear
    well_explained: float = 0.85  # and an ellipse all the same
    same_hue: float = 5.0  # Lab units in the a*b* plane, by which a shade may differ from the floor about it, darkened
    evenness: float = 0.35  # of the mean step up to the floor on the four sides: the least of them
    least_pixels: int = 60  # of the floor about a patch, at the working size
    most_pixels: int = 700
    iterations: int = 8  # of the fit
    least_shade: float = 0.025  # of the floor's lightness that shadows take away, at least
    most_shade: float = 0.6  # the same: more is an object
    nearest: float = 0.25  # of the ball's width, from its foot to the shadow's middle: nearer, it may touch the floor
    slant: float = 1.1  # px sideways per px down: light indoors falls steeper


SHADOW = ShadowRules()


QUARTERS = (0.0, np.pi / 2, np.pi, -np.pi / 2)  # radians

Ellipse = tuple[float, float, float, float]  # centre and half axes, px


@dataclass(frozen=True)
class _Floor:
    """The image below the object at the working size, with other objects blanked out."""

    lab: Floats32  # [h, w, 3] CIE Lab
    free: Mask  # [h, w]: no object there
    box: BBox  # of the object in the air
    top: int  # px: the row of the image at which it begins
    stretch: tuple[float, float]  # back to the image's size

    @staticmethod
    def below(bbox: BBox, image: Image, others: Sequence[CroppedMask]) -> _Floor:
        """The floor of an image below an object in the air."""
        scale = min(1.0, SHADOW.working_width / (bbox[2] - bbox[0]))
        small = scaled(image, scale)
        height, width = small.shape[:2]
        taken = np.zeros(image.shape[:2], bool)
        for mask in others:
            mask.add_to(taken)
        taken[max(0, int(bbox[1])) : int(np.ceil(bbox[3])), max(0, int(bbox[0])) : int(np.ceil(bbox[2]))] = True
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
        grown = cv2.dilate(resized_mask(taken, (width, height)).astype(np.uint8), kernel) > 0
        top = min(height - 1, max(0, int(bbox[3] * scale)))
        box = (bbox[0] * scale, bbox[1] * scale - top, bbox[2] * scale, bbox[3] * scale - top)
        return _Floor(lab_of(small)[top:], ~grown[top:], box, top, (image.shape[1] / width, image.shape[0] / height))

    def candidates(self) -> Iterator[Ellipse]:
        """Upright ellipses below the object that stand out from the ring about them, the clearest first."""
        left, top, right, bottom = self.box
        width = right - left
        ys, xs = np.mgrid[: self.free.shape[0], : self.free.shape[1]]
        below = (ys > bottom + SHADOW.nearest * width) & (
            np.abs(xs - (left + right) / 2) < SHADOW.slant * (ys - (top + bottom) / 2) + 0.5 * width
        )
        best = np.zeros(self.free.shape, np.float32)
        which = np.zeros(self.free.shape, np.int64)
        sizes = [(SHADOW.likely_width * width / 2, flat * SHADOW.likely_width * width / 2) for flat in SHADOW.flatness]
        for i, (a, b) in enumerate(sizes):
            contrast = self.contrast(a, b)
            better = contrast > best
            best[better], which[better] = contrast[better], i
        best[~below] = 0
        least, alone = 0.6 * SHADOW.least_shade, 0
        for _ in range(SHADOW.tries):
            y, x = (int(v) for v in np.unravel_index(int(best.argmax()), best.shape))
            if best[y, x] < least or alone == SHADOW.candidates:
                return
            a, b = sizes[int(which[y, x])]
            if self.stands_alone((float(x), float(y), a, b)):
                least, alone, cleared = max(least, 0.4 * float(best[y, x])), alone + 1, 1.2
                yield float(x), float(y), a, b
            else:
                cleared = 0.6
            best[((xs - x) / (cleared * a)) ** 2 + ((ys - y) / (cleared * b)) ** 2 <= 1] = 0

    def stands_alone(self, seen: Ellipse) -> bool:
        """Whether the floor is lighter than the ellipse on each of its four sides, unlike next to an edge of light."""
        x, y, a, b = seen
        rows = slice(max(0, int(y - SHADOW.ring[1] * b)), int(y + SHADOW.ring[1] * b) + 2)
        columns = slice(max(0, int(x - SHADOW.ring[1] * a)), int(x + SHADOW.ring[1] * a) + 2)
        light, free = self.lab[rows, columns, 0], self.free[rows, columns]
        v, u = np.mgrid[: light.shape[0], : light.shape[1]].astype(np.float64)
        u, v = (u + columns.start - x) / a, (v + rows.start - y) / b
        radius, angle = np.hypot(u, v), np.arctan2(v, u)
        middle = float(light[free & (radius < 0.8)].mean())
        ring = free & (radius > SHADOW.ring[0]) & (radius < SHADOW.ring[1])
        sides = [ring & (np.abs((angle - turn + np.pi) % (2 * np.pi) - np.pi) < np.pi / 4) for turn in QUARTERS]
        steps = [float(light[side].mean()) - middle for side in sides if side.any()]
        return min(steps) > SHADOW.evenness * float(np.mean(steps))

    def contrast(self, a: float, b: float) -> Floats32:
        """Per pixel [h, w] how much darker an ellipse there is than the ring about it, as a share; 0 near objects."""
        ry, rx = int(np.ceil(SHADOW.ring[1] * b)), int(np.ceil(SHADOW.ring[1] * a))
        ys, xs = np.mgrid[-ry : ry + 1, -rx : rx + 1]
        radius = np.sqrt((xs / a) ** 2 + (ys / b) ** 2)
        layers = self.lab[..., 0] * self.free, self.free.astype(np.float32)
        means, shares = list[Floats32](), list[Floats32]()
        for mask in (radius <= 0.9, (radius >= SHADOW.ring[0]) & (radius <= SHADOW.ring[1])):
            kernel = mask.astype(np.float32) / np.float32(max(1, np.count_nonzero(mask)))
            total, share = (cv2.filter2D(layer, -1, kernel, borderType=cv2.BORDER_CONSTANT) for layer in layers)
            means.append(np.asarray(total / np.maximum(share, 1e-3), np.float32))
            shares.append(np.asarray(share, np.float32))
        is_floor = (shares[0] > 0.97) & (shares[1] > 0.7)
        return np.where(is_floor, 1 - means[0] / np.maximum(means[1], 1.0), 0).astype(np.float32)

    def fit_ellipse(self, seen: Ellipse) -> Shadow | None:
        """A soft tilted ellipse on a smooth floor, fitted to the lightness around what was seen."""
        x, y, a, b = seen
        rows = slice(max(0, round(y - 2.2 * b - 2)), round(y + 2.2 * b + 3))
        columns = slice(max(0, round(x - 1.8 * a)), round(x + 1.8 * a + 1))
        free = self.free[rows, columns]
        if free.sum() < SHADOW.least_pixels:
            return None
        every = max(1, int(free.sum()) // SHADOW.most_pixels)
        ys, xs = (axis[::every] for axis in np.nonzero(free))
        points = np.stack([xs + columns.start + 0.5, ys + rows.start + 0.5], axis=1).astype(np.float64)
        lab = self.lab[rows, columns][free][::every].astype(np.float64)
        u, v = (points[:, 0] - x) / a, (points[:, 1] - y) / a
        smooth = quadratic_terms(u, v)
        start = np.array([x + 0.5, y + 0.5, np.log(a), np.log(b), 0.0, np.log(0.15)])
        parameters, dark = _least_squares(points, lab[:, 0], smooth, start)
        inside = _soft_ellipse(points, parameters)
        plain = lab - smooth @ np.linalg.lstsq(smooth, lab, rcond=None)[0]
        terms = np.column_stack([smooth, inside])
        weights = np.linalg.lstsq(terms, lab, rcond=None)[0]
        left_over = lab[:, 0] - terms @ weights[:, 0]
        core = inside > 0.5
        if not core.any():
            return None
        level, *hue = np.median((smooth @ weights[:-1])[core], axis=0)
        # What takes a share of the light away takes the same share of a* and b* as of L* + 16.
        tint = weights[-1, 1:] - np.array(hue) * weights[-1, 0] / (float(level) + 16)
        explained = 1 - float((left_over**2).sum()) / max(1e-9, float((plain[:, 0] ** 2).sum()))
        px, py, log_a, log_b, tilt, log_soft = (float(p) for p in parameters)
        wide, high, soft = float(np.exp(log_a)), float(np.exp(log_b)), float(np.exp(log_soft))
        shade = -dark / max(float(level), 1.0)
        width = self.box[2] - self.box[0]
        least_soft, most_soft = SHADOW.softness
        if shade > SHADOW.dark and explained > SHADOW.well_explained:
            most_soft = SHADOW.most_soft
        fits = (
            SHADOW.least_shade < shade < SHADOW.most_shade
            and explained > SHADOW.explained
            and least_soft < soft < most_soft
            and float(np.hypot(*tint)) < SHADOW.same_hue
            and 0.6 * width < 2 * wide < 1.6 * width
            and 0.15 < high / wide < 0.95
            and float(np.hypot((px - x) / a, (py - y) / b)) < 0.6
            and abs(tilt) < 0.7
        )
        if not fits:
            return None
        (xx, yy, xy), (fx, fy) = (wide**2 / 4, high**2 / 4 * (1 + tilt**2), tilt * wide * high / 4), self.stretch
        half = 2 * float(np.sqrt(yy))
        bbox = ((px - wide) * fx, (py - half + self.top) * fy, (px + wide) * fx, (py + half + self.top) * fy)
        return Shadow(bbox, (px * fx, (py + self.top) * fy), (xx * fx * fx, yy * fy * fy, xy * fx * fy), shade)


def find_shadow(image: Image, things: Sequence[CroppedMask], bbox: BBox) -> Shadow | None:
    """The shadow of the ball in a box on what the things of an image leave free; None if it has none or several
    patches could be it."""
    if bbox[2] - bbox[0] < SHADOW.least_width:
        return None
    floor = _Floor.below(bbox, image, things)
    found = [shadow for ellipse in floor.candidates() if (shadow := floor.fit_ellipse(ellipse)) is not None]
    found.sort(key=lambda shadow: -shadow.shade)
    if not found or (len(found) > 1 and found[1].shade > SHADOW.rival_shade * found[0].shade):
        return None
    return found[0]


def _soft_ellipse(points: Floats, parameters: Floats) -> Floats:
    """1 inside, 0 outside; parameters: centre, log half width and height, shear of the rows, log width of the edge."""
    x, y, log_a, log_b, tilt, log_soft = parameters
    u = (points[:, 0] - x) / np.exp(log_a)
    v = (points[:, 1] - y) / np.exp(log_b) - tilt * u
    edge = (1 - np.sqrt(u * u + v * v + 1e-9)) / np.exp(log_soft)
    return 1 / (1 + np.exp(-2 * np.clip(edge, -20, 20)))


def _least_squares(points: Floats, light: Floats, smooth: Floats, start: Floats) -> tuple[Floats, float]:
    """Damped Gauss-Newton over the ellipse; floor and darkness follow from it linearly."""
    basis = np.linalg.qr(smooth)[0]
    plain = light - basis @ (basis.T @ light)

    def residual(parameters: Floats) -> tuple[Floats, float]:
        ellipse = _soft_ellipse(points, parameters)
        ellipse -= basis @ (basis.T @ ellipse)
        dark = float(ellipse @ plain) / (float(ellipse @ ellipse) + 1e-6)
        return plain - dark * ellipse, dark

    parameters, damping = start, 1e-2
    rest, dark = residual(parameters)
    step = np.array([0.1, 0.1, 0.02, 0.02, 0.02, 0.05])
    for _ in range(SHADOW.iterations):
        slopes = np.stack(
            [(residual(parameters + each)[0] - rest) / size for each, size in zip(np.diag(step), step, strict=True)],
            axis=1,
        )
        normal = slopes.T @ slopes
        move = -np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-9), slopes.T @ rest)
        tried = parameters + np.clip(move, -5 * step, 5 * step)
        new_rest, new_dark = residual(tried)
        if new_rest @ new_rest < rest @ rest:
            done = rest @ rest - new_rest @ new_rest < 1e-4 * (rest @ rest)
            parameters, rest, dark, damping = tried, new_rest, new_dark, damping / 3
            if done:
                break
        else:
            damping *= 5
    return parameters, dark
