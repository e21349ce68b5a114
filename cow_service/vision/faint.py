"""Finds what may be a thing although it hardly stands out: a white cone on a pale floor.

A patch that a closed weak edge surrounds, paler than the floor on every side of it or of another hue. What is darker
and of the floor's hue may as well be a shadow. Such a patch is too faint to be simulated, and too clear to be denied.
"""

from collections.abc import Sequence

import numpy as np

from cow_service.records import BBox
from cow_service.vision.completion import WEAK_EDGES, enclosed
from cow_service.vision.contrast import View
from cow_service.vision.masks import dilated, hull, resized_mask, without_holes
from cow_service.vision.regions import Region
from cow_service.vision.types import Floats32, Mask

LEAST_AREA = 0.0008  # of the image
COVERED = 0.25  # of a patch, by things that were found: it is a part of one
SOLID = 0.8  # of its convex hull that a patch fills
PALER, TINTED = 1.2, 3.0  # Lab lightness above the floor on every side of it, and Lab units from its hue
OUT_OF_TEXTURE = 2.0  # of the spread in lightness of the floor around it: less is texture
NEAR, BEYOND = 5, 12  # px at the working size: the floor around it, and that beyond the joint beside a tile
DARKEST = -5.0  # Lab lightness against the floor on any side: what is darker is a shadow or a gap


def find_faint(view: View, size: tuple[int, int], regions: Sequence[Region]) -> tuple[BBox, ...]:
    """Boxes [x0, y0, x1, y1] (px) of possible things in an image (width, height) that are not regions."""
    taken, found = np.zeros(size[::-1], bool), list[BBox]()
    for region in regions:
        region.mask.add_to(taken)
    taken = dilated(resized_mask(taken, (view.lab.shape[1], view.lab.shape[0])), 7)
    across, down = size[0] / taken.shape[1], size[1] / taken.shape[0]
    for near, patch, (x, y, w, h) in enclosed(view, *WEAK_EDGES):
        area = np.count_nonzero(patch)
        if area < LEAST_AREA * taken.size or np.count_nonzero(taken[near] & patch) > COVERED * area:
            continue
        y0, x0 = max(0, near[0].start - BEYOND), max(0, near[1].start - BEYOND)
        wide = slice(y0, near[0].stop + BEYOND), slice(x0, near[1].stop + BEYOND)
        whole = np.zeros(taken.shape, bool)
        whole[near] = patch
        steps = _steps(view.lab[wide], whole[wide], taken[wide])
        if steps is None:
            continue
        paler, tinted = steps
        texture = OUT_OF_TEXTURE * float(np.median(view.spread[near]))
        if paler > max(PALER, texture) or (tinted > TINTED and paler > max(DARKEST, texture - tinted)):
            found.append((x * across, y * down, (x + w) * across, (y + h) * down))
    return tuple(found)


def _steps(lab: Floats32, patch: Mask, taken: Mask) -> tuple[float, float] | None:
    """How much paler a patch [h, w] is than each quarter of the floor around it, and how far from its hue, at least.

    None for a patch that is ragged, or beside which some quarter is not seen. `taken` [h, w] are things.
    """
    whole = without_holes(dilated(patch))
    if np.count_nonzero(whole) < SOLID * np.count_nonzero(hull(whole)):
        return None
    own, steps = np.median(lab[patch], axis=0), list[Floats32]()
    for around in (dilated(whole, 2 * NEAR + 1), dilated(whole, 2 * BEYOND + 1) & ~taken):
        rows, columns = np.nonzero(around & ~dilated(whole, 5))
        quarter = 2 * (rows > rows.mean()) + (columns > columns.mean()) if len(rows) else rows
        sides = [lab[rows[quarter == i], columns[quarter == i]] for i in range(4)]
        if min(len(side) for side in sides) == 0:
            return None
        steps += [own - np.median(side, axis=0) for side in sides]
    lightness, *hue = np.array(steps).T
    return float(lightness.min()), float(np.hypot(*hue).min())
