"""Takes the earlier positions of a trail out of an image, and completes the present one where they hid it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np

from cow_service.vision.inpainting import fill_hole
from cow_service.vision.masks import dilated, lab_of, scaled, window_of
from cow_service.vision.trails import TRAIL, Position, Trail, sampled
from cow_service.vision.types import Floats, Floats32, Image, Mask


class ShadowRowRules(NamedTuple):
    """Which row of dark ellipses are the shadows of a trail.

    Set by hand on trails of the first family of rendered scenes and on drawn ones; no single number has a measurement
    of its own.
    """

    rim: float = 0.06  # of the radius: around a position, mixed with the background
    least_rim: float = 2.0  # px: the same, at least
    # of the radius by which a place must lie outside all earlier positions to be surely the present one's
    apart: float = 0.03
    working_width: float = 16.0  # px: the image is searched at the size at which the ball is so wide
    least_width: float = 16.0  # px of the ball in the image
    widths: tuple[float, float, float, float, float] = (0.7, 0.85, 1.0, 1.15, 1.3)  # of the ball's
    flatness: tuple[float, float, float] = (0.28, 0.38, 0.5)  # of their own width: their heights
    # down the image from the first shadow to the last, in the ball's width
    drifts: tuple[float, float, float, float, float, float, float] = (-1.2, -0.8, -0.4, 0.0, 0.4, 0.8, 1.2)
    ring: float = 1.45  # of the ellipses: the floor about them that they are compared with
    slant: float = 1.1  # px sideways per px down: light indoors falls steeper
    # of the ball's width, from its foot down to the shadow's middle: nearer, the ball may touch the floor
    nearest: float = 0.25
    least_shade: float = 0.025  # of the floor's lightness that shadows take away, at least
    most_shade: float = 0.6  # the same: more is an object
    same_hue: float = 7.0  # Lab units in the a*b* plane, by which a shade may differ from the floor about it
    stands_out: float = 0.55  # of the shade inside: by so much it must exceed that about it
    each: float = 0.6  # of the mean shade: what each shadow must have at least
    fit_reach: float = 1.7  # of the ellipses first found: so far around them the row is fitted
    grown: float = 1.25  # of an ellipse: what is filled in
    own: float = 1.05  # of that of the present position: what stays


ROW = ShadowRowRules()


def without_earlier_positions(image: Image, trail: Trail) -> Image:
    """The image [H, W, 3] with the present position of a trail alone."""
    shape, present = (image.shape[0], image.shape[1]), trail.present
    earlier = np.any([each.disc(shape, max(ROW.least_rim, ROW.rim * each.radius)) for each in trail.older], axis=0)
    reached = present.disc(shape, max(ROW.least_rim, ROW.rim * present.radius))
    hidden = earlier & reached
    filled = fill_hole(image, earlier | reached if hidden.any() else earlier)
    result = image.copy()
    result[earlier] = filled[earlier]
    window = window_of(hidden)
    if window is not None:
        share, colours = _completed(image, trail, window)
        mixed = share * colours + (1 - share) * filled[window]
        result[window] = np.where(hidden[window][..., None], np.round(mixed), result[window]).astype(np.uint8)
    return result


def _completed(image: Image, trail: Trail, window: tuple[slice, slice]) -> tuple[Floats32, Floats32]:
    """How much of each pixel of a window the present position takes [h, w, 1], and its colours [h, w, 3].

    What an earlier position may hide of it is copied from the earlier one of which the same part is seen best: they
    are the same ball. A faded position hides nothing, and nothing is copied from it.
    """
    rows, columns = window
    ys, xs = np.mgrid[rows, columns].astype(np.float32) + np.float32(0.5)
    present = trail.present
    u, v = (xs - present.x) / present.radius, (ys - present.y) / present.radius
    away = np.hypot(u, v)
    share = np.clip((1 - away) * present.radius + 0.5, 0, 1).astype(np.float32)
    solid = [position for position in trail.older if position.opacity > TRAIL.faded]
    # On the very rim a pixel shows the background as well: taken from just inside.
    inward = np.minimum(1, (1 - 1.2 / present.radius) / np.maximum(away, 1e-6))
    u, v = u * inward, v * inward
    best, colours = _freedom(present, solid, u, v), sampled(image, present, u, v).astype(np.float32)
    own = best > ROW.apart
    for donor in solid:
        margin = _freedom(donor, [present, *(position for position in solid if position is not donor)], u, v)
        better = ~own & (margin > best)
        colours = np.where(better[..., None], sampled(image, donor, u, v), colours)
        best = np.where(better, margin, best)
    return share[..., None], colours


def _freedom(of: Position, others: Sequence[Position], u: Floats32, v: Floats32) -> Floats32:
    """By how many radii places at offsets (radii) from a position lie outside all others; negative inside one."""
    x, y = of.x + of.radius * u, of.y + of.radius * v
    away = [np.hypot(x - other.x, y - other.y) / other.radius for other in others]
    return np.min([np.full_like(x, 9.0), *away], axis=0) - np.float32(1)


Half = tuple[float, float]  # px: half axes of an ellipse


def without_earlier_shadows(image: Image, trail: Trail, objects: Mask) -> Image:
    """The image [H, W, 3], its earlier positions taken out, with the shadow of the present position alone.

    `objects` [H, W] hide the floor, and stay. The image as it is where no shadows of a trail can be told.
    """
    if 2 * trail.present.radius < ROW.least_width:
        return image
    found = _Floor.of(image, trail, objects, ROW.working_width).darkest()
    if found is None:
        return image
    centres, (a, b) = _Floor.of(image, trail, objects, 2 * ROW.working_width).fitted(found)
    ys, xs = np.ogrid[: image.shape[0], : image.shape[1]]
    away = [((xs + 0.5 - x) / a) ** 2 + ((ys + 0.5 - y) / b) ** 2 for x, y in centres.tolist()]
    earlier = np.any([each <= ROW.grown**2 for each in away[:-1]], axis=0)
    rim = dilated(objects, 5)
    hole = earlier & ~(away[-1] <= ROW.own**2) & ~rim
    return fill_hole(image, hole, ((away[-1] <= ROW.grown**2) | rim) & ~hole)


def floor_means(values: Floats32, weight: Floats32, mask: Mask) -> tuple[Floats32, Floats32]:
    """Mean value [h, w] of what may be floor in a mask about each pixel, and the share of the mask that may be.

    `weight` [h, w] is 1 where there may be floor, else 0.
    """
    kernel = mask.astype(np.float32) / np.float32(max(1, np.count_nonzero(mask)))
    total, share = (np.asarray(cv2.filter2D(layer, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT), np.float32)
                    for layer in (values * weight, weight))  # fmt: skip
    return np.asarray(total / np.maximum(share, 1e-3), np.float32), share


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
        lab, side = lab_of(small), int(1.3 * width * fx) | 1
        light = cv2.GaussianBlur(lab[..., 0], (0, 0), 0.7)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        floor = cv2.blur(np.asarray(cv2.morphologyEx(light, cv2.MORPH_CLOSE, kernel), np.float32), (3, 3))
        shade = np.clip(1 - light / np.maximum(floor, 1.0), 0, 1).astype(np.float32)
        hue = [cv2.medianBlur(np.clip(lab[..., i] + 128, 0, 255).astype(np.uint8), side).astype(np.float32) - 128
               for i in (1, 2)]  # fmt: skip
        dimmed = (light + 16) / (floor + 16)
        off = np.hypot(lab[..., 1] - hue[0] * dimmed, lab[..., 2] - hue[1] * dimmed)
        taken = cv2.resize(objects.astype(np.float32), (small.shape[1], small.shape[0]), interpolation=cv2.INTER_AREA)
        free = (off < ROW.same_hue) & (shade < ROW.most_shade) & (np.asarray(taken) < 0.05)
        places = np.array([(p.x * fx - 0.5, p.y * fy - 0.5) for p in trail.positions])
        return _Floor(shade, free.astype(np.float32), places, width * fx, (1 / fx, 1 / fy))

    def ellipses(self, parameters: Floats) -> tuple[Floats, Half]:
        """Centres [N, 2] and half axes (px) at this size, of a row: x, y, width, flatness, drift."""
        x, y, wide, flat, drift = (float(p) for p in parameters)
        times = np.linspace(-1, 0, len(self.places))
        offsets = [wide * (self.places[:, 0] - self.places[-1, 0]), times * drift * self.width]
        at = np.array([x * self.shade.shape[1], y * self.shade.shape[0]])
        return at + np.stack(offsets, axis=1), (wide * self.width / 2, flat * wide * self.width / 2)

    def darkest(self) -> Floats | None:
        """The row that is darkest against the floor about it; None if none is."""
        (height, width), (x, y) = self.shade.shape, self.places[-1].tolist()
        ys, xs = np.mgrid[:height, :width]
        # Where the middle of the present position's shadow may lie.
        allowed = (ys > y + (0.5 + ROW.nearest) * self.width) & (
            np.abs(xs - x) < ROW.slant * (ys - y) + 0.5 * self.width
        )
        best, most = None, 0.0
        for form in product(ROW.widths, ROW.flatness, ROW.drifts):
            score, x, y = self.darkest_of_form(allowed, *self.ellipses(np.array([0.0, 0.0, *form])))
            if score > most:
                best, most = np.array([x / width, y / height, *form]), score
        return best

    def darkest_of_form(self, allowed: Mask, offsets: Floats, half: Half) -> tuple[float, int, int]:
        """How much darker than the floor the darkest row of ellipses is, 0 for none, and where its last one lies."""
        reach_x = int(np.ceil(np.abs(offsets[:, 0]).max() + ROW.ring * half[0])) + 1
        reach_y = int(np.ceil(np.abs(offsets[:, 1]).max() + ROW.ring * half[1])) + 1
        ys, xs = np.mgrid[-reach_y : reach_y + 1, -reach_x : reach_x + 1]
        away = np.stack([np.hypot((xs - dx) / half[0], (ys - dy) / half[1]) for dx, dy in offsets])
        nearest = away.min(axis=0)
        inside = nearest <= 0.95
        rings = inside, (nearest >= 1.12) & (nearest <= ROW.ring)
        (dark, whole), (rim, free) = (floor_means(self.shade, self.weight, mask) for mask in rings)
        score = np.where(allowed & (whole > 0.6) & (free > 0.5) & (dark > ROW.least_shade), dark - rim, 0)
        y, x = (int(v) for v in np.unravel_index(int(score.argmax()), score.shape))
        if score[y, x] <= ROW.stands_out * dark[y, x] or score[y, x] <= 0:
            return 0.0, x, y
        for one in away <= 0.9:
            down, across = np.nonzero(one)
            down, across = down + y - reach_y, across + x - reach_x
            seen = (down >= 0) & (across >= 0) & (down < score.shape[0]) & (across < score.shape[1])
            kept = self.weight[down[seen], across[seen]]
            mean = float((self.shade[down[seen], across[seen]] * kept).sum() / max(float(kept.sum()), 1e-3))
            if float(kept.sum()) / max(1, len(down)) > 0.3 and mean < ROW.each * dark[y, x]:
                return 0.0, x, y
        # A larger row of the same shade is the better one: part of a shadow is as dark as the whole.
        return float(score[y, x]) * float(np.sqrt(np.count_nonzero(inside))), x, y

    def fitted(self, start: Floats) -> tuple[Floats, Half]:
        """Centres [N, 2] and half axes (px of the image) of the row whose even shade explains most of that around it.

        By a pattern search from a first row.
        """
        centres, half = self.ellipses(start)
        height, width = self.shade.shape
        ys, xs = np.mgrid[:height, :width]
        across, down = (xs[..., None] - centres[:, 0]) / half[0], (ys[..., None] - centres[:, 1]) / half[1]
        near = np.hypot(across, down).min(axis=2)
        kept = (near < ROW.fit_reach) & (self.weight > 0)
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
        return (centres + 0.5) * np.array(self.stretch), (half[0] * fx, half[1] * fy)
