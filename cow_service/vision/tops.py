"""Finds what stands on an object in the middle of its upper edge: a flame, a neck or the handle of a lid.

It is too thin, or too like the floor, to be found by its colour. But it differs, row by row, from what lies half the
object's width to its left and to its right, which a line of the wall, a wider object behind it or a shadow does not.
"""

from __future__ import annotations

import cv2
import numpy as np

from cow_service.vision.masks import outline_of, window_of
from cow_service.vision.types import Floats32, Mask

WEIGHTS = np.array([1.0, 0.5, 0.5], np.float32)  # of L, a and b in a step: compression spreads colour, not lightness
STEP, CLEAR_STEP = 2.0, 4.0  # Lab units from both sides: of every pixel, and in the median
BLUR = 0.25  # of the largest steps: less is the blur of an edge
SIDE = 0.5  # of the object's width: how far away the sides are looked at, and the width of what is searched
LEAST_SIDE = 5  # px at the working size
UPPER_ROWS = 0.15  # of the object's height: where its middle is taken
OFF_MIDDLE = 0.15  # of the object's width, by which it may stand beside that middle
SUNK = 0.25  # of the object's height: so far below the object's upper end its foot may lie
LEAST_HEIGHT, MOST_HEIGHT = 3, 0.6  # px at the working size: less is blur; of the object's height: more is no part
SHARP = 0.6  # share of its outline that lies on edges
SHADE_HUE = 2.5  # Lab units in the a*b* plane: more is another colour, not a shadow
DARK, SHADE_DEPTH = 20, 0.65  # the percentile of its lightness that counts, and of the sides' lightness: less is black


def standing_on(part: Mask, taken: Mask, lab: Floats32, edges: Mask) -> Mask | None:
    """The mask [h, w] of what stands on a part [h, w] that is not empty, or None. `taken` [h, w] are other objects.

    `lab` [h, w, 3] is the image in CIE Lab, `edges` [h, w] is set on its edges.
    """
    rows, columns = window_of(part) or (slice(0, 1), slice(0, 1))
    width, height = columns.stop - columns.start, rows.stop - rows.start
    upper = np.nonzero(part[rows.start : rows.start + max(2, round(UPPER_ROWS * height))].any(axis=0))[0]
    middle = (float(upper[0]) + float(upper[-1])) / 2
    side = max(LEAST_SIDE, round(SIDE * width))
    left, right = round(middle - side / 2), round(middle + side / 2) + 1
    top, bottom = max(0, rows.start - round(MOST_HEIGHT * height)), rows.start + max(2, round(SUNK * height))
    above = rows.start - top
    if left < side or right + side > part.shape[1] or above < LEAST_HEIGHT:
        return None
    strip, *sides = (np.s_[top:bottom, left + shift : right + shift] for shift in (0, -side, side))
    steps = np.min([np.linalg.norm((lab[strip] - lab[beside]) * WEIGHTS, axis=2) for beside in sides], axis=0)
    free = [~(part[area] | taken[area]) for area in (strip, *sides)]
    differs = (steps > STEP) & np.all(free, axis=0)
    if differs.any():
        differs &= steps > BLUR * np.percentile(steps[differs], 90)
    if not differs[above - LEAST_HEIGHT : above].any():
        return None
    found = _joined(differs, part[strip])
    seen = _above_rim(found[:above])
    if seen is None or abs(float(np.nonzero(seen)[1].mean()) + left - middle) > OFF_MIDDLE * width:
        return None
    found &= cv2.dilate(np.any(seen, axis=0, keepdims=True).astype(np.uint8), np.ones((1, 3), np.uint8)) > 0
    if np.median(steps[found]) < CLEAR_STEP:
        return None
    colours = [lab[area][: len(seen)][seen] for area in (strip, *sides)]
    if _is_shadow(*colours) or np.mean(edges[strip][outline_of(found)]) < SHARP:
        return None
    whole = np.zeros(part.shape, bool)
    whole[strip] = found
    return whole


def _joined(differs: Mask, part: Mask) -> Mask:
    """What of the pixels that differ [n, m] is joined to the part [n, m]."""
    body = cv2.dilate(part.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    _, labels = cv2.connectedComponents((differs | body).astype(np.uint8), connectivity=8)
    joined = np.unique(labels[part])
    return differs & np.isin(labels, joined[joined > 0])


def _above_rim(found: Mask) -> Mask | None:
    """The rows above the object's rim of what is found [n, m] above its upper end; None where it goes on or is low.

    The rim, which may cross the whole strip, is low itself.
    """
    rim = np.nonzero(found[:, 0] | found[:, -1])[0]
    seen = found[: int(rim[0])] if len(rim) else found
    rows = np.nonzero(seen.any(axis=1))[0]
    if not len(rows) or rows[0] == 0 or len(found) - len(seen) > LEAST_HEIGHT:
        return None
    return seen if len(found) - int(rows[0]) >= LEAST_HEIGHT else None


def _is_shadow(seen: Floats32, *sides: Floats32) -> bool:
    """Whether Lab colours [N, 3] are those of the sides [N, 3], all three darkened by the same share."""
    floor = np.median(np.concatenate(sides), axis=0)
    lightness, *hue = np.median(seen, axis=0)
    share = float(lightness) / max(1.0, float(floor[0]))
    darkest = float(np.percentile(seen[:, 0], DARK)) / max(1.0, float(floor[0]))
    return share < 1 and darkest > SHADE_DEPTH and float(np.hypot(*(hue - share * floor[1:]))) < SHADE_HUE
