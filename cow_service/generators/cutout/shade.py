"""Measures the shadow that an object casts on the floor next to it: where the floor is darker than further away.

A shadow is, per pixel and colour, the share of light that it takes away: dividing by what is left of the light takes it
out of the image, and multiplying by that puts it back, with the floor's texture kept both times. In a shadow the floor
keeps its hue, but for the light that a coloured object throws on it; what differs more is no shadow.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from cow_service.generators.cutout.bodies import Window, warping
from cow_service.media.masks import dilated, window_of
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.perception.classical.inpainting import push_pull, quadratic_terms
from cow_service.records import BBox

WORKING_SIDE = 40.0  # px: the surroundings are measured at the size at which the object's longer side is so long
SIDEWAYS, DOWN, UP = 1.0, 0.7, 0.2  # of the object's longer side: how far around its box a shadow is looked for
TEXTURE = 3  # px at the working size, of a median filter: finer than this is the floor's texture, edges stay
ROUNDS = 3  # of the floor's fit, each without what lay far from the one before
FAR = 2.0  # deviations of the floor's texture
FIRST = 0.03  # of the lightness: the least deviation that the fit begins with
UNEVEN = 0.07  # of the floor's lightness, in deviations: on a floor as varied as this no shadow can be told
LEAST_SHADE, MOST_SHADE = 0.035, 0.85  # share of the light that is taken away
NO_SHADE = 0.008  # an invisible share of the light
MOST_GIVEN = 0.1  # share of light that a coloured object may add in its own colour
SAME_HUE = 0.3  # by which the shares that are left of red, green and blue may differ
TOUCH = 3.0  # px at the working size: a shadow begins so near to its object
LEAST_FLOOR, LEAST_TOUCHING = 60, 4  # px at the working size
NEAR, REACH = (0.65, 0.95), (0.25, 0.6)  # of the longer side: a contact and a cast shadow fade out between these
OPEN_END = 0.25  # of a dark patch's size, on the border of what is looked at: with more it may be a darker floor
ALIKE = 0.6  # of the darkness beside the object: it is, if it is as dark as this on the border
CONTACT = 5  # px at the working size: so far under the object its shadow is as dark as at its rim

IDENTITY, ORIGIN = np.eye(2), np.zeros(2)


@dataclass(frozen=True)
class Shade:
    """The share of light that is taken away, up to 1 [h, w, 3], on cells of `step` px from `origin` (x, y, px) on."""

    dark: Floats32
    floor: Floats32  # [h, w, 3]: the floor's colours in the light, without texture
    texture: float  # deviation of the texture, as a share of the lightness
    origin: tuple[float, float]
    step: float

    def darkness(
        self, window: Window, matrix: Floats = IDENTITY, to: Floats = ORIGIN, start: Floats = ORIGIN
    ) -> Floats32:
        """The share of light taken away in a window [a, b, 3], when `start` has gone `to` (px), turned by a matrix."""
        transform = warping(self.step, self.origin, matrix, start, to, window)
        return np.asarray(cv2.warpAffine(self.dark, *transform, flags=cv2.INTER_LINEAR), np.float32)

    def lit_floor(self, window: Window) -> Floats32:
        """The floor's colours [a, b, 3] in the light, in a window of the image."""
        transform = warping(self.step, self.origin, IDENTITY, ORIGIN, ORIGIN, window)
        found = cv2.warpAffine(self.floor, *transform, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, np.float32)

    def corners(self, matrix: Floats = IDENTITY, to: Floats = ORIGIN, start: Floats = ORIGIN) -> tuple[Floats, Floats]:
        """The corners (px), least and greatest, between which `darkness` takes light away."""
        height, width = self.dark.shape[:2]
        corners = np.array([[0, 0], [width, 0], [0, height], [width, height]]) * self.step + self.origin - start
        there = to + corners @ matrix.T
        return there.min(axis=0), there.max(axis=0)


def contact_shade(image: Image, body: Mask, box: BBox, floor: Mask) -> Shade | None:
    """The shadow on the floor beneath and next to a standing object [h, w]; None if it has none.

    `floor` [h, w] is where there may be floor: no pixel of any object. Beneath the object it is continued from beside.
    """
    side = max(box[2] - box[0], box[3] - box[1])
    x0, y0, x1, y1 = box
    around = x0 - SIDEWAYS * side, y0 + UP * (y1 - y0), x1 + SIDEWAYS * side, y1 + DOWN * side
    return _measured(image, body, floor, around, side, NEAR, reject_open=True)


