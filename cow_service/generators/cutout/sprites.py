"""Sprites: a body cut out of the image with a soft edge, and drawn again moved, scaled and turned."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from cow_service.records.motion import Shape
from cow_service.vision.inpainting import push_pull
from cow_service.vision.masks import Floats, Floats32, Image, Mask, turning, window_of

EDGE_SIGMA = 0.8  # px: Gaussian that softens the sprite's edge
MARGIN = 4  # px around the mask that the soft edge takes
SHADING_SIGMA = 0.1  # of a ball's width: coarser than this is its shading, finer is what is printed on it
PRINTED = 14.0  # grey levels, 80th percentile: from so much fine detail on, a ball is seen to turn
SMALLEST = 0.5  # scale under which a half-size copy of the sprite is drawn, so that it does not flicker

Window = tuple[slice, slice]  # rows and columns of the clip's frames


@dataclass(frozen=True)
class Sprite:
    """A body as it is at the first frame: colours times alpha, then alpha 0..1.

    A ball's shading stays towards the light while what is printed on it turns: then both parts are there, and add up.
    """

    fixed: Floats32 | None  # [a, b, 4]: does not turn
    turning: Floats32 | None  # [a, b, 4]: turns about `start`
    origin: tuple[float, float]  # x, y of its top left corner at the first frame, px
    start: tuple[float, float]  # x, y of the body's centre at the first frame, px


def cut(image: Image, mask: Mask, hidden: Mask | None, start: tuple[float, float], shape: Shape | None) -> Sprite:
    """The body under a mask [h, w]; its part `hidden` behind others gets the colours next to it."""
    whole = mask if hidden is None else mask | hidden
    inside = window_of(whole, MARGIN) or (slice(0, 1), slice(0, 1))
    body, colours = whole[inside], image[inside].astype(np.float32)
    alpha = soft(body)
    known = mask[inside]
    core = cv2.erode(known.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    if not core.any():
        core = known
    own = push_pull(colours, core) if core.any() else colours
    rim = 0.5 * colours + 0.5 * own
    blended = np.where(core[..., None], colours, np.where(known[..., None], rim, own))
    pixels = np.dstack([blended * alpha[..., None], alpha]).astype(np.float32)
    origin = float(inside[1].start), float(inside[0].start)
    if shape != "sphere":
        return Sprite(None, pixels, origin, start)
    detail = _detail(blended, body)
    if detail is None:
        return Sprite(pixels, None, origin, start)
    turning = np.dstack([detail * alpha[..., None], np.zeros_like(alpha)]).astype(np.float32)
    return Sprite(pixels - turning, turning, origin, start)


def _detail(colours: Floats32, body: Mask) -> Floats32 | None:
    """What is printed on a ball [a, b, 3], without its shading; None where it is plain."""
    sigma = max(1.0, SHADING_SIGMA * float(np.sqrt(body.sum())))
    weight = body.astype(np.float32)
    shares = np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)
    shading = cv2.GaussianBlur(colours * weight[..., None], (0, 0), sigma) / shares[..., None]
    detail = np.asarray((colours - shading) * weight[..., None], np.float32)
    core = cv2.erode(weight, np.ones((5, 5), np.uint8)) > 0
    printed = core.any() and float(np.percentile(np.abs(detail[core]).max(axis=1), 80)) > PRINTED
    return detail if printed else None


def moved(
    sprite: Sprite, point: Floats, scale: float, rotation: float, size: tuple[int, int]
) -> tuple[Window, Floats32] | None:
    """Window and pixels [a, b, 4] of a sprite whose centre has gone to `point` (px); None outside a frame of `size`."""
    parts = [(part, turn) for part, turn in ((sprite.fixed, 0.0), (sprite.turning, rotation)) if part is not None]
    shape = parts[0][0].shape
    corners = np.concatenate([_corners(sprite, shape, point, scale, turn) for _, turn in parts])
    window = clipped(corners.min(axis=0) - 1, corners.max(axis=0) + 1, size)
    if window is None:
        return None
    total: Floats32 | None = None
    for part, turn in parts:
        drawn = _warped(sprite, part, point, scale, turn, window)
        total = drawn if total is None else total + drawn
    assert total is not None  # a sprite has a part
    return window, total


def clipped(low: Floats, high: Floats, size: tuple[int, int]) -> Window | None:
    """The window between two corners x, y (px), inside a frame of a size (width, height); None where that is empty."""
    x0, y0 = (math.floor(min(max(float(v), 0.0), side)) for v, side in zip(low, size, strict=True))
    x1, y1 = (math.ceil(min(max(float(v), 0.0), side)) for v, side in zip(high, size, strict=True))
    return (slice(y0, y1), slice(x0, x1)) if x1 > x0 and y1 > y0 else None


def soft(mask: Mask) -> Floats32:
    """Alpha 0..1 of a mask: half at its outline."""
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), EDGE_SIGMA), np.float32)


def _corners(sprite: Sprite, shape: tuple[int, ...], point: Floats, scale: float, degrees: float) -> Floats:
    offset = np.array(sprite.origin) - np.array(sprite.start)
    corners = offset + np.array([[0, 0], [shape[1], 0], [0, shape[0]], [shape[1], shape[0]]])
    return point + corners @ turning(scale, degrees).T


def _warped(sprite: Sprite, part: Floats32, point: Floats, scale: float, degrees: float, window: Window) -> Floats32:
    """The part in a window; pixel centres, not corners, are what warpAffine maps."""
    cell = 1.0
    while scale * cell < SMALLEST and min(part.shape[:2]) > 3:
        width, height = max(1, part.shape[1] // 2), max(1, part.shape[0] // 2)
        half = cv2.resize(part[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
        part = np.asarray(half, np.float32)
        cell *= 2
    turn = turning(scale, degrees)
    rows, columns = window
    first = np.array(sprite.origin) + 0.5 * cell - np.array(sprite.start)
    shift = point + turn @ first - 0.5 - np.array([columns.start, rows.start])
    transform = np.column_stack([turn * cell, shift])
    size = columns.stop - columns.start, rows.stop - rows.start
    return np.asarray(cv2.warpAffine(part, transform, size, flags=cv2.INTER_LINEAR), np.float32)
