"""What a noun says of an outline: how high it is for its width, and how wide it is at five heights.

The ranges are those of everyday things that stand upright, seen from slightly above. They overlap: many outlines can
be called by several nouns. So each noun has a likelihood, and what counts is how much more likely an outline is under
it than under the other nouns.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np

from cow_service.records import Shape
from cow_service.vision.masks import hull
from cow_service.vision.regions import Region
from cow_service.vision.types import Mask

Range = tuple[float, float]

# Natural logarithm, share of the hull, share of the width: so far off counts as 1.
ASPECT_STEP, FILLED_STEP, WIDTH_STEP = 0.1, 0.02, 0.05
LESS_THAN_ROUND = 3.0  # misfit above which a ball shows less than two thirds of its height; whole ones have none
CONTRADICTS = 6.0  # misfit above which an object is not the named one; whole objects under their own name reach 5.1
UNLIKE = -2.5  # log ratio of an outline: with less it is some other thing that is called so, whatever its colour
FITS = 2.0  # misfit below which an outline is well described
_STEPS = (ASPECT_STEP, FILLED_STEP, *(WIDTH_STEP,) * 5)
CIRCLE = 0.95  # share of balls whose outline a circle fits, and of other things whose outline none fits
ODD = 0.05  # share of outlines that fit no shape: half hidden, or with a shadow

# Rows over which a width is taken, from the upper end, as shares of the height.
BANDS = ((0.08, 0.2), (0.2, 0.35), (0.35, 0.5), (0.5, 0.8), (0.8, 0.95))
ANY: Range = (0.0, 1.0)
# Height over width, the share of its convex hull that it fills, then the widths in `BANDS` over the largest of them.
OUTLINES: dict[str, tuple[Range, Range, Range, Range, Range, Range, Range]] = {
    "ball": ((0.9, 1.1), (0.97, 1.0), (0.6, 0.8), (0.85, 0.95), (0.95, 1.0), (0.9, 1.0), (0.55, 0.8)),
    "bottle": ((1.8, 4.5), (0.86, 0.96), (0.1, 0.5), (0.3, 0.95), (0.7, 1.0), (0.85, 1.0), (0.75, 1.0)),
    "candle": ((1.4, 6.0), (0.92, 1.0), ANY, (0.93, 1.0), (0.93, 1.0), (0.9, 1.0), (0.8, 1.0)),
    "vase": ((1.3, 3.0), (0.7, 0.9), (0.5, 1.0), (0.4, 0.8), (0.3, 0.85), (0.8, 1.0), (0.4, 0.95)),
    "cone": ((0.8, 2.2), (0.94, 1.0), (0.0, 0.4), (0.2, 0.55), (0.4, 0.75), (0.6, 0.95), (0.8, 1.0)),
    "cylinder": ((1.15, 3.5), (0.97, 1.0), (0.65, 1.0), (0.85, 1.0), (0.93, 1.0), (0.9, 1.0), (0.75, 1.0)),
    "cube": ((0.85, 1.3), (0.97, 1.0), (0.4, 1.0), (0.85, 1.0), (0.93, 1.0), (0.93, 1.0), (0.5, 1.0)),
    "mug": ((0.9, 1.5), (0.84, 1.0), (0.6, 1.0), (0.7, 1.0), (0.75, 1.0), (0.7, 1.0), (0.5, 0.92)),
    "bowl": ((0.3, 1.0), (0.93, 1.0), (0.7, 1.0), (0.85, 1.0), (0.75, 1.0), (0.4, 0.85), (0.3, 0.75)),
    "car": ((0.3, 0.9), (0.82, 0.96), (0.2, 0.9), (0.5, 0.97), (0.85, 1.0), (0.75, 1.0), (0.2, 0.97)),
    "box": ((0.4, 1.6), (0.95, 1.0), (0.4, 1.0), (0.85, 1.0), (0.93, 1.0), (0.9, 1.0), (0.5, 1.0)),
}
# Share of objects with a part that reaches out on one side between their ends, or a hole; for others `NO_HANDLE`.
HANDLES = {"mug": 0.52, "cone": 0.45, "car": 0.3, "candle": 0.15}
NO_HANDLE = 0.04
_REACHES, _BARE = 0.15, 0.08  # of the width: so far out on one side at least, on the other at most
_HOLE = 0.004  # of the area
_SIDE = 0.25  # of the width: so far from the middle is the hole inside a handle, and not a window
# The rows of the body beside a handle, at both ends, and those of the handle, as shares of the height.
_UPPER, _LOWER, _BETWEEN = (0.06, 0.22), (0.72, 0.9), (0.2, 0.8)
_ALIKE = {
    "ball": "sphere orb egg marble basketball football baseball balloon globe",
    "mug": "cup", "cone": "pyramid", "cylinder": "can jar", "box": "block brick cuboid",
    "car": "bus truck van taxi lorry train",
}  # fmt: skip
_FORMS = {name: name for name in OUTLINES} | {other: name for name, said in _ALIKE.items() for other in said.split()}
# From this log ratio on, a row identifies an object (nearly anything can look like a box or a can).
_TELLING, _CLEARLY = ("ball", "bottle", "bowl", "car", "cone", "mug", "vase"), 1.5
# What is certainly as deep as it is wide, and how it is shaped.
_ROUND = dict[str, Shape](bottle="cylinder", bowl="cylinder", cone="cone", mug="cylinder", vase="cylinder")
_PLAIN = ("ball", "box", "cube", "cylinder")
# Rows that are no rivals of one: a cube is a box, a mug that hides its handle a cylinder.
_SAME = {"cube": {"cube", "box"}, "box": {"cube", "box"}, "mug": {"mug", "cylinder", "box"}}


def form_of(noun: str | None) -> str | None:
    """The row of `OUTLINES` that describes what a noun names, if any does."""
    return _FORMS.get(noun or "")


def is_unlike(region: Region, form: str) -> bool:
    """Whether an outline is not that of a row of `OUTLINES`: another one's, or that of a torn or half hidden thing."""
    if is_cut(region, form):
        return False
    is_box = form == "box"  # which may be flat, or as high as a tower
    measured = [0.0, *_measures(region)[1:]] if is_box else _measures(region)
    most = LESS_THAN_ROUND if form == "ball" else CONTRADICTS  # of a lit cap neither foot nor size are seen
    return _misfit(measured, form) >= most or (not is_box and log_ratio(region, form) < UNLIKE)


