"""Which of several regions a phrase singles out by its place or size: "the ball on the left", "the largest cube"."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cow_service.readers.embedded.english.tokens import ObjectPhrase
from cow_service.vision.regions import Region

CLEAR = 0.25  # of the mean size of the regions: so far ahead of the next one in place
LARGER = 1.2  # ratio of areas to the next one

# Which of x of the centre, y of the centre and y of the lower end is the largest, or with -1 the smallest.
_MEASURES: dict[str, tuple[int, int]] = {
    "left leftmost left-hand": (0, -1),
    "right rightmost right-hand": (0, 1),
    "top topmost upper highest uppermost": (1, -1),
    "bottom lower lowest bottommost": (1, 1),
    "front nearest closest foreground": (2, 1),
    "back rear farthest furthest background": (2, -1),
}
_PLACES = {word: measure for words, measure in _MEASURES.items() for word in words.split()}
_LARGE = frozenset({"large", "largest", "big", "biggest", "larger", "bigger", "tallest", "taller", "tall", "huge"})
_SMALL = frozenset({"small", "smallest", "smaller", "little", "tiny", "shortest", "shorter", "short"})
_MIDDLE = frozenset({"middle", "center", "centre", "central"})


def singled_out(regions: Sequence[Region], phrase: ObjectPhrase) -> list[Region]:
    """The one region that the words of place or size mean; all of them where these do not decide."""
    words = phrase.text.lower().replace("-", " ").split()
    for word in words if len(regions) > 1 else []:
        if word in _PLACES:
            return _first(regions, _PLACES[word], CLEAR * _size(regions))
        if word in _MIDDLE and len(regions) % 2:
            return [sorted(regions, key=lambda region: region.centre[0])[len(regions) // 2]]
        if word in _LARGE | _SMALL:
            sign = 1 if word in _LARGE else -1
            ordered = sorted(regions, key=lambda region: -sign * region.mask.area)
            ratio = (ordered[0].mask.area / ordered[1].mask.area) ** sign
            return [ordered[0]] if ratio >= LARGER else list(regions)
    return list(regions)


def at_place(regions: Sequence[Region], relation: str, beside: Region | None) -> list[Region]:
    """The one region that is where a relation to another region says; all of them where that does not decide.

    Without another region the relation is to the camera: what is lower in the image is nearer.
    """
    lead = CLEAR * _size(regions)
    if beside is None:
        return _first(regions, (2, -1 if relation == "far" else 1), lead)
    x, y = beside.centre
    possible = [region for region in regions if _is_there(region, relation, beside)]
    if len(possible) < 2:
        return possible
    sign = -1 if relation == "far" else 1
    ranked = sorted(possible, key=lambda region: sign * math.dist(region.centre, (x, y)))
    gap = abs(math.dist(ranked[1].centre, (x, y)) - math.dist(ranked[0].centre, (x, y)))
    return ranked[:1] if gap >= lead else possible


def _is_there(region: Region, relation: str, beside: Region) -> bool:
    """Whether a region is on the side of another one that a relation names; near and far are on every side."""
    (x, y), (x0, _, x1, y1) = beside.centre, beside.bbox
    own_x, own_y = region.centre
    overlaps = region.bbox[0] < x1 and region.bbox[2] > x0
    sides = {
        "behind": overlaps and region.bbox[3] < y1, "front_of": overlaps and region.bbox[3] > y1,
        "left_of": own_x < x, "right_of": own_x > x,
        "above": own_y < y and x0 < own_x < x1, "on": own_y < y and x0 < own_x < x1,
        "below": own_y > y and x0 < own_x < x1,
    }  # fmt: skip
    return sides.get(relation, True)


def _first(regions: Sequence[Region], measure: tuple[int, int], lead: float) -> list[Region]:
    which, sign = measure
    ranked = sorted(regions, key=lambda region: -sign * _places(region)[which])
    ahead = abs(_places(ranked[0])[which] - _places(ranked[1])[which])
    return [ranked[0]] if ahead >= lead else list(regions)


def _places(region: Region) -> tuple[float, float, float]:
    return *region.centre, region.bbox[3]


def _size(regions: Sequence[Region]) -> float:
    """The mean side of the regions, px."""
    return sum((r.bbox[2] - r.bbox[0] + r.bbox[3] - r.bbox[1]) / 2 for r in regions) / len(regions)
