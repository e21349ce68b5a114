"""Which region of a scene a phrase is about: by its name and by where it says that the thing is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.errors import CannotGround
from cow_service.physics.bodies import SeenBody, supports_of
from cow_service.readers.embedded.english.noun_phrases import TABLES
from cow_service.readers.embedded.english.tokens import ObjectPhrase
from cow_service.readers.embedded.naming import CLEARLY_WORSE, IMPOSSIBLE, is_clear, is_poor, log_ratios
from cow_service.readers.embedded.singling import at_place, singled_out
from cow_service.records import BBox
from cow_service.vision.regions import Region
from cow_service.vision.scene import Scene

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
