"""Measures the opening of a container that is seen from above: the ellipse of its rim."""

from typing import NamedTuple

import numpy as np

from cow_service.media.masks import CroppedMask
from cow_service.physics.bodies import Rim, SeenOpening


class RimRules(NamedTuple):
    """What is the rim of a container.

    Set by hand on rendered and drawn bowls, mugs and pots. The deviations, too; no
    single number has a measurement of its own.
    """

    flattest: float = 0.12  # of the ellipse's width: its height, at least
    roundest: float = 0.7  # the same, at most
    least_rim: float = 0.75  # of half the width of the mask: a narrower rim beside a handle is not looked for
    arc: float = 0.9  # of its half width: so far to either side its upper half is compared with the outline
    fits: float = 0.12  # of its half height, mean distance of the two: a worse one is no ellipse
    same_width: float = 0.97  # of the widest rim: they differ by the outline's noise
    thickness: float = 0.93  # inner of outer radius
    assumed_sigma: float = 0.06  # of the logarithm of the opening's width, where a rim is seen
    unseen_sigma: float = 0.5  # the same where no rim is
    tapered: float = 0.35  # of the rim's width: a floor is not narrower


RIM = RimRules()


def measure_opening(mask: CroppedMask, square: bool = False) -> SeenOpening:
    """The opening of a thing that is known to be a container; where no rim is seen, that of common ones."""
    rim = _outer_rim(mask)
    if rim is None:
        return SeenOpening(RIM.thickness, RIM.unseen_sigma, 1.0 if square else 0.7, square)
    x0, _, x1, _ = mask.bbox
    share = min(1.0, 2 * rim[2] / (x1 - x0))  # a handle is next to the rim
    bottom = 1.0 if square else _bottom(mask, rim)
    return SeenOpening(RIM.thickness * share, RIM.assumed_sigma, bottom * share, square, rim)


def _outer_rim(mask: CroppedMask) -> Rim | None:
    """The ellipse (x, y, half width, half height, px) whose upper half is the upper outline of a mask."""
    patch = mask.patch
    height, width = patch.shape
    tops = np.where(patch.any(axis=0), patch.argmax(axis=0), height).astype(np.float64)
    found: list[tuple[float, Rim]] = []
    least, most = max(1.0, RIM.flattest * width / 2), min(RIM.roundest * width / 2, 0.9 * height)
    for tall in np.arange(least, most, 0.5).tolist():
        across = np.nonzero(patch[min(height - 1, round(tall))])[0]
        if not len(across):  # between two pieces of the mask
            continue
        half, middle = float(across[-1] - across[0] + 1) / 2, float(across[-1] + across[0] + 1) / 2
        if half < max(3.0, RIM.least_rim * width / 2):
            continue
        columns = np.arange(width)[np.abs(np.arange(width) + 0.5 - middle) < RIM.arc * half]
        off = (columns + 0.5 - middle) / half
        lower = tops[columns] - tall * (1 - np.sqrt(1 - off**2))
        shift = float(np.median(lower))
        error = float(np.mean(np.abs(lower - shift)))
        if error < RIM.fits * tall:
            found.append((error, (mask.columns.start + middle, mask.rows.start + tall + shift, half, tall)))
    if not found:
        return None
    # The upper arc of an ellipse fits smaller ones too.
    widest = max(rim[2] for _, rim in found)
    return min(each for each in found if each[1][2] > RIM.same_width * widest)[1]


def _bottom(mask: CroppedMask, rim: Rim) -> float:
    """Outer width at the lower end, of the rim's: the sides run straight from the rim to an ellipse of its form."""
    x, y, half, tall = rim
    x -= mask.columns.start
    first, last = round(y - mask.rows.start), mask.patch.shape[0]
    rows = np.arange(first, min(last, first + max(2, round(0.7 * (last - first)))))
    if len(rows) < 3:
        return 1.0
    patch = mask.patch[rows]
    seen = patch.any(axis=1)
    right = np.where(seen, patch.shape[1] - patch[:, ::-1].argmax(axis=1) - x, 0.0)
    left = np.where(seen, x - patch.argmax(axis=1), half)
    sides = np.minimum(left, right)  # a handle is on one side
    slope = float(np.polyfit(rows - first, sides, 1)[0])
    lowest = (half + slope * (last - first)) / max(1 + slope * tall / half, 0.1)
    return min(1.0, max(RIM.tapered, lowest / half))
