"""What a warning says of things that were found, but may not be what the question calls them."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.readers.embedded.english.tokens import ObjectPhrase
from cow_service.readers.embedded.naming import is_known
from cow_service.readers.embedded.outlines import contradicts
from cow_service.records import BBox
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU
from cow_service.vision.scene import Scene


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
