"""Which region of a scene a phrase is about: by colour, and by the little that a noun says of a shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.errors import CannotGround
from cow_service.readers.embedded.outlines import clearest, contradicts
from cow_service.readers.embedded.singling import at_place, singled_out
from cow_service.readers.question.phrases import ObjectPhrase
from cow_service.records import BBox
from cow_service.vision.regions import Region
from cow_service.vision.scene import Scene

ROUND_NOUNS = frozenset({"ball", "sphere", "orb", "marble", "basketball", "football", "baseball", "balloon", "globe"})
SOLID_NOUNS = frozenset(
    {"cube", "box", "block", "brick", "cuboid", "cylinder", "cone", "pyramid", "bottle", "vase", "mug", "cup", "glass"}
    | {"jar", "can", "candle", "car", "truck", "bus", "train", "chair", "book", "lamp", "robot", "pencil", "pen"}
)
ANYTHING = frozenset({"object", "thing", "item", "shape", "one"})
ROUND = 0.76  # roundness from which a region passes for a ball; a cube has about 0.7
NOT_ROUND = 0.6  # roundness below which nothing passes for a ball, even half hidden
WHOLE = 0.7  # share of a region that must lie inside a drawn box to be the thing in it


def best_matches(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase] = ()) -> list[Region]:
    """Regions that fit a phrase, all equally well, also in where it says that the thing is."""
    place = phrase.place
    if place is None:
        return _fitting(regions, phrase, others)
    beside = None if place.of is None else match_one(regions, place.of)
    left = [region for region in regions if region is not beside]
    fitting = _fitting(left, replace(phrase, place=None), others)
    if len(fitting) < 2 or (place.of is not None and beside is None):
        return fitting
    return at_place(fitting, place.relation, beside)


def _fitting(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase]) -> list[Region]:
    """Regions that fit a phrase, all equally well; those that the other phrases claim by colour are left out.

    Where several fit, and the outline of one is clearly the noun's, that one is taken.
    """
    possible = [region for region in regions if _can_be(region, phrase)]
    if phrase.colour is None:
        claimed = {other.colour for other in others if other.colour is not None}
        fitting = [region for region in possible if region.colour not in claimed]
    else:
        claimed = {other.colour for other in others} - {phrase.colour}
        exact = [region for region in possible if region.colour == phrase.colour]
        near = [region for region in possible if phrase.colour in region.colours and region.colour not in claimed]
        fitting = exact or [region for region in near if _looks_like(region, phrase)]
    fitting = [region for region in fitting if _looks_like(region, phrase)] or fitting
    if phrase.colour is None:
        fitting = [region for region in fitting if not contradicts(region, phrase.head)] or fitting
    return clearest(fitting, phrase.head) or singled_out(fitting, phrase)


def match_one(regions: Sequence[Region], phrase: ObjectPhrase) -> Region | None:
    """The one region that fits a phrase; None where none or several do, or where only its noun speaks against it."""
    fitting = best_matches(regions, phrase)
    if len(fitting) != 1 or (phrase.colour is None and contradicts(fitting[0], phrase.head)):
        return None
    return fitting[0]


def match_both(regions: Sequence[Region], phrase: ObjectPhrase) -> list[Region]:
    """The two regions that fit a phrase such as "both mugs"; empty where it is not clear which two."""
    fitting = best_matches(regions, phrase)
    return fitting if len(fitting) == 2 else clearest(fitting, phrase.head, 2)


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


def is_known(phrase: ObjectPhrase) -> bool:
    """Whether the noun says something of a shape, or claims nothing."""
    return phrase.noun is None or phrase.head in ROUND_NOUNS | SOLID_NOUNS | ANYTHING


def describe(regions: Sequence[Region]) -> str:
    """What was seen, in words, for an error message."""
    if not regions:
        return "nothing"
    named = [f"{region.colour} at ({region.centre[0]:.0f}, {region.centre[1]:.0f})" for region in regions[:8]]
    more = len(regions) - len(named)
    return ", ".join(named) + (f" and {more} more" if more > 0 else "")


def _can_be(region: Region, phrase: ObjectPhrase) -> bool:
    """Whether a region's shape leaves it possible that the noun means it."""
    if phrase.head in ROUND_NOUNS:
        return region.roundness >= NOT_ROUND and (phrase.colour is not None or region.roundness >= ROUND)
    return phrase.head not in SOLID_NOUNS or not region.is_disc


def _looks_like(region: Region, phrase: ObjectPhrase) -> bool:
    """Whether a region is round where the noun names something round, and is not where it does not."""
    if phrase.head in ANYTHING or phrase.noun is None:
        return True
    return (region.roundness >= ROUND) == (phrase.head in ROUND_NOUNS)
