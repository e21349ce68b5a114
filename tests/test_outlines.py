"""Of several things of one colour, the noun's outline decides where it clearly can."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn import Image, block, floor, jpeg

from cow_service.readers.embedded.matching import best_matches, match_one
from cow_service.readers.question.sentences import parse_noun_phrase
from cow_service.vision.regions import Region, find_regions

PURPLE = (120, 60, 170)
HALF_WIDTHS = {  # at equal steps from the upper end
    "bottle": (8, 8, 14, 26, 26, 26, 26, 26),
    "vase": (30, 28, 16, 16, 28, 34, 32, 22),
    "cone": (1, 6, 12, 18, 24, 30, 36, 40),
}


def turned(image: Image, middle: int, noun: str) -> Image:
    """Something turned on a lathe, 130 px high."""
    heights = np.linspace(150, 280, len(HALF_WIDTHS[noun]))
    right = [(middle + half, y) for half, y in zip(HALF_WIDTHS[noun], heights, strict=True)]
    left = [(middle - half, y) for half, y in zip(HALF_WIDTHS[noun], heights, strict=True)]
    cv2.fillPoly(image, [np.array([*right, *left[::-1]]).round().astype(np.int32)], PURPLE, cv2.LINE_AA)
    return image


def matches(regions: tuple[Region, ...], text: str) -> list[int]:
    phrase = parse_noun_phrase(text)
    assert phrase is not None
    return sorted(round(region.centre[0]) for region in best_matches(regions, phrase))


@pytest.mark.parametrize("noun", sorted(HALF_WIDTHS))
@pytest.mark.parametrize("other", sorted(HALF_WIDTHS))
def test_two_of_one_colour_are_told_apart_by_outline(noun: str, other: str) -> None:
    regions = find_regions(jpeg(turned(turned(floor(), 200, noun), 440, other)))
    assert len(regions) == 2
    for text in (f"the purple {noun}", f"the {noun}"):
        found = matches(regions, text)
        assert found == pytest.approx([200] if noun != other else [200, 440], abs=2)


def test_an_outline_that_both_could_have_or_the_border_cuts_decides_nothing() -> None:
    cubes = block(block(floor(), (150, 150, 250, 250), PURPLE), (400, 160, 480, 250), PURPLE)
    cut = turned(turned(floor(), 200, "bottle"), 620, "vase")
    for image, text in ((cubes, "the purple mug"), (cut, "the purple bottle")):
        phrase = parse_noun_phrase(text)
        assert phrase is not None
        assert match_one(find_regions(jpeg(image)), phrase) is None
