"""Takes the earlier positions of a trail out of an image, and completes the present one where they hid it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cow_service.vision.inpainting import fill_hole
from cow_service.vision.masks import window_of
from cow_service.vision.trails import TRAIL, Position, Trail, sampled
from cow_service.vision.types import Floats32, Image


class PositionRules(NamedTuple):
    """How earlier positions are taken out.

    Set by hand on trails of the first family of rendered scenes; no single number has a measurement of its own.
    """

    rim: float = 0.06  # of the radius: around a position, mixed with the background
    least_rim: float = 2.0  # px: the same, at least
    apart: float = 0.03  # radii outside all earlier positions: there a pixel is surely the present one's


POSITION = PositionRules()


def without_earlier_positions(image: Image, trail: Trail) -> Image:
    """The image [H, W, 3] with the present position of a trail alone."""
    shape, present = (image.shape[0], image.shape[1]), trail.present
    earlier = np.any(
        [each.disc(shape, max(POSITION.least_rim, POSITION.rim * each.radius)) for each in trail.older], axis=0
    )
    reached = present.disc(shape, max(POSITION.least_rim, POSITION.rim * present.radius))
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
    own = best > POSITION.apart
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