def cast_shade(image: Image, ellipse: Mask, box: BBox, floor: Mask) -> Shade | None:
    """The shadow at an ellipse [h, w] on the floor, whose box is given (px); None if the floor is not darker."""
    width, height = box[2] - box[0], box[3] - box[1]
    around = box[0] - 0.6 * width, box[1] - 0.8 * height, box[2] + 0.6 * width, box[3] + 0.8 * height
    return _measured(image, ellipse, floor | ellipse, around, max(width, height), REACH, reject_open=False)


def _measured(
    image: Image, seed: Mask, floor: Mask, around: BBox, side: float, fade: tuple[float, float], *, reject_open: bool
) -> Shade | None:
    """The dark patches of the floor that touch the seed [h, w], within a box (px), at a smaller size."""
    height, width = floor.shape
    x0, y0 = max(0, int(around[0])), max(0, int(around[1]))
    x1, y1 = min(width, int(np.ceil(around[2]))), min(height, int(np.ceil(around[3])))
    scale = min(1.0, WORKING_SIDE / side)
    size = int((x1 - x0) * scale), int((y1 - y0) * scale)
    if min(size) < 4:
        return None
    step = 1 / scale
    window = slice(y0, y0 + round(size[1] * step)), slice(x0, x0 + round(size[0] * step))
    parts = seed[window], floor[window], image[window].astype(np.float32) * floor[window][..., None]
    seeded, weight, colours = (
        np.asarray(cv2.resize(part.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
        for part in parts
    )
    known = weight > 0.6
    colours = colours / np.maximum(weight, np.float32(1e-3))[..., None]
    # Without texture; what is not known takes part with the colours next to it.
    shares = np.maximum(cv2.boxFilter(known.astype(np.float32), -1, (7, 7)), 1e-3)
    near = cv2.boxFilter(colours * known[..., None], -1, (7, 7)) / shares[..., None]
    levels = np.clip(np.where(known[..., None], colours, near) + 0.5, 0, 255).astype(np.uint8)
    smooth = np.asarray(cv2.GaussianBlur(cv2.medianBlur(levels, TEXTURE).astype(np.float32), (0, 0), 0.7), np.float32)
    away = _distance_from(seeded > 0.3)
    fitted = _floor_in_light(smooth, known, known & (away > 0.1 * side * scale) & (away < 0.5 * side * scale))
    if fitted is None:
        return None
    lit, texture = fitted
    left = smooth / lit
    # What lies nearer to another object is that one's shadow.
    other = _distance_from((weight < 0.4) & (away > TOUCH))
    own = np.clip((other - away) / TOUCH + 0.5, 0, 1)
    dark = _shadow(left, texture, known, away, own.astype(np.float32), reject_open=reject_open)
    if dark is None:
        return None
    first, last = (share * side * scale for share in fade)
    dark = (dark * np.clip((last - away) / (last - first), 0, 1)[..., None]).astype(np.float32)
    step = (window[1].stop - window[1].start) / size[0]
    seen = window_of(strongest(dark) > NO_SHADE, 1)
    if seen is None:
        return None
    origin = x0 + seen[1].start * step, y0 + seen[0].start * step
    return Shade(dark[seen], lit[seen], texture, origin, step)


def strongest(values: Floats32) -> Floats32:
    """The largest of the three colours' values [h, w, 3]."""
    red, green, blue = cv2.split(values)
    return np.asarray(cv2.max(cv2.max(red, green), blue), np.float32)


def _distance_from(seed: Mask) -> Floats32:
    """Pixels [h, w]."""
    return np.asarray(cv2.distanceTransform((~seed).astype(np.uint8), cv2.DIST_L2, 5), np.float32)


def _floor_in_light(smooth: Floats32, known: Mask, around: Mask) -> tuple[Floats32, float] | None:
    """A smooth floor [h, w, 3] without its dark parts.

    The floor is the surface that is seen `around` [h, w] the object. Beside it the deviation of its texture, as a
    share; None if there is too little floor, or a varied one.
    """
    ys, xs = np.nonzero(known)
    if len(ys) < LEAST_FLOOR or around.sum() < LEAST_FLOOR / 2:
        return None
    height, width = known.shape
    every = max(1, len(ys) // 1000)
    terms = quadratic_terms(2 * xs[::every] / width - 1, 2 * ys[::every] / height - 1)
    values = smooth[ys[::every], xs[::every]].astype(np.float64)
    grey = values.mean(axis=1)
    beside = smooth[around].mean(axis=1)
    level = float(np.percentile(beside, 60))
    gaps, deviation = grey - level, max(FIRST * level, 1.4826 * float(np.median(np.abs(beside - level))))
    weights = np.zeros((6, 3))
    for _ in range(ROUNDS):
        # What is darker is left out sooner: a shadow is no floor in the light.
        near = (gaps > -0.7 * FAR * deviation) & (gaps < FAR * deviation)
        if near.sum() < LEAST_FLOOR / 2:
            return None
        weights = np.linalg.lstsq(terms[near], values[near], rcond=None)[0]
        gaps = grey - (terms @ weights).mean(axis=1)
        # Of this surface only: others in the window say nothing of its texture.
        deviation = 0.5 + 1.4826 * float(np.median(np.abs(gaps[np.abs(gaps) < 2 * FAR * deviation])))
    v, u = np.mgrid[:height, :width]
    surface = quadratic_terms((2 * u / width - 1).ravel(), (2 * v / height - 1).ravel()) @ weights
    floor = surface.reshape(height, width, 3)
    level = float(np.median(floor))
    if level < 8 or deviation / level > UNEVEN:
        return None
    return np.maximum(floor, 0.3 * level).astype(np.float32), deviation / level


def _shadow(
    left: Floats32, texture: float, known: Mask, away: Floats32, own: Floats32, *, reject_open: bool
) -> Floats32 | None:
    """The share of light taken away [h, w, 3] by the dark patches that touch the object; None without one."""
    grey = left @ np.full(3, 1 / 3, np.float32)
    spread = strongest(left) + strongest(-left)
    same_hue = (spread < SAME_HUE) & (grey > 1 - MOST_SHADE)
    least = max(LEAST_SHADE, 1.5 * texture)
    dark = np.where(known & same_hue, np.clip(1 - grey, 0, None) * own, away == 0).astype(np.float32)
    touching = np.where(away < TOUCH, dark, 0).astype(np.float32)
    beside = touching[known & (touching > least)]
    if len(beside) < LEAST_TOUCHING:
        return None
    # Per pixel the least darkness on the darkest way to it from the object, for behind a lit gap lies no shadow: the
    # morphological reconstruction of `dark` by dilation, as far as so many steps reach.
    reached = touching
    for _ in range(max(1, round(float(away[dark > least].max())))):
        reached = np.minimum(np.asarray(cv2.dilate(reached, np.ones((3, 3), np.uint8)), np.float32), dark)
    patch = known & (reached > least)
    border = np.ones_like(patch)
    border[1:-1, 1:-1] = False
    ends = reached[patch & border]
    is_open = len(ends) > OPEN_END * np.sqrt(patch.sum()) + 2
    if reject_open and is_open and np.median(ends) > ALIKE * np.median(beside):
        return None
    share = np.clip(2 * reached / least - 1, 0, 1) * np.minimum(1, reached / np.maximum(dark, 1e-3)) * own
    share = np.asarray(cv2.GaussianBlur(np.where(known, share, own), (0, 0), 1.0), np.float32) * ~border
    lost = np.clip(1 - left, -MOST_GIVEN, MOST_SHADE).astype(np.float32) * share[..., None]
    # Where nothing is known, under the object, the shadow goes on from its rim, where it is darkest.
    rim = ~known & dilated(known, CONTACT)
    seen = np.where(known[..., None], lost, np.float32(0))
    darkest = np.asarray(cv2.dilate(seen, np.ones((CONTACT, CONTACT), np.uint8)), np.float32)
    seen = np.where(rim[..., None], darkest, seen)
    under = push_pull(np.asarray(seen, np.float32), known | rim) * (own * ~border)[..., None]
    return np.where(known[..., None], lost, under).astype(np.float32)
