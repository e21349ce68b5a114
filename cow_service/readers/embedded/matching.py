"""Which region of a scene a phrase is about: by its name and by where it says that the thing is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.errors import CannotGround
from cow_service.physics.bodies import SeenBody, supports_of
from cow_service.readers.embedded.english.asked import read_alternatives, read_asked
from cow_service.readers.embedded.english.lexicon import ObjectPhrase, words
from cow_service.readers.embedded.english.noun_phrases import TABLES
from cow_service.readers.embedded.english.nouns import (
    Kind,
    container_form,
    is_cube,
    is_vehicle,
    kind_of,
    may_name,
    shape_of,
)
from cow_service.readers.embedded.english.questions import Question
from cow_service.readers.embedded.outlines import contradicts, form_of, is_cut, log_ratio
from cow_service.readers.options import plain
from cow_service.readers.remedies import GIVE_OBJECT
from cow_service.records import BBox, LocatedObject, ObjectPrior
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU, Region
from cow_service.vision.scene import Scene

LEAD = 0.25  # of the mean size of the regions: so far ahead of the next one in place
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
            return _first(regions, _PLACES[word], LEAD * _size(regions))
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
    lead = LEAD * _size(regions)
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


WHOLE = 0.7  # share of a region that must lie inside a drawn box to be the thing in it


def best_matches(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase] = ()) -> list[Region]:
    """Regions that fit a phrase, all about equally well, also in where it says that the thing is.

    `others` are the further names of the question: they have regions of their own.
    """
    place = phrase.place
    if place is None:
        return _fitting(regions, phrase, others)
    beside = None if place.of is None else match_one(regions, place.of)
    left = [region for region in regions if region is not beside]
    others = [other for other in others if beside is None or other != place.of]
    fitting = _fitting(left, replace(phrase, place=None), others)
    if len(fitting) < 2 or (place.of is not None and beside is None):
        return fitting
    return at_place(fitting, place.relation, beside)


def _fitting(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase]) -> list[Region]:
    """Regions that fit a phrase about as well as the best does, where the other phrases have theirs."""
    tables = _tables(regions) if phrase.head in TABLES else []
    return singled_out(_foremost(tables or regions, phrase, others), phrase)


def _tables(regions: Sequence[Region]) -> list[Region]:
    """Regions that others stand on."""
    bodies = [SeenBody(region.colour, region.bbox, region.mask, "box") for region in regions]
    return [regions[i] for i in dict.fromkeys(supports_of(bodies)) if i is not None]


def _foremost(
    regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase], count: int = 1
) -> list[Region]:
    """The so many regions that fit a phrase best, and those not clearly worse than the last of them."""
    ratios = log_ratios(regions, phrase, others)
    ranked = sorted((ratio for ratio in ratios if ratio > IMPOSSIBLE), reverse=True)
    least = ranked[min(count, len(ranked)) - 1] - CLEARLY_WORSE if ranked else 0.0
    fitting = [region for region, ratio in zip(regions, ratios, strict=True) if ratio > max(IMPOSSIBLE, least)]
    return [] if all(is_poor(region, phrase) for region in fitting) else fitting


def match_one(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase] = ()) -> Region | None:
    """The one region that fits a phrase; None where none or several do."""
    fitting = best_matches(regions, phrase, others)
    return fitting[0] if len(fitting) == 1 else None


def match_both(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase]) -> list[Region]:
    """The two regions that fit a phrase such as "both mugs"; empty where it is not clear which two."""
    return match_some(regions, phrase, others, 2)


def match_some(
    regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase], count: int
) -> list[Region]:
    """The so many regions that fit a phrase; empty where it is not clear which."""
    fitting = _foremost(regions, phrase, others, count)
    return fitting if len(fitting) == count else []


def match_all(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase]) -> list[Region]:
    """All regions that fit a phrase such as "mugs"; empty where it is not clear of each whether it is one."""
    fitting = _foremost(regions, phrase, others)
    return fitting if all(is_clear(region, phrase) for region in fitting) else []


def inside_drawn_box(scene: Scene, phrase: ObjectPhrase, remedy: str) -> BBox:
    """The object inside the only box drawn over the image."""
    if len(scene.boxes) != 1:
        count = f"{len(scene.boxes)} boxes" if scene.boxes else "no box"
        raise CannotGround(f"Looked for '{phrase.text}' inside a drawn box, but the image shows {count}. {remedy}")
    x0, y0, x1, y1 = scene.boxes[0].bbox
    inside = np.zeros((scene.height, scene.width), bool)
    inside[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1] = True
    held = [r for r in scene.regions if r.mask.shared_with(inside) > WHOLE * r.mask.area]
    if phrase.colour is not None:
        held = best_matches(held, phrase)
    return max(held, key=lambda region: region.mask.area).bbox if held else scene.boxes[0].bbox


def describe(regions: Sequence[Region]) -> str:
    """What was seen, in words, for an error message."""
    if not regions:
        return "nothing"
    named = [f"{region.colour} at ({region.centre[0]:.0f}, {region.centre[1]:.0f})" for region in regions[:8]]
    more = len(regions) - len(named)
    return ", ".join(named) + (f" and {more} more" if more > 0 else "")


def things_of_kinds(
    regions: Sequence[Region], question: Question, mover: BBox, given: Sequence[LocatedObject]
) -> tuple[LocatedObject, ...]:
    """Those of the regions, but for the mover's, each under its colour; none of a kind that the caller has `given`.

    Raises `CannotGround`.
    """
    asked, found = read_asked(question), list[LocatedObject]()
    left = [region for region in regions if iou(region.bbox, mover) < SAME_OBJECT_IOU]
    for name in () if asked is None else asked.among:
        kind = kind_of(name)
        if kind is None or any(may_name(kind.phrase, each.object) for each in given):
            continue
        fitting = _of_kind(left, kind, [other for other in question.others if not is_kind_asked(other, question)])
        if not fitting:
            raise CannotGround(
                f"The question asks about '{name}', and which things those are the image does not tell for certain. "
                f"Seen: {describe(regions)}. {GIVE_OBJECT}"
            )
        found += _named(fitting, kind)
    return (*found, *_alternatives(left, question, given))


def _alternatives(regions: Sequence[Region], question: Question, given: Sequence[LocatedObject]) -> list[LocatedObject]:
    """Those of the kind in "which mug does it hit first"; none where the image does not tell which those are."""
    asked, found = read_asked(question), list[LocatedObject]()
    for phrase in read_alternatives(question):
        kind = kind_of(phrase.text) or Kind(phrase, None)
        listed = asked is None or phrase.text in asked.among or phrase.colour is not None or kind.phrase.head is None
        if not listed and not any(may_name(kind.phrase, each.object) for each in given):
            found += _named(_of_kind(regions, kind, ()), kind)
    return found


def _named(regions: Sequence[Region], kind: Kind) -> list[LocatedObject]:
    names = [f"{region.colour} {kind.phrase.head}" for region in regions]
    return [
        LocatedObject(object=name, bbox=region.bbox, source="embedded")
        for name, region in zip(names, regions, strict=True)
    ]


def _of_kind(regions: Sequence[Region], kind: Kind, others: Sequence[ObjectPhrase]) -> list[Region]:
    """The regions of a kind; none where others may be of it, too, or where they are not as many as is said."""
    if kind.count is not None:
        return match_some(regions, kind.phrase, others, kind.count)
    return match_all(regions, kind.phrase, others)


def is_kind_asked(phrase: ObjectPhrase, question: Question) -> bool:
    """Whether a phrase is that of a kind asked about, and of no one thing."""
    asked = read_asked(question)
    return asked is not None and any(kind_of(name) and name.endswith(phrase.text.lower()) for name in asked.among)


def noun_warnings(scene: Scene, found: Sequence[tuple[ObjectPhrase, BBox]]) -> list[str]:
    """A warning for each thing whose noun is not known, or whose outline is not that of the noun."""
    warnings: list[str] = []
    for phrase, bbox in found:
        region = next((each for each in scene.regions if iou(each.bbox, bbox) >= SAME_OBJECT_IOU), None)
        if region is None or phrase.inside_box:
            continue
        place = f"{region.colour} at ({region.centre[0]:.0f}, {region.centre[1]:.0f})"
        if not is_known(phrase):
            warnings.append(
                f"'{phrase.text}' was taken for what is {place}: whether '{phrase.head}' is right, the embedded reader "
                "cannot tell."
            )
        elif contradicts(region, phrase.head):
            warnings.append(f"'{phrase.text}' was taken for what is {place}, which does not look like '{phrase.head}'.")
    return warnings


def read_name(name: str) -> ObjectPrior:
    """What a noun says of a thing's shape."""
    opening = container_form(name)
    return ObjectPrior(
        shape=shape_of(name),
        elongated=is_vehicle(name),
        equal_sided=is_cube(name),
        opening=None if opening == "unknown" else opening,
    )


def names_meant(words: str, names: Sequence[str]) -> tuple[str, ...]:
    """Those of a kind such as "both mugs", where there are as many as is said; else the words themselves."""
    kind = kind_of(words)
    if kind is None or any(plain(name) == plain(words) for name in names):
        return (words,)
    found = tuple(name for name in names if may_name(kind.phrase, name))
    return found if found and kind.count in (None, len(found)) else (words,)
