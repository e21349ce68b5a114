"""What a noun says of an outline: how high it is for its width, and how wide it is at five heights.

The ranges are those of everyday things that stand upright, seen from slightly above. They overlap: many outlines can
be called by several nouns. So each noun has a likelihood, and what counts is how much more likely an outline is under
it than under the other nouns.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cow_service.media.masks import hull
from cow_service.perception.base import Thing
from cow_service.records import Shape

Range = tuple[float, float]


class FormRules(NamedTuple):
    """How outlines are compared with those of everyday things.

    Whole objects of rendered scenes under their own name reach a misfit of 5.1, and balls are fitted by a circle in
    95%. The other numbers were set by hand.
    """

    aspect_step: float = 0.1  # natural logarithm: so far off counts as 1
    filled_step: float = 0.02  # share of the hull: the same
    width_step: float = 0.05  # share of the width: the same
    less_than_round: float = 3.0  # misfit of a ball of which less than two thirds of the height show; whole ones have 0
    contradicts: float = 6.0  # misfit above which an object is not the named one
    unlike: float = -2.5  # log ratio of an outline: with less it is some other thing that is called so
    fits: float = 2.0  # misfit below which an outline is well described
    circle: float = 0.95  # share of balls whose outline a circle fits, and of other things whose outline none fits
    odd: float = 0.05  # share of outlines that fit no shape: half hidden, or with a shadow


FORM = FormRules()


_STEPS = (FORM.aspect_step, FORM.filled_step, *(FORM.width_step,) * 5)

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


def is_unlike(thing: Thing, form: str) -> bool:
    """Whether an outline is not that of a row of `OUTLINES`: another one's, or that of a torn or half hidden thing."""
    if is_cut(thing, form):
        return False
    is_box = form == "box"  # which may be flat, or as high as a tower
    measured = [0.0, *_measures(thing)[1:]] if is_box else _measures(thing)
    most = FORM.less_than_round if form == "ball" else FORM.contradicts  # of a lit cap neither foot nor size are seen
    return _misfit(measured, form) >= most or (not is_box and log_ratio(thing, form) < FORM.unlike)


def looks_like(thing: Thing) -> str | None:
    """The noun of the one row of `OUTLINES` that an outline clearly is; None if it could be many things."""
    if thing.is_hidden or is_cut(thing, "ball"):
        return None
    ratio, form = max((log_ratio(thing, form), form) for form in _TELLING)
    return form if ratio >= _CLEARLY else None


def shape_seen(thing: Thing) -> Shape | None:
    """The shape that a disc or an outline clearly shows, whatever the thing is called; None if it could be several."""
    return "sphere" if thing.is_disc else _ROUND.get(looks_like(thing) or "")


def is_other_kind(thing: Thing, noun: str | None) -> bool:
    """Whether an outline certainly belongs to another kind of object; not certain if it is torn."""
    form = form_of(noun)
    if form is None or is_cut(thing, form):
        return False
    measured = _measures(thing)
    misfits = {name: _misfit(measured, name) for name in OUTLINES}
    return misfits[form] >= 2 * FORM.contradicts and min(misfits.values()) < FORM.fits


def log_ratio(thing: Thing, form: str) -> float:
    """Natural logarithm of how much more likely an outline is under a row of `OUTLINES` than under the others."""
    rivals = OUTLINES.keys() - _SAME.get(form, {form, "box"})
    measured = _measures(thing)
    densities = {
        name: _density(measured, name) * (FORM.circle if (name == "ball") == thing.is_disc else 1 - FORM.circle)
        for name in (form, *rivals)
    }
    own = densities.pop(form)
    return math.log(own) - math.log(sum(densities.values()) / len(densities))


def _density(measured: Sequence[float], form: str) -> float:
    """exp(-misfit), over its integral over all outlines; or an outline that fits no shape."""
    (low, high), *shares = OUTLINES[form]
    sides = [math.log(high / low), *(end - start for start, end in shares)]
    integral = math.prod(side + 2 * step for side, step in zip(sides, _STEPS, strict=True))
    return (1 - FORM.odd) * math.exp(-_misfit(measured, form)) / integral + FORM.odd