def looks_like(region: Region) -> str | None:
    """The noun of the one row of `OUTLINES` that an outline clearly is; None if it could be many things."""
    if region.is_hidden or is_cut(region, "ball"):
        return None
    ratio, form = max((log_ratio(region, form), form) for form in _TELLING)
    return form if ratio >= _CLEARLY else None


def shape_seen(region: Region) -> Shape | None:
    """The shape that a disc or an outline clearly shows, whatever the thing is called; None if it could be several."""
    return "sphere" if region.is_disc else _ROUND.get(looks_like(region) or "")


def is_other_kind(region: Region, noun: str | None) -> bool:
    """Whether an outline certainly belongs to another kind of object; not certain if it is torn or half hidden."""
    form = form_of(noun)
    if form is None or is_cut(region, form):
        return False
    measured = _measures(region)
    misfits = {name: _misfit(measured, name) for name in OUTLINES}
    return misfits[form] >= 2 * CONTRADICTS and min(misfits.values()) < FITS


def log_ratio(region: Region, form: str) -> float:
    """Natural logarithm of how much more likely an outline is under a row of `OUTLINES` than under the others."""
    rivals = OUTLINES.keys() - _SAME.get(form, {form, "box"})
    measured, handle = _measures(region), _has_handle(region.mask.patch)
    densities = {
        name: _density(measured, name)
        * (CIRCLE if (name == "ball") == region.is_disc else 1 - CIRCLE)
        * (HANDLES.get(name, NO_HANDLE) if handle else 1.0)  # one that is not seen may be behind the thing
        for name in (form, *rivals)
    }
    own = densities.pop(form)
    return math.log(own) - math.log(sum(densities.values()) / len(densities))


def _density(measured: Sequence[float], form: str) -> float:
    """exp(-misfit), over its integral over all outlines; or an outline that fits no shape."""
    (low, high), *shares = OUTLINES[form]
    sides = [math.log(high / low), *(end - start for start, end in shares)]
    integral = math.prod(side + 2 * step for side, step in zip(sides, _STEPS, strict=True))
    return (1 - ODD) * math.exp(-_misfit(measured, form)) / integral + ODD


def is_cut(region: Region, form: str) -> bool:
    """Whether the outline under a row of `OUTLINES` is not known: the border cuts the region, or a thing hides a part.

    What is half hidden is believed to be something plain, but nothing with an outline of its own, such as a vase.
    """
    height, width = region.mask.shape
    x0, y0, x1, y1 = region.bbox
    return (region.is_hidden and form in _PLAIN) or x0 <= 1 or y0 <= 1 or x1 >= width - 1 or y1 >= height - 1


def _misfit(measured: Sequence[float], form: str) -> float:
    """How far what was measured lies outside the ranges of a row of `OUTLINES`, in steps."""
    (low, high), *shares = OUTLINES[form]
    ranges = [(math.log(low), math.log(high)), *shares]
    each = zip(measured, ranges, _STEPS, strict=True)
    return sum(max(0.0, low - value, value - high) / step for value, (low, high), step in each)


