"""Of several things of one colour, the noun's outline decides where it clearly can."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from conftest import DATA
from drawn import Image, ball, block, floor, jpeg

from cow_service.media.masks import CroppedMask
from cow_service.perception.base import Thing
from cow_service.perception.classical.forms import form_of, is_unlike
from cow_service.perception.classical.regions import find_regions
from cow_service.perception.observation import look
from cow_service.physics.bodies import SeenBody
from cow_service.readers.embedded.english.lexicon import ObjectPhrase
from cow_service.readers.embedded.english.noun_phrases import parse_noun_phrase
from cow_service.readers.embedded.matching import best_matches, match_one, noun_doubts

PURPLE, GREEN = (120, 60, 170), (50, 150, 50)
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


def region_of(image: Image) -> Thing:
    (region,) = find_regions(jpeg(image))
    return region


def test_two_that_are_seen_as_one_are_unlike_either() -> None:
    """One cylinder behind another of its hue, to its left."""
    image = floor()
    image[150:240, 280:330] = GREEN
    assert not is_unlike(region_of(image), "cylinder")
    image[200:300, 310:370] = GREEN
    assert is_unlike(region_of(image), "cylinder")


def test_half_of_a_thing_may_be_a_ball_but_no_vase() -> None:
    image = block(ball(floor(), (300, 150), 32, PURPLE), (260, 145, 380, 290), GREEN)
    region = next(each for each in find_regions(jpeg(image)) if each.is_hidden)
    assert [is_unlike(region, noun) for noun in ("ball", "cylinder", "vase", "bottle")] == [False, False, True, True]


@pytest.mark.parametrize(("height", "is_odd"), [(56, False), (52, True), (38, True)])
def test_a_lit_cap_is_not_believed_to_be_the_ball(height: int, is_odd: bool) -> None:
    """Its lower part may be as light as the floor."""
    image = floor()
    seen = np.zeros(image.shape[:2], np.uint8)
    cv2.ellipse(seen, (300, 232), (32, 32), 0, 0, 360, 1, -1)
    seen[200 + height :] = 0
    image[seen > 0] = GREEN
    assert is_unlike(region_of(image), "ball") is is_odd


def test_a_squat_cylinder_seen_from_above_is_one() -> None:
    image = np.ascontiguousarray(floor())
    rims = [cv2.ellipse2Poly(middle, (40, 26), 20, 0, 360, 5) for middle in ((310, 190), (285, 240))]
    cv2.fillConvexPoly(image, cv2.convexHull(np.concatenate(rims)), GREEN, cv2.LINE_AA)
    region = region_of(image)
    nouns = ("cylinder", "can", "bottle", "cone")
    assert [is_unlike(region, form_of(noun) or "") for noun in nouns] == [False, False, True, True]


def test_without_a_colour_nothing_is_meant_that_looks_like_something_else() -> None:
    scene = look(np.ascontiguousarray(cv2.imread(str(DATA / "wordings" / "bottles.jpg"))[..., ::-1]))
    bottle = next(each for each in scene.things if each.colour == "pink")
    doubted = [bool(noun_doubts(scene, [(phrase_of(text), bottle.bbox)])[1]) for text in ("the candle", "the bottle")]
    assert doubted == [True, False]


def phrase_of(text: str) -> ObjectPhrase:
    phrase = parse_noun_phrase(text)
    assert phrase is not None
    return phrase


def matches(regions: tuple[Thing, ...], text: str) -> list[int]:
    return sorted(round(region.centre[0]) for region in best_matches(regions, phrase_of(text)))


@pytest.mark.parametrize("noun", sorted(HALF_WIDTHS))
@pytest.mark.parametrize("other", sorted(HALF_WIDTHS))
def test_two_of_one_colour_are_told_apart_by_outline(noun: str, other: str) -> None:
    regions = find_regions(jpeg(turned(turned(floor(), 200, noun), 440, other)))
    assert len(regions) == 2
    for text in (f"the purple {noun}", f"the {noun}"):
        assert matches(regions, text) == pytest.approx([200] if noun != other else [200, 440], abs=2)


def test_an_outline_that_both_could_have_decides_nothing() -> None:
    cubes = block(block(floor(), (150, 150, 250, 250), PURPLE), (400, 160, 480, 250), PURPLE)
    twins = turned(turned(floor(), 200, "bottle"), 625, "bottle")  # the image's border cuts one
    for image, text in ((cubes, "the purple mug"), (twins, "the purple bottle"), (twins, "the bottle")):
        assert match_one(find_regions(jpeg(image)), phrase_of(text)) is None


def test_a_name_of_what_is_not_there_means_nothing() -> None:
    regions = find_regions(jpeg(block(block(floor(), (150, 150, 250, 250), GREEN), (400, 160, 490, 250), PURPLE)))
    for noun in ("vase", "cone", "ball", "bottle", "kettle", "zorb"):
        assert match_one(regions[:1], phrase_of(f"the {noun}")) is None
        assert match_one(regions, phrase_of(f"the {noun}")) is None


@pytest.mark.parametrize("noun", sorted(HALF_WIDTHS))
@pytest.mark.parametrize("side", [-1, 1])
def test_a_shadow_in_the_outline_names_no_other_thing(noun: str, side: int) -> None:
    image = turned(turned(floor(), 200, noun), 440, "cone" if noun != "cone" else "vase")
    cv2.ellipse(image, (440 + 50 * side, 272), (50, 8), 0, 0, 360, PURPLE, -1)
    found = match_one(find_regions(jpeg(image)), phrase_of(f"the {noun}"))
    assert found is None or found.centre[0] == pytest.approx(200, abs=3)


def test_a_handle_tells_a_mug_from_a_cylinder_and_does_not_make_it_wider() -> None:
    for reach in (0, 25):
        image = floor()
        for x in (150, 400):
            image[120:220, x : x + 75] = PURPLE
        image[145:190, 475 : 475 + reach] = PURPLE
        found = matches(find_regions(jpeg(image)), "the purple mug")
        assert (len(found) == 1) is (reach > 0)
    mask = np.zeros((200, 300), bool)
    mask[60:140, 100:160] = True
    mask[80:120, 160:185] = True
    cup = SeenBody("mug", (100, 60, 185, 140), CroppedMask.of(mask), "cylinder")
    assert cup.core == (100, 60, 160, 140)
    assert replace(cup, shape="box").core == cup.bbox
