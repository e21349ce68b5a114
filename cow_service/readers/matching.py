"""Which region of a scene a phrase is about: by colour first, then by the little that a noun says of a shape."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.errors import CannotGround
from cow_service.readers.phrases import ObjectPhrase
from cow_service.records import BBox
from cow_service.vision.colours import agreement
from cow_service.vision.regions import Region
from cow_service.vision.scene import Scene

ROUND_NOUNS = frozenset({"ball", "sphere", "orb", "marble", "basketball", "football", "balloon", "apple", "orange"})
ROUND = 0.76  # roundness from which a region passes for a ball; a cube has about 0.7
WHOLE = 0.7  # share of a region that must lie inside a drawn box to be the thing in it


def best_matches(regions: Sequence[Region], phrase: ObjectPhrase, others: Sequence[ObjectPhrase] = ()) -> list[Region]:
    """Regions that fit a phrase, all equally well; those that the other phrases claim by colour are left out."""
    fitting = list(regions)
    if phrase.colour is not None:
        scores = [agreement(phrase.colour, region.colour) for region in fitting]
        best = max(scores, default=0.0)
        fitting = [region for region, score in zip(fitting, scores, strict=True) if score == best > 0]
        if best < 1:
            # Only a neighbouring colour: then nobody else may claim it, and the shape must speak for it.
            claimed = {other.colour for other in others}
            fitting = [r for r in fitting if r.colour not in claimed and _looks_like(r, phrase)]
    else:
        claimed = {other.colour for other in others if other.colour is not None}
        fitting = [region for region in fitting if region.colour not in claimed]
    return _by_shape(fitting, phrase)


def match_one(regions: Sequence[Region], phrase: ObjectPhrase) -> Region | None:
    """The one region that fits a phrase, or None where none or several do."""
    fitting = best_matches(regions, phrase)
    return fitting[0] if len(fitting) == 1 else None


def inside_drawn_box(scene: Scene, phrase: ObjectPhrase, remedy: str) -> BBox:
    """The object inside the only box drawn over the image."""
    if len(scene.boxes) != 1:
        count = f"{len(scene.boxes)} boxes" if scene.boxes else "no box"
        raise CannotGround(f"Looked for '{phrase.text}' inside a drawn box, but the image shows {count}. {remedy}")
    x0, y0, x1, y1 = scene.boxes[0].bbox
    held: list[Region] = []
    for region in scene.regions:
        inside = region.mask[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1].sum()
        if inside > WHOLE * region.mask.sum():
            held.append(region)
    if phrase.colour is not None:
        held = best_matches(held, phrase)
    return max(held, key=lambda region: int(region.mask.sum())).bbox if held else scene.boxes[0].bbox


def describe(regions: Sequence[Region]) -> str:
    """What was seen, in words, for an error message."""
    if not regions:
        return "nothing"
    named = [f"{region.colour} at ({region.centre[0]:.0f}, {region.centre[1]:.0f})" for region in regions[:8]]
    more = len(regions) - len(named)
    return ", ".join(named) + (f" and {more} more" if more > 0 else "")


def _by_shape(regions: list[Region], phrase: ObjectPhrase) -> list[Region]:
    """Where several fit and the noun names something round, the round ones; where it does not, the others."""
    if len(regions) < 2 or phrase.noun is None:
        return regions
    return [region for region in regions if _looks_like(region, phrase)] or regions


def _looks_like(region: Region, phrase: ObjectPhrase) -> bool:
    """Whether a region is round where the noun names something round, and is not where it does not."""
    return (region.roundness >= ROUND) == (phrase.head in ROUND_NOUNS)
