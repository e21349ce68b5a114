"""What a noun says of an outline: how high it is for its width, and how wide it is at five heights.

The ranges are those of everyday things that stand upright, seen from slightly above. They overlap: many outlines can
be called by several nouns, so one is only taken for another's rival where it is clearly worse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cow_service.vision.regions import Region
from cow_service.vision.types import Mask

Range = tuple[float, float]

ASPECT_STEP, WIDTH_STEP = 0.2, 0.1  # natural logarithm, and share of the width: so far off counts as 1
FITS, CLEARLY_WORSE = 1.0, 2.5  # misfits: up to the first it can be meant; the next must be worse by the second
MOSTLY_OUTSIDE = 0.33  # of the area of what fits: of an object that the image's border cuts, hardly the one meant

CONTRADICTS = 3.5  # misfit from which a thing is not what it is called; of things in their own name up to 2.4
VEHICLES = frozenset({"car", "bus", "truck", "van", "taxi", "lorry", "train"})
LONG, NOT_LONG = 1.2, 1.05  # width over height: of a vehicle from the side, and of what is none

# Rows over which a width is taken, from the upper end, as shares of the height.
BANDS = ((0.08, 0.2), (0.2, 0.35), (0.35, 0.5), (0.5, 0.8), (0.8, 0.95))
ANY: Range = (0.0, 1.0)
# Height over width, then the widths in `BANDS` over the largest of them.
OUTLINES: dict[str, tuple[Range, Range, Range, Range, Range, Range]] = {
    "bottle": ((1.8, 4.5), (0.1, 0.5), (0.3, 0.95), (0.7, 1.0), (0.85, 1.0), (0.75, 1.0)),
    "candle": ((1.4, 6.0), ANY, (0.93, 1.0), (0.93, 1.0), (0.9, 1.0), (0.8, 1.0)),
    "vase": ((1.3, 3.0), (0.5, 1.0), (0.4, 0.8), (0.3, 0.85), (0.8, 1.0), (0.4, 0.95)),
    "cone": ((0.8, 2.2), (0.0, 0.4), (0.2, 0.55), (0.4, 0.75), (0.6, 0.95), (0.8, 1.0)),
    "cylinder": ((1.1, 3.5), (0.85, 1.0), (0.93, 1.0), (0.93, 1.0), (0.9, 1.0), (0.75, 1.0)),
    "cube": ((0.75, 1.3), (0.4, 1.0), (0.85, 1.0), (0.93, 1.0), (0.93, 1.0), (0.5, 1.0)),
    "mug": ((0.8, 1.35), (0.6, 0.95), (0.7, 1.0), (0.75, 1.0), (0.7, 1.0), (0.5, 0.9)),
    "bowl": ((0.3, 1.0), (0.7, 1.0), (0.85, 1.0), (0.75, 1.0), (0.4, 0.85), (0.3, 0.75)),
    "car": ((0.3, 0.95), (0.2, 0.85), (0.5, 0.95), (0.85, 1.0), (0.75, 1.0), (0.2, 0.95)),
}


def clearest(regions: Sequence[Region], noun: str | None, count: int = 1) -> list[Region]:
    """The so many regions whose outlines fit a noun where all others are clearly worse; none where it is not clear."""
    if noun in VEHICLES and count == 1 and len(regions) > 1:
        return _longest(regions)
    misfits = [_misfit(region, noun) for region in regions] if noun in OUTLINES else []
    known = sorted((misfit, i) for i, misfit in enumerate(misfits) if misfit is not None)
    if len(known) <= count:
        return []
    fit, next_one = known[count - 1][0], known[count][0]
    best = [regions[place] for _, place in known[:count]]
    cut = [region for region, misfit in zip(regions, misfits, strict=True) if misfit is None]
    clear = fit <= FITS and next_one >= fit + CLEARLY_WORSE
    return best if clear and all(each.mask.area < MOSTLY_OUTSIDE * best[0].mask.area for each in cut) else []


def _longest(regions: Sequence[Region]) -> list[Region]:
    """The one region that is longer than high and outlined like a car, where no other one is long."""
    ranked = sorted(regions, key=_length, reverse=True)
    misfit = _misfit(ranked[0], "car")
    clear = _length(ranked[0]) >= LONG and _length(ranked[1]) <= NOT_LONG and misfit is not None and misfit <= FITS
    return ranked[:1] if clear else []


def _length(region: Region) -> float:
    """Width over height."""
    x0, y0, x1, y1 = region.bbox
    return (x1 - x0) / (y1 - y0)


def contradicts(region: Region, noun: str | None) -> bool:
    """Whether an outline is clearly not that of a noun."""
    misfit = _misfit(region, noun) if noun in OUTLINES else None
    return misfit is not None and misfit >= CONTRADICTS


def _misfit(region: Region, noun: str | None) -> float | None:
    """How far an outline lies outside the ranges of a noun, in steps; None for one that the image's border cuts."""
    height, width = region.mask.shape
    x0, y0, x1, y1 = region.bbox
    if noun is None or x0 <= 1 or y0 <= 1 or x1 >= width - 1 or y1 >= height - 1:
        return None
    aspects, *bands = OUTLINES[noun]
    off = _outside(math.log((y1 - y0) / (x1 - x0)), math.log(aspects[0]), math.log(aspects[1])) / ASPECT_STEP
    widths = _widths(region.mask.patch)
    return off + sum(_outside(value, *band) for value, band in zip(widths, bands, strict=True)) / WIDTH_STEP


def _outside(value: float, low: float, high: float) -> float:
    return max(0.0, low - value, value - high)


def _widths(mask: Mask) -> list[float]:
    """The median width in each of the `BANDS` of a mask [h, w], over the largest of them."""
    rows = mask.sum(axis=1)
    cuts = [(int(low * len(rows)), math.ceil(high * len(rows))) for low, high in BANDS]
    widths = [float(np.median(rows[start : max(start + 1, end)])) for start, end in cuts]
    return [width / max(1.0, *widths) for width in widths]
