"""Takes the earlier positions of a trail out of an image, and completes the present one where they hid it."""

from __future__ import annotations

import numpy as np

from cow_service.vision.inpainting import fill_hole
from cow_service.vision.masks import window_of
from cow_service.vision.trails import FADED, Position, Trail
from cow_service.vision.types import Floats32, Image, Mask

RIM, LEAST_RIM = 0.06, 2.0  # of the radius, px: around a position, mixed with the background
APART = 0.03  # of the radius by which a place must lie outside all earlier positions to be surely the present one's


def ghosts_of(trail: Trail, shape: tuple[int, int]) -> Mask:
    """Mask [H, W] of the earlier positions of a trail and their rims, without the present one."""
    return _grown(trail.older, shape) & ~trail.present.disc(shape)


def without_ghosts(image: Image, trail: Trail, kept: Mask | None = None) -> Image:
    """The image [H, W, 3] with the present position of a trail alone. `kept` are other objects that stay."""
    shape = image.shape[0], image.shape[1]
    ghosts = _grown(trail.older, shape)
    if kept is not None:
        ghosts &= ~kept
    present = trail.present
    reached = present.disc(shape, _rim(present))
    hole = ghosts | reached if (ghosts & reached).any() else ghosts
    filled = fill_hole(image, hole, kept)
    window = window_of(ghosts & reached)
    result = image.copy()
    result[ghosts] = filled[ghosts]
    if window is not None:
        share, colours = _completed(image, trail, window)
        over = (ghosts & reached)[window]
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


def _grown(positions: tuple[Position, ...], shape: tuple[int, int]) -> Mask:
    mask = np.zeros(shape, bool)
    for position in positions:
        mask |= position.disc(shape, _rim(position))
    return mask


def _rim(position: Position) -> float:
    """px."""
    return max(LEAST_RIM, RIM * position.radius)