def is_cut(thing: Thing, form: str) -> bool:
    """Whether the outline under a row of `OUTLINES` is not known: the border cuts the thing, or a thing hides a part.

    What is half hidden is believed to be something plain, but nothing with an outline of its own, such as a vase.
    """
    height, width = thing.mask.shape
    x0, y0, x1, y1 = thing.bbox
    return (thing.is_hidden and form in _PLAIN) or x0 <= 1 or y0 <= 1 or x1 >= width - 1 or y1 >= height - 1


def _misfit(measured: Sequence[float], form: str) -> float:
    """How far what was measured lies outside the ranges of a row of `OUTLINES`, in steps."""
    (low, high), *shares = OUTLINES[form]
    ranges = [(math.log(low), math.log(high)), *shares]
    each = zip(measured, ranges, _STEPS, strict=True)
    return sum(max(0.0, low - value, value - high) / step for value, (low, high), step in each)


def _measures(thing: Thing) -> list[float]:
    """What `OUTLINES` has ranges of, the first as a natural logarithm."""
    mask = thing.mask.patch
    height, width = mask.shape
    filled = np.count_nonzero(mask) / np.count_nonzero(hull(mask))
    # The median width in each of the bands, over the largest of them.
    rows = mask.sum(axis=1)
    cuts = [(int(low * height), math.ceil(high * height)) for low, high in BANDS]
    widths = [float(np.median(rows[start : max(start + 1, end)])) for start, end in cuts]
    return [math.log(height / width), filled, *(each / max(1.0, *widths) for each in widths)]


class NamingRules(NamedTuple):
    """What speaks for and against a thing that a noun and a colour name, as log ratios.

    Set by hand on rendered scenes of the first family and on drawn things; no single number has a measurement of its
    own.
    """

    clearly_worse: float = 2.5  # what is so much less likely than the best, twelve times, is not meant
    exact: float = 6.0  # of the name of a thing's colour
    near: float = 3.0  # of others that people may use for it
    least: float = -2.0  # lowest evidence of an outline; the highest is `clearly_worse`
    cut: float = 0.5  # share of its log ratio that an outline keeps which the border cuts
    round: float = 0.76  # roundness from which a thing passes for a ball; a cube has about 0.7
    not_round: float = 0.6  # roundness below which nothing passes for a ball
    called: float = 3.0  # if a detector found the noun: for its finds
    not_called: float = -2.0  # the same for the rest


NAMING = NamingRules()


IMPOSSIBLE = -math.inf
# No balls; of their outlines nothing is known.
SOLID = frozenset(["glass", "chair", "book", "lamp", "robot", "pencil", "pen"])


def likeness(things: Sequence[Thing], noun: str | None, head: str | None, colour: str | None) -> list[float]:
    """The log ratio of each thing to be the thing with that noun, whose last word is `head`, and colour."""
    ratios, is_found = list[float](), any(noun in thing.called for thing in things)
    for thing in things:
        tint, shape = 0.0, shape_ratio(thing, head, colour is not None)
        if colour is not None:
            near = NAMING.near if colour in thing.colours else IMPOSSIBLE
            tint = NAMING.exact if thing.colour == colour else near
        if noun in thing.called:  # outlines of real things are of many forms
            ratios.append(max(shape, NAMING.least) + tint + NAMING.called)
        else:
            ratios.append(shape + tint + (NAMING.not_called if is_found else 0.0))
    return ratios


def shape_ratio(thing: Thing, head: str | None, has_colour: bool) -> float:
    """The log ratio by outline alone; one that the border cuts says less. Without a colour a ball must be round."""
    form = form_of(head)
    # A thing is round where the noun names something round, and not where it does not.
    can_be = not thing.is_disc or (form is None and head not in SOLID)
    if form == "ball":
        round_enough = thing.roundness >= (NAMING.not_round if has_colour or thing.is_hidden else NAMING.round)
        can_be = round_enough or (thing.is_hidden and has_colour)
    if form is None or not can_be:
        return 0.0 if can_be else IMPOSSIBLE
    ratio = min(NAMING.clearly_worse, max(NAMING.least, log_ratio(thing, form)))
    return NAMING.cut * ratio if is_cut(thing, form) else ratio