def _measures(region: Region) -> list[float]:
    """What `OUTLINES` has ranges of, the first as a natural logarithm."""
    mask = region.mask.patch
    height, width = mask.shape
    sides = mask & ~(np.roll(mask, 1, axis=1) & np.roll(mask, -1, axis=1))  # their hull is that of the mask
    sides[:, [0, -1]] = mask[:, [0, -1]]
    filled = np.count_nonzero(mask) / np.count_nonzero(hull(sides))
    # The median width in each of the bands, over the largest of them.
    rows = mask.sum(axis=1)
    cuts = [(int(low * height), math.ceil(high * height)) for low, high in BANDS]
    widths = [float(np.median(rows[start : max(start + 1, end)])) for start, end in cuts]
    return [math.log(height / width), filled, *(each / max(1.0, *widths) for each in widths)]


def _has_handle(mask: Mask) -> bool:
    """Whether a mask [h, w] reaches out on one side alone between its ends, or has a hole at a side."""
    outlines, levels = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    for hole, level in zip(outlines, levels[0], strict=True):
        x, _, across, _ = cv2.boundingRect(hole)
        at_side = abs((x + across / 2) / mask.shape[1] - 0.5) > _SIDE
        if level[3] >= 0 and at_side and cv2.contourArea(hole) > _HOLE * np.count_nonzero(mask):
            return True
    # How far in it begins on the left and on the right [2, h], and from which line through its ends it reaches out.
    width, filled = mask.shape[1], mask.any(axis=1)
    sides = np.where(filled, [mask.argmax(axis=1), mask[:, ::-1].argmax(axis=1)], width)
    down = (np.arange(len(mask)) + 0.5) / len(mask)
    upper, lower = (
        sides[:, (low <= down) & (down < high)].min(axis=1, initial=width) for low, high in (_UPPER, _LOWER)
    )
    share = (down - sum(_UPPER) / 2) / (sum(_LOWER) / 2 - sum(_UPPER) / 2)
    lines = upper[:, None] + (lower - upper)[:, None] * share
    between = (down > _BETWEEN[0]) & (down < _BETWEEN[1])
    body = max(1.0, width - float(np.maximum(upper, lower).sum()))
    out = (lines - sides)[:, between].max(axis=1, initial=0.0) / body
    return bool(out.max() > _REACHES and out.min() < _BARE)


CLEARLY_WORSE = 2.5  # log ratio: what is so much less likely than the best, twelve times, is not meant
EXACT, NEAR = 6.0, 3.0  # log ratios of the name of a region's colour, and of others that people may use for it
LEAST = -2.0  # log ratio of an outline: lowest evidence against it; the highest is `CLEARLY_WORSE`
CUT = 0.5  # share of its log ratio that an outline keeps which the border cuts
ROUND = 0.76  # roundness from which a region passes for a ball; a cube has about 0.7
NOT_ROUND = 0.6  # roundness below which nothing passes for a ball, even half hidden
CALLED, NOT_CALLED = 3.0, -2.0  # log ratios if a detector found the noun: for its finds, for the rest
IMPOSSIBLE = -math.inf
SOLID = frozenset(
    ["glass", "chair", "book", "lamp", "robot", "pencil", "pen"]
)  # no balls; of their outlines nothing is known


def likeness(regions: Sequence[Region], noun: str | None, head: str | None, colour: str | None) -> list[float]:
    """The log ratio of each region to be the thing with that noun, whose last word is `head`, and colour."""
    ratios, is_found = list[float](), any(noun in region.called for region in regions)
    for region in regions:
        tint, shape = 0.0, shape_ratio(region, head, colour is not None)
        if colour is not None and region.colour != colour:
            tint = NEAR if colour in region.colours else IMPOSSIBLE
        elif colour is not None:
            tint = EXACT
        if noun in region.called:  # outlines of real things are of many forms
            ratios.append(max(shape, LEAST) + tint + CALLED)
        else:
            ratios.append(shape + tint + (NOT_CALLED if is_found else 0.0))
    return ratios


def shape_ratio(region: Region, head: str | None, has_colour: bool) -> float:
    """The log ratio by outline alone; one that the border cuts says less. Without a colour a ball must be round."""
    form = form_of(head)
    # A region is round where the noun names something round, and not where it does not.
    can_be = not region.is_disc or (form is None and head not in SOLID)
    if form == "ball":
        round_enough = region.roundness >= (NOT_ROUND if has_colour or region.is_hidden else ROUND)
        can_be = round_enough or (region.is_hidden and has_colour)
    if form is None or not can_be:
        return 0.0 if can_be else IMPOSSIBLE
    return (CUT if is_cut(region, form) else 1.0) * min(CLEARLY_WORSE, max(LEAST, log_ratio(region, form)))
