"""Fills what a thing leaves behind when it is taken out of an image: a thin drawing, or a whole object."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.vision.quilt import quilt
from cow_service.vision.sizes import box_around

INPAINT_RADIUS = 4  # px
MARGIN = 8  # px around a drawing that the fill may look at
TEXTURE_SIGMA = 3.0  # px: finer detail than this is texture, coarser is shading
VARIED = 18.0  # grey levels of standard deviation around a hole
RIM, RIM_LEAST = 0.04, 3.0  # of the hole's size, px: next to it the fill fades out, and nothing is learnt
SHADOW_STEP = 14.0  # grey levels
LEAST_WEIGHT = 1e-3  # of a pyramid cell known: with less, the coarser level says more
FADE = 0.14  # of the hole's size: how far out its shadow is taken away
FADE_MOST = 0.011  # of the image's longer side: and no further
SHIFTS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))  # in sizes of the hole

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def crop_of(mask: Mask, margin: int) -> tuple[slice, slice] | None:
    """Rows and columns that hold the mask [H, W] with a margin, or None for an empty mask."""
    window = box_around(mask)
    if window is None:
        return None
    rows, columns = (
        slice(max(0, side.start - margin), min(length, side.stop + margin))
        for side, length in zip(window, mask.shape, strict=True)
    )
    return rows, columns


def erase_drawing(image: Image, mask: Mask) -> Image:
    """The image [H, W, 3] with thin masked strokes continued from both sides (Telea's method)."""
    crop = crop_of(mask, MARGIN)
    if crop is None:
        return image
    result = image.copy()
    result[crop] = cv2.inpaint(image[crop], mask[crop].astype(np.uint8), INPAINT_RADIUS, cv2.INPAINT_TELEA)
    return result


def fill_hole(image: Image, hole: Mask, avoid: Mask | None = None) -> Image:
    """The image [H, W, 3] with a hole [H, W] closed: shading drawn in from the rim, texture taken from beside it.

    Pixels of `avoid` (other objects) give neither shading nor texture, unless nothing else is left. The object's own
    shadow around the hole gives none either; it fades out over the few pixels next to it.
    """
    size = float(np.sqrt(hole.sum()))
    crop = crop_of(hole, max(24, int(0.6 * size)))
    if crop is None:
        return image
    inside = hole[crop]
    known = ~(inside | avoid[crop]) if avoid is not None else ~inside
    if not known.any():
        known = ~inside
    if not known.any():
        return image
    source = image[crop].astype(np.float32)
    away = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, 5)
    rim = max(RIM_LEAST, RIM * size)
    shadow = _contact_shadow(source, inside, known)
    trusted = known & ~shadow & (away > rim)
    if not trusted.any():
        trusted = known
    shading = draw_in(source, trusted)
    if _is_varied(source, inside, trusted):
        filled = quilt(source, inside | (away <= rim), ~trusted, shading)
    else:
        filled = shading + _texture(image, hole, avoid, crop)
    fade = min(max(3.0, FADE * size), FADE_MOST * max(image.shape[:2]))
    reach = np.where(cv2.dilate(shadow.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0, max(fade, rim), rim)
    share = np.where(inside, 1.0, np.where(known, np.clip(1 - away / reach, 0, 1), 0.0))[..., None].astype(np.float32)
    result = image.copy()
    result[crop] = np.clip(filled * share + source * (1 - share) + 0.5, 0, 255).astype(np.uint8)
    return result


def _is_varied(source: NDArray[np.float32], inside: Mask, known: Mask) -> bool:
    """Whether what lies around the hole is no plain surface: it has texture, or several colours."""
    reach = 2 * max(4, int(0.25 * np.sqrt(inside.sum()))) + 1
    ring = (cv2.dilate(inside.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0) & known
    return bool(ring.any()) and float(source[ring].std(axis=0).max()) > VARIED


def _contact_shadow(source: NDArray[np.float32], inside: Mask, known: Mask) -> Mask:
    """Known pixels at the hole's rim that are much darker than most: the object's own shadow, no shading to draw in."""
    reach = 2 * max(3, int(0.15 * np.sqrt(inside.sum()))) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
    rim = (cv2.dilate(inside.astype(np.uint8), kernel) > 0) & known
    grey = source.mean(axis=2)
    if not rim.any():
        return rim
    return rim & (grey < np.percentile(grey[rim], 65) - SHADOW_STEP)


def draw_in(source: NDArray[np.float32], known: Mask) -> NDArray[np.float32]:
    """Unknown pixels of [h, w, 3] from known ones: averages down a pyramid, then back up (push-pull)."""
    weight = known.astype(np.float32)
    levels = [(source * weight[..., None], weight)]
    while min(levels[-1][1].shape) > 1 and not (levels[-1][1] > LEAST_WEIGHT).all():
        colours, weights = (np.asarray(cv2.pyrDown(layer), np.float32) for layer in levels[-1])
        levels.append((colours, weights))
    colours, weights = levels[-1]
    value = colours / np.maximum(weights, LEAST_WEIGHT)[..., None]
    for colours, weights in reversed(levels[:-1]):
        coarse = cv2.resize(value, (weights.shape[1], weights.shape[0]), interpolation=cv2.INTER_LINEAR)
        trust = np.minimum(weights, 1)[..., None]
        value = np.where(
            trust > LEAST_WEIGHT, colours / np.maximum(weights, LEAST_WEIGHT)[..., None], 0
        ) * trust + coarse * (1 - trust)
    for _ in range(2):
        value = np.where(known[..., None], source, cv2.GaussianBlur(value, (0, 0), 2.0))
    return np.asarray(value, np.float32)


def _texture(image: Image, hole: Mask, avoid: Mask | None, crop: tuple[slice, slice]) -> NDArray[np.float32]:
    """Fine detail for the crop, from the calmest neighbouring place of the hole's shape; zero where there is none."""
    rows, columns = crop
    height, width = hole.shape
    inner = crop_of(hole, 2) or crop
    step_y, step_x = inner[0].stop - inner[0].start, inner[1].stop - inner[1].start
    unusable = hole if avoid is None else hole | avoid
    shape = hole[inner]
    best: tuple[float, NDArray[np.float32]] | None = None
    for sx, sy in SHIFTS:
        y, x = inner[0].start + sy * step_y, inner[1].start + sx * step_x
        if y < 0 or x < 0 or y + step_y > height or x + step_x > width:
            continue
        place = slice(y, y + step_y), slice(x, x + step_x)
        if (unusable[place] & shape).any():
            continue
        patch = image[place].astype(np.float32)
        detail = patch - cv2.GaussianBlur(patch, (0, 0), TEXTURE_SIGMA)
        unrest = float(np.percentile(np.abs(detail[shape]), 99))
        if best is None or unrest < best[0]:
            best = unrest, detail
    texture = np.zeros((rows.stop - rows.start, columns.stop - columns.start, 3), np.float32)
    if best is not None:
        top, left = inner[0].start - rows.start, inner[1].start - columns.start
        texture[top : top + step_y, left : left + step_x] = best[1]
    return texture
