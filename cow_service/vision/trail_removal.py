"""Takes the earlier positions of a trail out of an image, and completes the present one where they hid it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from cow_service.vision.inpainting import fill_hole
from cow_service.vision.masks import lab_of, scaled, window_of
from cow_service.vision.trails import FADED, Position, Trail
from cow_service.vision.types import Floats, Floats32, Image, Mask

RIM, LEAST_RIM = 0.06, 2.0  # of the radius, px: around a position, mixed with the background
APART = 0.03  # of the radius by which a place must lie outside all earlier positions to be surely the present one's


def without_earlier_positions(image: Image, trail: Trail, kept: Mask | None = None) -> Image:
    """The image [H, W, 3] with the present position of a trail alone. `kept` are other objects that stay."""
    shape = image.shape[0], image.shape[1]
    earlier = np.zeros(shape, bool)
    for position in trail.older:
        earlier |= position.disc(shape, max(LEAST_RIM, RIM * position.radius))
    if kept is not None:
        earlier &= ~kept
    present = trail.present
    reached = present.disc(shape, max(LEAST_RIM, RIM * present.radius))
    hole = earlier | reached if (earlier & reached).any() else earlier
    filled = fill_hole(image, hole, kept)
    window = window_of(earlier & reached)
    result = image.copy()
    result[earlier] = filled[earlier]
    if window is not None:
        share, colours = _completed(image, trail, window)
        over = (earlier & reached)[window]
        mixed = share[..., None] * colours + (1 - share[..., None]) * filled[window]
        result[window] = np.where(over[..., None], np.round(mixed), result[window]).astype(np.uint8)
    return result


def _completed(image: Image, trail: Trail, window: tuple[slice, slice]) -> tuple[Floats32, Floats32]:
    """How much of each pixel [h, w] of a window the present position takes, and its colours [h, w, 3].

    What an earlier position may hide of it is copied from the earlier one of which the same part is seen best: they
    are the same ball. A faded position hides nothing, and nothing is copied from it.
    """
    rows, columns = window
    ys, xs = np.mgrid[rows, columns].astype(np.float32) + np.float32(0.5)
    present = trail.present
    u, v = (xs - present.x) / present.radius, (ys - present.y) / present.radius
    away = np.hypot(u, v)
    share = np.clip((1 - away) * present.radius + 0.5, 0, 1)
    solid = [position for position in trail.older if position.opacity > FADED]
    # On the very rim a pixel shows the background as well: taken from just inside.
    inward = np.minimum(1, (1 - 1.2 / present.radius) / np.maximum(away, 1e-6))
    u, v = u * inward, v * inward
    best = _freedom(present, (*solid,), u, v)
    colours = _sampled(image, present, u, v)
    own = best > APART
    for donor in solid:
        others = (present, *(position for position in solid if position is not donor))
        margin = _freedom(donor, others, u, v)
        better = ~own & (margin > best)
        colours = np.where(better[..., None], _sampled(image, donor, u, v), colours)
        best = np.where(better, margin, best)
    return share.astype(np.float32), colours


def _freedom(of: Position, others: tuple[Position, ...], u: Floats32, v: Floats32) -> Floats32:
    """By how many radii places at offsets (radii) from a position lie outside all others; negative inside one."""
    x, y = of.x + of.radius * u, of.y + of.radius * v
    nearest = np.full(u.shape, 9.0, np.float32)
    for other in others:
        nearest = np.minimum(nearest, np.hypot(x - other.x, y - other.y) / other.radius)
    return (nearest - 1).astype(np.float32)


def _sampled(image: Image, of: Position, u: Floats32, v: Floats32) -> Floats32:
    """Colours [h, w, 3] at offsets (radii) from a position."""
    columns = np.clip((of.x + of.radius * u).astype(int), 0, image.shape[1] - 1)
    rows = np.clip((of.y + of.radius * v).astype(int), 0, image.shape[0] - 1)
    return image[rows, columns].astype(np.float32)


WORKING_WIDTH = 16.0  # px: the image is searched at the size at which the ball is so wide
LEAST_WIDTH = 16.0  # px of the ball in the image
WIDTHS = (0.7, 0.85, 1.0, 1.15, 1.3)  # of the ball's
FLATNESS = (0.28, 0.38, 0.5)  # of their own width: their heights
DRIFTS = (-1.2, -0.8, -0.4, 0.0, 0.4, 0.8, 1.2)  # down the image from the first shadow to the last, in the ball's width
RING = 1.45  # of the ellipses: the floor about them that they are compared with
SLANT = 1.1  # px sideways per px down: light indoors falls steeper
NEAREST = 0.25  # of the ball's width below it: nearer, the shadow touches it
LEAST_SHADE, MOST_SHADE = 0.025, 0.6  # of the floor's lightness that shadows take away; more is an object
SAME_HUE = 7.0  # Lab units in the a*b* plane, by which a shade may differ from the floor about it
STANDS_OUT = 0.55  # of the shade inside: by so much it must exceed that about it
EACH = 0.6  # of the mean shade: what each shadow must have at least
FIT_REACH = 1.7  # of the ellipses first found: so far around them the row is fitted
GROWN, OWN = 1.25, 1.05  # of an ellipse: what is filled in, and what stays as the shadow of the present position


@dataclass(frozen=True)
class _Row:
    """Shadows as ellipses of the image, the present position's last."""

    centres: tuple[tuple[float, float], ...]  # px
    half: tuple[float, float]  # px

    def mask(self, shape: tuple[int, int], which: slice, factor: float) -> Mask:
        """Mask [H, W] of some of them, their axes multiplied."""
        ys, xs = np.ogrid[: shape[0], : shape[1]]
        mask = np.zeros(shape, bool)
        for x, y in self.centres[which]:
            mask |= ((xs + 0.5 - x) / self.half[0]) ** 2 + ((ys + 0.5 - y) / self.half[1]) ** 2 <= factor**2
        return mask


