"""Which regions the names of a question mean, all names at once: two things have two regions.

A region and a name have a log ratio: how much more likely what is seen is if the name means this region than if it
does not, by colour and outline. An assignment of regions to all names is as good as the sum of its log ratios.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from cow_service.readers.embedded.english.lexicon import words
from cow_service.readers.embedded.english.tokens import ObjectPhrase
from cow_service.readers.embedded.outlines import form_of, is_cut, log_ratio
from cow_service.vision.regions import Region

CLEARLY_WORSE = 2.5  # log ratio: what is so much less likely than the best, twelve times, is not meant
EXACT, NEAR = 6.0, 3.0  # log ratios of the name of a region's colour, and of others that people may use for it
SURE = CLEARLY_WORSE  # log ratio of an outline: more counts no more, so what could be meant too is a rival
LEAST = -2.0  # log ratio of an outline: less speaks no more against it
CUT = 0.5  # share of its log ratio that an outline keeps which the border cuts
CLEAR = 1.0  # log ratio of an outline from which one of several is called so
POOR = -1.0  # log ratio of an outline: with less it is not called so, unless by its colour
UNSEEN = -6.0  # log ratio of a name to which no region is assigned
SHARED = -3.0  # log ratio of a region with two names of the same kind
ROUND = 0.76  # roundness from which a region passes for a ball; a cube has about 0.7
NOT_ROUND = 0.6  # roundness below which nothing passes for a ball, even half hidden
MAX_OTHERS = 5  # names that are assigned beside one: the work grows fast with their number
IMPOSSIBLE = -math.inf
NOWHERE = -1  # place of the region of a name that has none

_SOLID = words("glass chair book lamp robot pencil pen")  # no balls; of their outlines nothing is known
_ANYTHING = words("object thing item shape one")

Row = list[float]  # the log ratio of each region


def is_known(phrase: ObjectPhrase) -> bool:
    """Whether the noun says something of a shape, or claims nothing."""
    return phrase.noun is None or form_of(phrase.head) is not None or phrase.head in _SOLID | _ANYTHING


def log_ratios(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase]) -> Row:
    """For each region, the best sum over all names where it is the phrase's; a noun not known stands for itself."""
    own = _row(regions, phrase)
    others = [other for other in others if other.text != phrase.text]
    told = [other for other in others if other.colour is not None or form_of(other.head) is not None]
    names = [phrase, *told[:MAX_OTHERS]] if is_known(phrase) else [phrase]
    rows = [own, *(_row(regions, name) for name in names[1:])]
    return [ratio + _best(names, rows, ((0, at),)) if ratio > IMPOSSIBLE else ratio for at, ratio in enumerate(own)]


def _best(names: Sequence[ObjectPhrase], rows: Sequence[Row], taken: tuple[tuple[int, int], ...]) -> float:
    """The best sum over the names behind those that have `taken` a region: pairs of a name's and a region's place."""
    at = len(taken)
    if at == len(names):
        return 0.0
    best = IMPOSSIBLE
    ahead = sum(max(0.0, max(row, default=0.0)) for row in rows[at + 1 :])
    # Of more regions than there are names, the worse ones are never needed.
    for region in [*sorted(range(len(rows[at])), key=lambda region: -rows[at][region])[: len(names)], NOWHERE]:
        sharing = [_shared(names[at], names[name]) for name, other in taken if other == region != NOWHERE]
        ratio = UNSEEN if region == NOWHERE else rows[at][region] + sum(sharing)
        if ratio + ahead > best:
            best = max(best, ratio + _best(names, rows, (*taken, (at, region))))
    return best


def _shared(one: ObjectPhrase, other: ObjectPhrase) -> float:
    """The log ratio of one region under two names."""
    colours, forms = {one.colour, other.colour} - {None}, {form_of(one.head), form_of(other.head)} - {None}
    return SHARED if len(colours) < 2 and len(forms) < 2 else IMPOSSIBLE


def is_poor(region: Region, phrase: ObjectPhrase) -> bool:
    """Whether no colour says for certain that a region is meant, and its outline speaks against that."""
    return region.colour != phrase.colour and _shape_ratio(region, phrase) < POOR


def is_clear(region: Region, phrase: ObjectPhrase) -> bool:
    """Whether a region is what a noun names, whatever else is there."""
    return _shape_ratio(region, phrase) > CLEAR


def _row(regions: Sequence[Region], phrase: ObjectPhrase) -> Row:
    return [_shape_ratio(region, phrase) + _colour_ratio(region, phrase) for region in regions]


def _colour_ratio(region: Region, phrase: ObjectPhrase) -> float:
    if phrase.colour is None:
        return 0.0
    if region.colour == phrase.colour:
        return EXACT
    return NEAR if phrase.colour in region.colours else IMPOSSIBLE


def _shape_ratio(region: Region, phrase: ObjectPhrase) -> float:
    """By outline; one that the border cuts says less."""
    form = form_of(phrase.head)
    if form is None or not _can_be(region, phrase):
        return 0.0 if _can_be(region, phrase) else IMPOSSIBLE
    return (CUT if is_cut(region) else 1.0) * min(SURE, max(LEAST, log_ratio(region, form)))


def _can_be(region: Region, phrase: ObjectPhrase) -> bool:
    """Whether a region is round where the noun names something round, and not where it does not."""
    form = form_of(phrase.head)
    if form == "ball":
        return region.roundness >= (ROUND if phrase.colour is None else NOT_ROUND)
    return not region.is_disc or (form is None and phrase.head not in _SOLID)
