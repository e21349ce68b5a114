"""Measures the opening of a container that is seen from above: the ellipse of its rim, outside and inside."""

from dataclasses import dataclass

import cv2
import numpy as np

from cow_service.vision.masks import CroppedMask, lab_of
from cow_service.vision.types import Floats, Image

FLATTEST, ROUNDEST = 0.12, 0.7  # of the ellipse's width: its height
LEAST_RIM = 0.75  # of half the width of the mask: a narrower rim beside a handle is not looked for
ARC = 0.9  # of its half width: so far to either side its upper half is compared with the outline
FITS = 0.12  # of its half height, mean distance of the two: a worse one is no ellipse
SAME_WIDTH = 0.97  # of the widest rim: they differ by the outline's noise
NARROWEST, WIDEST = 0.75, 0.975  # of the outer ellipse: where the inner one is looked for
OUTLINE = 1.5  # px: how wide it is
BESIDE = 30.0  # degrees of the ellipse up and down from its ends: its sides
EDGE = 4.0  # Lab units across the inner edge of a rim, in the mean: less is no edge
THICKNESS = 0.93  # inner of outer radius, where no inner edge is seen
MEASURED_SIGMA, ASSUMED_SIGMA, UNSEEN_SIGMA = 0.04, 0.06, 0.5  # of the logarithm of the opening's width
TAPERED = 0.35  # of the rim's width: a floor is not narrower

Rim = tuple[float, float, float, float]  # an ellipse: x, y, half width, half height, px


@dataclass(frozen=True)
class SeenOpening:
    """The opening of a container, in shares of half its width."""

    inner: float  # half the width of the opening
    deviation: float  # one standard deviation of its logarithm
    bottom: float  # half the outer width at its lower end
    square: bool = False  # four walls, not a round one
    rim: Rim | None = None  # its ellipse
    has_edge: bool = False  # the inner edge of a rim is seen
    foot_hidden: bool = False  # something stands before its lower end: it is higher than it is seen


def measure_opening(image: Image, mask: CroppedMask, square: bool = False) -> SeenOpening:
    """The opening of a thing that is known to be a container; where no rim is seen, that of common ones."""
    rim = _outer_rim(mask)
    if rim is None:
        return SeenOpening(THICKNESS, UNSEEN_SIGMA, 1.0 if square else 0.7, square)
    x0, _, x1, _ = mask.bbox
    share = min(1.0, 2 * rim[2] / (x1 - x0))  # a handle is next to the rim
    inner = _inner_share(image, mask, rim)
    bottom = 1.0 if square else _bottom(mask, rim)
    known, sigma = (THICKNESS, ASSUMED_SIGMA) if inner is None else (inner, MEASURED_SIGMA)
    return SeenOpening(known * share, sigma, bottom * share, square, rim, inner is not None)


def _outer_rim(mask: CroppedMask) -> Rim | None:
    """The ellipse (x, y, half width, half height, px) whose upper half is the upper outline of a mask."""
    patch = mask.patch
    height, width = patch.shape
    tops = np.where(patch.any(axis=0), patch.argmax(axis=0), height).astype(np.float64)
    found: list[tuple[float, Rim]] = []
    for tall in np.arange(max(1.0, FLATTEST * width / 2), min(ROUNDEST * width / 2, 0.9 * height), 0.5).tolist():
        across = np.nonzero(patch[min(height - 1, round(tall))])[0]
        half, middle = float(across[-1] - across[0] + 1) / 2, float(across[-1] + across[0] + 1) / 2
        if half < max(3.0, LEAST_RIM * width / 2):
            continue
        columns = np.arange(width)[np.abs(np.arange(width) + 0.5 - middle) < ARC * half]
        off = (columns + 0.5 - middle) / half
        lower = tops[columns] - tall * (1 - np.sqrt(1 - off**2))
        shift = float(np.median(lower))
        error = float(np.mean(np.abs(lower - shift)))
        if error < FITS * tall:
            found.append((error, (mask.columns.start + middle, mask.rows.start + tall + shift, half, tall)))
    if not found:
        return None
    # The upper arc of an ellipse fits smaller ones too.
    widest = max(rim[2] for _, rim in found)
    return min(each for each in found if each[1][2] > SAME_WIDTH * widest)[1]


def _inner_share(image: Image, mask: CroppedMask, rim: Rim) -> float | None:
    """The inner ellipse's width, of the outer's: where the colours change most at both its sides.

    There the height of the ellipse, which is known least, matters least.
    """
    x, y, half, tall = rim
    lab, step = lab_of(image[mask.rows, mask.columns]), max(0.015, 1.0 / half)
    shares = np.arange(NARROWEST, min(WIDEST, 1 - step - OUTLINE / half), 0.005)  # the outline is an edge, too
    if not len(shares):
        return None
    sides = np.linspace(-BESIDE, BESIDE, 20)
    angles = np.radians(np.concatenate([sides, 180 + sides]))
    colours: list[Floats] = []  # [S, 40, 3] at the sides of ellipses that are a step wider, and narrower
    for tried in (shares + step, shares - step):
        columns = (x - mask.columns.start + half * tried[:, None] * np.cos(angles) - 0.5).astype(np.float32)
        rows = (y - mask.rows.start + tall * tried[:, None] * np.sin(angles) - 0.5).astype(np.float32)
        found = cv2.remap(lab, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        colours.append(np.asarray(found, np.float64))
    change = np.linalg.norm(colours[0] - colours[1], axis=2).mean(axis=1)
    if change.max() <= EDGE:
        return None
    edge = change > 0.9 * change.max()  # as wide as the step: its middle is taken
    return float((shares * change)[edge].sum() / change[edge].sum())


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
    return min(1.0, max(TAPERED, lowest / half))