def without_earlier_shadows(image: Image, trail: Trail, objects: Mask) -> Image:
    """The image [H, W, 3], its earlier positions taken out, with the shadow of the present position alone.

    `objects` [H, W] hide the floor, and stay. The image as it is where no shadows of a trail can be told.
    """
    if 2 * trail.present.radius < LEAST_WIDTH:
        return image
    found = _Floor.of(image, trail, objects, WORKING_WIDTH).darkest()
    if found is None:
        return image
    row = _Floor.of(image, trail, objects, 2 * WORKING_WIDTH).fitted(found)
    shape = image.shape[0], image.shape[1]
    rim = cv2.dilate(objects.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    hole = row.mask(shape, slice(0, -1), GROWN) & ~row.mask(shape, slice(-1, None), OWN) & ~rim
    return fill_hole(image, hole, (row.mask(shape, slice(-1, None), GROWN) | rim) & ~hole)


@dataclass(frozen=True, eq=False)
class _Floor:
    """The floor at a working size, and where the ball is: a row of shadows is a place (share of the image's size), a
    width and a drift (in the ball's width) and a flatness."""

    shade: Floats32  # [h, w]: the share of the light that is taken away
    weight: Floats32  # [h, w]: 1 where it may be floor
    places: Floats  # [N, 2] px
    width: float  # px, of the ball
    stretch: tuple[float, float]  # back to the image's size

    @staticmethod
    def of(image: Image, trail: Trail, objects: Mask, working_width: float) -> _Floor:
        """The floor where the ball is as wide as a working width (px), or as it is if that is less."""
        width = 2 * trail.present.radius
        small = scaled(image, min(1.0, working_width / width))
        fx, fy = small.shape[1] / image.shape[1], small.shape[0] / image.shape[0]
        shade, weight = _shade(small, width * fx)
        taken = cv2.resize(objects.astype(np.float32), (small.shape[1], small.shape[0]), interpolation=cv2.INTER_AREA)
        weight = weight * np.asarray(taken < 0.05, np.float32)
        places = np.array([(p.x * fx - 0.5, p.y * fy - 0.5) for p in trail.positions])
        return _Floor(shade, weight, places, width * fx, (1 / fx, 1 / fy))

    def ellipses(self, parameters: Floats) -> tuple[Floats, tuple[float, float]]:
        """Centres [N, 2] and half axes (px) at this size, of a row: x, y, width, flatness, drift."""
        x, y, wide, flat, drift = (float(p) for p in parameters)
        times = np.linspace(-1, 0, len(self.places))
        offsets = [wide * (self.places[:, 0] - self.places[-1, 0]), times * drift * self.width]
        at = np.array([x * self.shade.shape[1], y * self.shade.shape[0]])
        return at + np.stack(offsets, axis=1), (wide * self.width / 2, flat * wide * self.width / 2)

    def darkest(self) -> Floats | None:
        """The row that is darkest against the floor about it; None where none is."""
        (x, y), (ys, xs) = self.places[-1].tolist(), np.mgrid[: self.shade.shape[0], : self.shade.shape[1]]
        # Where the middle of the present position's shadow may lie.
        allowed = (ys > y + (0.5 + NEAREST) * self.width) & (np.abs(xs - x) < SLANT * (ys - y) + 0.5 * self.width)
        best: tuple[float, Floats] | None = None
        for wide, flat, drift in product(WIDTHS, FLATNESS, DRIFTS):
            centres, half = self.ellipses(np.array([0.0, 0.0, wide, flat, drift]))
            found = _darkest(self.shade, self.weight, allowed, centres, half)
            if found is not None and (best is None or found[0] > best[0]):
                x, y = found[1]
                at = x / self.shade.shape[1], y / self.shade.shape[0]
                best = found[0], np.array([*at, wide, flat, drift])
        return None if best is None else best[1]

    def fitted(self, start: Floats) -> _Row:
        """The row whose even shade leaves least of the shade around it unexplained, by a pattern search."""
        centres, half = self.ellipses(start)
        height, width = self.shade.shape
        ys, xs = np.mgrid[:height, :width]
        across, down = (xs[..., None] - centres[:, 0]) / half[0], (ys[..., None] - centres[:, 1]) / half[1]
        near = np.hypot(across, down).min(axis=2)
        kept = (near < FIT_REACH) & (self.weight > 0)
        points, shade = np.stack([xs[kept], ys[kept]], axis=1), self.shade[kept].astype(np.float64)

        def unexplained(parameters: Floats) -> float:
            middle, (a, b) = self.ellipses(parameters)
            away = np.hypot((points[:, :1] - middle[:, 0]) / a, (points[:, 1:] - middle[:, 1]) / b).min(axis=1)
            inside = np.clip((1 - away) * b + 0.5, 0, 1)
            terms = np.stack([np.ones_like(inside), inside], axis=1)
            rest = shade - terms @ np.linalg.solve(terms.T @ terms + 1e-6 * np.eye(2), terms.T @ shade)
            return float(rest @ rest)

        best, least = start, unexplained(start)
        steps = np.array([0.25 * self.width / width, 0.12 * self.width / height, 0.1, 0.06, 0.25])
        while steps[2] > 0.004:
            before = least
            for i, side in product(range(5), (-1.0, 1.0)):
                tried = best + side * steps * (np.arange(5) == i)
                if 0.5 < tried[2] < 1.8 and 0.15 < tried[3] < 0.9 and (value := unexplained(tried)) < least:
                    best, least = tried, value
            if least >= before:
                steps = steps / 2
        (centres, half), (fx, fy) = self.ellipses(best), self.stretch
        return _Row(tuple(((x + 0.5) * fx, (y + 0.5) * fy) for x, y in centres.tolist()), (half[0] * fx, half[1] * fy))


def _shade(small: Image, width: float) -> tuple[Floats32, Floats32]:
    """By what share each pixel [h, w] is darker than the floor about it, and 1 where it may be floor, else 0."""
    lab = lab_of(small)
    side = int(1.3 * width) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    light = cv2.GaussianBlur(lab[..., 0], (0, 0), 0.7)
    floor = np.asarray(cv2.morphologyEx(light, cv2.MORPH_CLOSE, kernel), np.float32)
    floor = cv2.blur(floor, (3, 3))
    shade = np.clip(1 - light / np.maximum(floor, 1.0), 0, 1)
    hue = [cv2.medianBlur(np.clip(lab[..., i] + 128, 0, 255).astype(np.uint8), side).astype(np.float32) - 128
           for i in (1, 2)]  # fmt: skip
    dimmed = (light + 16) / (floor + 16)
    off = np.hypot(lab[..., 1] - hue[0] * dimmed, lab[..., 2] - hue[1] * dimmed)
    plain = (off < SAME_HUE) & (shade < MOST_SHADE)
    return shade.astype(np.float32), plain.astype(np.float32)


def _darkest(
    shade: Floats32, weight: Floats32, allowed: Mask, offsets: Floats, half: tuple[float, float]
) -> tuple[float, tuple[int, int]] | None:
    """How much darker the darkest row of ellipses is than the floor about it, and where its last one lies."""
    reach_x = int(np.ceil(np.abs(offsets[:, 0]).max() + RING * half[0])) + 1
    reach_y = int(np.ceil(np.abs(offsets[:, 1]).max() + RING * half[1])) + 1
    ys, xs = np.mgrid[-reach_y : reach_y + 1, -reach_x : reach_x + 1]
    away = np.stack([np.hypot((xs - dx) / half[0], (ys - dy) / half[1]) for dx, dy in offsets])
    nearest = away.min(axis=0)
    inside, about = nearest <= 0.95, (nearest >= 1.12) & (nearest <= RING)
    (dark, whole), (rim, free) = (_means(shade, weight, mask) for mask in (inside, about))
    score = np.where(allowed & (whole > 0.6) & (free > 0.5) & (dark > LEAST_SHADE), dark - rim, 0)
    y, x = (int(v) for v in np.unravel_index(int(score.argmax()), score.shape))
    if score[y, x] <= STANDS_OUT * dark[y, x] or score[y, x] <= 0:
        return None
    for one in away:
        each, seen = _at(shade, weight, one <= 0.9, x, y)
        if seen > 0.3 and each < EACH * dark[y, x]:
            return None
    # A larger row of the same shade is the better one: part of a shadow is as dark as the whole.
    return float(score[y, x]) * float(np.sqrt(np.count_nonzero(inside))), (x, y)


def _means(shade: Floats32, weight: Floats32, mask: Mask) -> tuple[Floats32, Floats32]:
    """Mean shade [h, w] of what may be floor in a mask about each pixel, and the share of it that may be."""
    kernel = mask.astype(np.float32) / np.float32(max(1, np.count_nonzero(mask)))
    total, share = (cv2.filter2D(values, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT)
                    for values in (shade * weight, weight))  # fmt: skip
    return np.asarray(total / np.maximum(share, 1e-3), np.float32), np.asarray(share, np.float32)


def _at(shade: Floats32, weight: Floats32, mask: Mask, x: int, y: int) -> tuple[float, float]:
    """As `_means`, about one pixel."""
    ys, xs = np.nonzero(mask)
    ys, xs = ys + y - mask.shape[0] // 2, xs + x - mask.shape[1] // 2
    inside = (ys >= 0) & (xs >= 0) & (ys < shade.shape[0]) & (xs < shade.shape[1])
    kept = weight[ys[inside], xs[inside]]
    mean = float((shade[ys[inside], xs[inside]] * kept).sum() / max(float(kept.sum()), 1e-3))
    return mean, float(kept.sum()) / max(1, len(ys))
