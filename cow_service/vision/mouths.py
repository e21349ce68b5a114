"""Joins the bright mouth of a white vase or cup with its lit body, where the neck between is as dark as the floor."""

from __future__ import annotations

import cv2
import numpy as np

from cow_service.vision.masks import window_of
from cow_service.vision.types import Floats32, Mask

FLAT = 0.45  # of its width: a mouth seen from above is no higher
OVERLAP = 0.6  # of the narrower one's width, that lies below the mouth
MOST_GAP = 1.2  # of the mouth's width: the neck is no longer
OFF_MIDDLE = 0.3  # of the mouth's width, by which the body's middle may lie beside it
SHOULDER = 0.15  # of the body's height: the rows at which the neck ends
STEP = 1.0  # Lab units between the neck and the floor beside it, in the mean: no floor is seen between the two


def neck_between(mouth: Mask, body: Mask, lab: Floats32) -> Mask | None:
    """The mask [h, w] of the neck between a mouth and a body [h, w]; None where they are no one thing's.

    `lab` [h, w, 3] is the image in CIE Lab.
    """
    upper, lower = window_of(mouth), window_of(body)
    if upper is None or lower is None:
        return None
    (rows, columns), (below, across) = upper, lower
    width, gap = columns.stop - columns.start, below.start - rows.stop
    shared = min(columns.stop, across.stop) - max(columns.start, across.start)
    aside = abs(columns.start + columns.stop - across.start - across.stop) / 2
    if rows.stop - rows.start > FLAT * width or not 0 < gap <= MOST_GAP * width:
        return None
    if shared < OVERLAP * min(width, across.stop - across.start) or aside > OFF_MIDDLE * width:
        return None
    shoulder = below.start + max(1, round(SHOULDER * (below.stop - below.start)))
    neck = _hull(mouth, body[:shoulder]) & ~mouth & ~body
    ends = np.nonzero(neck.any(axis=0))[0]
    beside = np.zeros(neck.shape, bool)
    beside[rows.stop : below.start, max(0, int(ends[0]) - width // 2) : int(ends[-1]) + width // 2] = True
    beside &= cv2.dilate((neck | mouth | body).astype(np.uint8), np.ones((5, 5), np.uint8)) == 0
    inner = cv2.erode(neck.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    if not beside.any() or not inner.any():
        return None
    return neck if np.linalg.norm(lab[inner].mean(axis=0) - lab[beside].mean(axis=0)) > STEP else None


def _hull(mouth: Mask, shoulder: Mask) -> Mask:
    """The convex hull [h, w] of a mouth [h, w] and of the upper rows of a body."""
    points = [np.argwhere(mask)[:, ::-1] for mask in (mouth, shoulder)]
    hull = np.zeros(mouth.shape, np.uint8)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(points).astype(np.int32)), 1)
    return hull > 0
