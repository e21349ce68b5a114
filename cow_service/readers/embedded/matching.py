"""Which region of a scene a phrase is about: by its name and by where it says that the thing is."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cow_service.errors import CannotGround
from cow_service.physics.bodies import SeenBody, supports_of
from cow_service.readers.base import SeenThing
from cow_service.readers.embedded.english.lexicon import SOLID_NOUNS, TABLES, ObjectPhrase, like_a_colour, words
from cow_service.readers.embedded.english.noun_phrases import Kind, kind_of, may_name, parse_noun_phrase, shape_of
from cow_service.readers.embedded.english.questions import Question
from cow_service.readers.remedies import GIVE_OBJECT, GIVE_PLACE
from cow_service.records import BBox, LocatedObject
from cow_service.vision.forms import form_of, is_cut, is_other_kind, is_unlike, log_ratio, looks_like
from cow_service.vision.masks import is_same_object, mask_iou
from cow_service.vision.regions import Region
from cow_service.vision.scene import Scene
from cow_service.vision.types import Mask

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
    (x, y), (x0, _, x1, y1) = beside.centre, beside.bbox
    # On the side that the relation names; near and far are on every side.
    sides: dict[str, Callable[[Region], bool]] = {
        "behind": lambda region: region.bbox[0] < x1 and region.bbox[2] > x0 and region.bbox[3] < y1,
        "front_of": lambda region: region.bbox[0] < x1 and region.bbox[2] > x0 and region.bbox[3] > y1,
        "left_of": lambda region: region.centre[0] < x,
        "right_of": lambda region: region.centre[0] > x,
        "above": lambda region: region.centre[1] < y and x0 < region.centre[0] < x1,
        "on": lambda region: region.centre[1] < y and x0 < region.centre[0] < x1,
        "below": lambda region: region.centre[1] > y and x0 < region.centre[0] < x1,
    }
    possible = [region for region in regions if relation not in sides or sides[relation](region)]
    if len(possible) < 2:
        return possible
    sign = -1 if relation == "far" else 1
    ranked = sorted(possible, key=lambda region: sign * math.dist(region.centre, (x, y)))
    gap = abs(math.dist(ranked[1].centre, (x, y)) - math.dist(ranked[0].centre, (x, y)))
    return ranked[:1] if gap >= lead else possible


def _first(regions: Sequence[Region], measure: tuple[int, int], lead: float) -> list[Region]:
    """The region that is first by one of `_MEASURES`; all of them where it has no clear lead."""
    which, sign = measure
    ranked = sorted(((*region.centre, region.bbox[3])[which] * -sign, i) for i, region in enumerate(regions))
    ahead = ranked[1][0] - ranked[0][0]
    return [regions[ranked[0][1]]] if ahead >= lead else list(regions)


def _size(regions: Sequence[Region]) -> float:
    """The mean side of the regions, px."""
    return sum((r.bbox[2] - r.bbox[0] + r.bbox[3] - r.bbox[1]) / 2 for r in regions) / len(regions)


CLEARLY_WORSE = 2.5  # log ratio: what is so much less likely than the best, twelve times, is not meant
EXACT, NEAR = 6.0, 3.0  # log ratios of the name of a region's colour, and of others that people may use for it
SURE = CLEARLY_WORSE  # log ratio of an outline: capped, so that other candidates remain rivals
LEAST = -2.0  # log ratio of an outline: lowest evidence against it
CUT = 0.5  # share of its log ratio that an outline keeps which the border cuts
CLEAR = 1.0  # log ratio of an outline from which one of several is called so
POOR = -1.0  # log ratio of an outline: with less it is not called so, unless by its colour
UNSEEN = -6.0  # log ratio of a name to which no region is assigned
SHARED = -3.0  # log ratio of a region with two names of the same kind
ROUND = 0.76  # roundness from which a region passes for a ball; a cube has about 0.7
NOT_ROUND = 0.6  # roundness below which nothing passes for a ball, even half hidden
MAX_OTHERS = 5  # names that are assigned together with one: the work grows fast with their number
CALLED, NOT_CALLED = 3.0, -2.0  # log ratios if a detector found the noun: for its finds, for the rest
IMPOSSIBLE = -math.inf
NOWHERE = -1  # place of the region of a name that has none

_ANYTHING = words("object thing item shape one")

Row = list[float]  # the log ratio of each region


def is_known(phrase: ObjectPhrase) -> bool:
    """Whether the noun says something of a shape, or claims nothing."""
    return phrase.noun is None or form_of(phrase.head) is not None or phrase.head in SOLID_NOUNS | _ANYTHING | TABLES


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
        ratio = UNSEEN if region == NOWHERE else rows[at][region]
        for other in (names[name] for name, other in taken if other == region != NOWHERE):
            # One region under two names.
            colours = {names[at].colour, other.colour} - {None}
            forms = {form_of(names[at].head), form_of(other.head)} - {None}
            ratio += SHARED if len(colours) < 2 and len(forms) < 2 else IMPOSSIBLE
        if ratio + ahead > best:
            best = max(best, ratio + _best(names, rows, (*taken, (at, region))))
    return best


def _row(regions: Sequence[Region], phrase: ObjectPhrase) -> Row:
    row: Row = []
    is_found = any(phrase.noun in region.called for region in regions)
    for region in regions:
        if phrase.colour is None:
            colour = 0.0
        elif region.colour == phrase.colour:
            colour = EXACT
        else:
            colour = NEAR if phrase.colour in region.colours else IMPOSSIBLE
        shape, is_called = _shape_ratio(region, phrase), phrase.noun in region.called
        if is_called:  # outlines of real things are of many forms
            shape = max(shape, LEAST)
        row.append(shape + colour + (CALLED if is_called else NOT_CALLED if is_found else 0.0))
    return row


def _shape_ratio(region: Region, phrase: ObjectPhrase) -> float:
    """By outline; one that the border cuts says less."""
    form = form_of(phrase.head)
    # A region is round where the noun names something round, and not where it does not.
    can_be = not region.is_disc or (form is None and phrase.head not in SOLID_NOUNS)
    if form == "ball":
        can_be = region.is_hidden or region.roundness >= (ROUND if phrase.colour is None else NOT_ROUND)
    if form is None or not can_be:
        return 0.0 if can_be else IMPOSSIBLE
    return (CUT if is_cut(region, form) else 1.0) * min(SURE, max(LEAST, log_ratio(region, form)))


SAME = 0.7  # IoU from which two masks are one thing's
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
    tables: list[Region] = []
    if phrase.head in TABLES:  # what others stand on
        bodies = [SeenBody(region.colour, region.bbox, region.mask, "box") for region in regions]
        tables = [regions[i] for i in dict.fromkeys(supports_of(bodies)) if i is not None]
    return singled_out(_foremost(tables or regions, phrase, others), phrase)


def _foremost(
    regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase], count: int = 1
) -> list[Region]:
    """The given number of regions that fit a phrase best, and those not clearly worse than the last of them."""
    ratios = log_ratios(regions, phrase, others)
    ranked = sorted((ratio for ratio in ratios if ratio > IMPOSSIBLE), reverse=True)
    least = ranked[min(count, len(ranked)) - 1] - CLEARLY_WORSE if ranked else 0.0
    fitting = [region for region, ratio in zip(regions, ratios, strict=True) if ratio > max(IMPOSSIBLE, least)]
    # A thing is meant by positive evidence alone: a detector called it so, its outline is that of the noun, or it has
    # the colour and is not clearly another kind of thing. What is merely left is not meant.
    is_sure = not says_nothing(phrase, fitting) and any(
        phrase.noun in each.called
        or _shape_ratio(each, phrase) >= POOR
        or (each.colour == phrase.colour and not is_other_kind(each, phrase.head))
        for each in fitting
    )
    return fitting if is_sure else []


def match_one(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase] = ()) -> Region | None:
    """The one region that fits a phrase; None if none or several do."""
    fitting = best_matches(regions, phrase, others)
    return fitting[0] if len(fitting) == 1 else None


def unclear(phrase: ObjectPhrase, fitting: Sequence[Region], regions: Sequence[Region]) -> str:
    """Why not one region is what a phrase names, for a message."""
    if phrase.colour is None and not is_known(phrase) and not phrase.is_other:
        return f"'{phrase.text}' names no colour and no shape that is known here. Seen: {describe(regions)}"
    if len(fitting) > 1:
        what = "its place" if phrase.colour else "its colour or its place"
        return f"'{phrase.text}' may be any of {len(fitting)}: {describe(fitting)}. Name {what}"
    return f"'{phrase.text}' was not found, or not for certain. Seen: {describe(regions)}"


def says_nothing(phrase: ObjectPhrase, fitting: Sequence[Region]) -> bool:
    """Whether a phrase fits regions because nothing is known of its noun, and it names no colour."""
    called = any(phrase.noun in each.called for each in fitting)
    return phrase.colour is None and not is_known(phrase) and not called


def match_several(
    regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase], count: int | None
) -> list[Region]:
    """The regions that fit a phrase such as "both mugs", as many as it says, or all; empty if it is not clear which."""
    fitting = _foremost(regions, phrase, others, count or 1)
    is_clear = len(fitting) == count
    if count is None:
        is_clear = all(_shape_ratio(region, phrase) > CLEAR for region in fitting)
    return fitting if is_clear else []


def inside_drawn_box(scene: Scene, phrase: ObjectPhrase) -> BBox:
    """The object inside the only box drawn over the image."""
    if len(scene.boxes) != 1:
        count = f"{len(scene.boxes)} boxes" if scene.boxes else "no box"
        told = f"Looked for '{phrase.text}' inside a drawn box, but the image shows {count}."
        raise CannotGround(told, remedy=GIVE_PLACE)
    x0, y0, x1, y1 = scene.boxes[0].bbox
    inside = np.zeros((scene.height, scene.width), bool)
    inside[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1] = True
    held = [r for r in scene.regions if r.mask.shared_with(inside) > WHOLE * r.mask.area]
    if phrase.colour is not None:
        held = best_matches(held, phrase)
    return max(held, key=lambda region: region.mask.area).bbox if held else scene.boxes[0].bbox


TOP, LEGS = 0.05, 0.8  # of its height: a drawn table is as broad as it is at the one, and stands on legs at the other


def table_among(regions: Sequence[Region]) -> Region | None:
    """The one region of a drawing seen from the side that has legs; None if none or several have."""
    rows = [(each, *(each.mask.patch[int(at * len(each.mask.patch))] for at in (TOP, LEGS))) for each in regions]
    found = [each for each, top, low in rows if top.mean() > LEGS and np.count_nonzero(np.diff(low, prepend=0) > 0) > 1]
    return found[0] if len(found) == 1 else None


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
    asked, found = question.asked, list[LocatedObject]()
    among = () if asked is None else asked.among
    left = [region for region in regions if not is_same_object(region.bbox, mover)]
    for name in among:
        kind = kind_of(name)
        if kind is None or any(may_name(kind.phrase, each.object) for each in given):
            continue
        others = [other for other in question.others if not is_kind_asked(other, question)]
        fitting = match_several(left, kind.phrase, others, kind.count)
        if not fitting:
            raise CannotGround(
                f"The question asks about '{name}', and which things those are the image does not tell for certain. "
                f"Seen: {describe(regions)}.",
                remedy=GIVE_OBJECT,
            )
        found += _named(fitting, kind)
    # Those of the kind in "which mug does it hit first"; none where the image does not tell which those are.
    for phrase in question.alternatives:
        kind = kind_of(phrase.text) or Kind(phrase, None)
        listed = asked is None or phrase.text in among or phrase.colour is not None or kind.phrase.head is None
        if not listed and not any(may_name(kind.phrase, each.object) for each in given):
            found += _named(match_several(left, kind.phrase, (), kind.count), kind)
    return tuple(found)


def _named(regions: Sequence[Region], kind: Kind) -> list[LocatedObject]:
    head = kind.phrase.head
    return [LocatedObject(object=f"{each.colour} {head}", bbox=each.bbox, source="embedded") for each in regions]


def is_kind_asked(phrase: ObjectPhrase, question: Question) -> bool:
    """Whether a phrase is that of a kind asked about, and of no one thing."""
    asked = question.asked
    return asked is not None and any(kind_of(name) and name.endswith(phrase.text.lower()) for name in asked.among)


def nouns_of(question: Question, sought: Sequence[str] = ()) -> tuple[str, ...]:
    """The nouns of the things that a question names, and of further words, each once."""
    changed = (each for change in question.changes for each in (change.object, *change.targets))
    asked = question.asked
    kinds = (kind_of(name) for name in (() if asked is None else asked.among))
    named = (question.mover, *question.others, *changed, *map(parse_noun_phrase, sought))
    phrases = [each for each in named if each is not None]
    phrases += [each.place.of for each in phrases if each.place is not None and each.place.of is not None]
    phrases += [kind.phrase for kind in kinds if kind is not None]
    return tuple(dict.fromkeys(each.noun for each in phrases if each.noun))


def with_found(scene: Scene, found: Sequence[SeenThing]) -> Scene:
    """The scene with what models found by its nouns; one thing under two of them is one thing."""
    things: list[tuple[Mask, frozenset[str]]] = []
    for seen in found:
        twin = next((at for at, (mask, _) in enumerate(things) if mask_iou(mask, seen.mask) > SAME), None)
        if twin is None:
            things.append((seen.mask, frozenset((seen.noun,))))
        else:
            things[twin] = things[twin][0], things[twin][1] | {seen.noun}
    return scene.with_found(things)


def noun_doubts(scene: Scene, found: Sequence[tuple[ObjectPhrase, BBox]]) -> tuple[list[str], frozenset[BBox]]:
    """A warning for each thing whose noun is not known, or whose outline is not that of the noun; and the boxes of
    those that look like something else, of which nothing is sure."""
    warnings, doubtful = list[str](), set[BBox]()
    for phrase, bbox in found:
        region = scene.region_of(bbox)
        if region is None or phrase.inside_box or phrase.noun in region.called:
            continue
        elsewhere = any(phrase.noun in each.called for each in scene.regions)
        place = f"{region.colour} at ({region.centre[0]:.0f}, {region.centre[1]:.0f})"
        # What cannot be told by its outline is believed, unless the thing is clearly one of another kind.
        head, looks, own = phrase.head or "", looks_like(region), form_of(phrase.head)
        # Where no colour tells that it is meant, its outline alone does.
        is_odd = own is not None and (is_unlike(region, own) or (phrase.colour is None and looks not in (None, own)))
        is_other = is_odd if own is not None else shape_of(head) != shape_of(looks or "")
        colour = None if phrase.colour else like_a_colour(phrase.text)
        if colour is not None:
            reason = f": '{colour}' is no colour that is known."
        elif elsewhere and _shape_ratio(region, phrase) <= CLEAR:  # a detector misses some
            reason = ": the detector calls another thing so."
        elif looks is not None and is_other and phrase.noun is not None and head not in _ANYTHING:
            reason = f", which looks like a {looks}, not '{head}'."
        elif is_odd:
            reason = f", which does not look like '{head}'."
        elif not is_known(phrase):
            reason = f": whether '{phrase.head}' is right, the embedded reader cannot tell."
        else:
            continue
        warnings.append(f"'{phrase.text}' was taken for what is {place}{reason}")
        doubtful.add(bbox)
    return warnings, frozenset(doubtful)
