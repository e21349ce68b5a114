"""Objects are found by colour and edges, named by colour, and cut out."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from drawn import Image, ball, block, floor, jpeg
from hypothesis import given
from hypothesis import strategies as st

from cow_service.media.masks import bbox_of, iou
from cow_service.perception.classical.contrast import colour_name, colour_names
from cow_service.perception.classical.regions import find_regions
from cow_service.perception.classical.segmentation import mask_from_bbox
from cow_service.perception.observation import look
from cow_service.records import LocatedObject

RED, ORANGE, YELLOW, GREEN, CYAN = (200, 30, 30), (235, 130, 40), (225, 200, 50), (50, 150, 50), (60, 180, 190)
BLUE, PURPLE, WHITE, PALE, BLACK = (50, 80, 200), (120, 60, 170), (240, 240, 240), (225, 225, 225), (18, 18, 18)
Box = tuple[int, int, int, int]
BLOCK = (270, 200, 330, 290)


def with_top(foot: int, end: int, rgb: tuple[int, int, int], middle: int = 300) -> Image:
    """A blue body with something on it, half so wide at its foot and at its end."""
    corners = np.array([[middle - foot, 202], [middle + foot, 202], [middle + end, 170], [middle - end, 170]], np.int32)
    return block(cv2.fillPoly(floor(), [corners], rgb, cv2.LINE_AA), BLOCK, BLUE)


def dark_below() -> Image:
    """A white ball whose lower part is as dark as the floor, which has another hue."""
    image = np.clip(floor(grey=128) * np.array([1.08, 1.0, 0.88]), 0, 255)
    ys, xs = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    shade = np.clip(215 - 2.6 * np.maximum(0, ys - 180), 90, 215)
    return np.where((np.hypot(xs - 300, ys - 200) <= 40)[..., None], shade[..., None], image).astype(np.uint8)


def lit_top() -> Image:
    image = block(floor(), (250, 180, 350, 280), BLACK)
    image[180:205, 250:350] = 78
    return image


def mouth_and_body() -> Image:
    image = floor(grey=140)
    cv2.ellipse(image, (300, 150), (40, 10), 0, 0, 360, PALE, -1, cv2.LINE_AA)
    return ball(image, (300, 235), 38, PALE)


def soft_shadow() -> Image:
    shade = cv2.ellipse(np.zeros((400, 640), np.float32), (300, 200), (50, 18), 0, 0, 360, 1, -1)
    return (floor() * (1 - 0.4 * cv2.GaussianBlur(shade, (0, 0), 3))[..., None]).astype(np.uint8)


def hard_shadows(light: float, ground: tuple[int, int, int]) -> Image:
    """Of a ball, of a block, and of something that is not seen."""
    shade = np.full((400, 640, 3), ground, np.float32)
    for centre, axes in (((235, 300), (55, 22)), ((440, 310), (50, 20)), ((520, 120), (48, 18))):
        shade[cv2.ellipse(np.zeros((400, 640), np.uint8), centre, axes, 0, 0, 360, 1, -1) > 0] *= light
    image = np.clip(shade + np.random.default_rng(0).normal(0, 2, shade.shape), 0, 255).astype(np.uint8)
    return block(ball(image, (200, 270), 40, RED), (380, 230, 450, 310), GREEN)


def textured(rgb: tuple[int, int, int], size: int, wall: tuple[int, int, int] | None = None) -> Image:
    """A ground with light and dark clouds of a size, below a wall, with three things on it."""
    rng = np.random.default_rng(0)
    coarse = rng.random((400 // size + 2, 640 // size + 2), np.float32)
    light = cv2.resize(coarse, (640, 400), interpolation=cv2.INTER_CUBIC)[..., None]
    image = np.clip(np.array(rgb) * (0.55 + 0.9 * light) + rng.normal(0, 3, (400, 640, 3)), 0, 255).astype(np.uint8)
    if wall:
        image[:120] = wall
    image = block(ball(image, (200, 260), 38, ORANGE), (420, 190, 500, 270), PURPLE)
    return ball(image, (330, 200), 30, WHITE)


def hexagon() -> Image:
    """A ball, and the outline of a cube seen at a corner."""
    angles = 0.3 + np.arange(6) * np.pi / 3
    corners = np.stack([200 + 45 * np.cos(angles), 200 + 45 * np.sin(angles)], axis=1).round().astype(np.int32)
    return cv2.fillPoly(ball(floor(), (420, 200), 40, GREEN), [corners], BLUE, cv2.LINE_AA)


HARD = {"red o": (160, 230, 240, 310), "green": (380, 230, 450, 310)}
ON_GROUND = {"orange o": (162, 222, 238, 298), "purple": (420, 190, 500, 270), "white o": (300, 170, 360, 230)}
# A picture, and the boxes of what is found in it by colour, with an o for a disc and a "?" for what is half hidden.
PICTURES: dict[str, tuple[Callable[[], Image], dict[str, Box]]] = {
    "a black neck": (lambda: with_top(6, 6, BLACK), {"blue": (270, 170, 330, 290)}),
    "a flame beside the middle": (
        lambda: with_top(5, 1, (172, 152, 122), middle=322), {"blue": BLOCK, "yellow": (318, 171, 327, 196)}
    ),
    "a pole that goes on": (
        lambda: block(block(floor(), (295, 60, 305, 290), WHITE), BLOCK, BLUE),
        {"blue": BLOCK, "white": (295, 60, 305, 201)},
    ),
    "something black between two": (
        lambda: block(
            block(block(floor(), (250, 110, 320, 180), GREEN), (260, 180, 330, 240), BLACK),
            (220, 238, 390, 370), ORANGE,
        ),
        {"green ?": (250, 110, 320, 180), "black ?": (260, 180, 330, 240), "orange": (220, 238, 390, 370)},
    ),
    "a white ball on a white table": (
        lambda: ball(block(floor(grey=120), (200, 160, 380, 300), (205, 205, 205)), (290, 135), 36, (235, 235, 235)),
        {"white o": (254, 99, 326, 171), "white": (200, 160, 380, 300)},
    ),
    "a cube seen at a corner, and a ball": (hexagon, {"blue": (155, 156, 245, 244), "green o": (380, 160, 460, 240)}),
    "something black with a lit top": (lit_top, {"black": (250, 180, 350, 280)}),
    "a white ball that is dark below": (dark_below, {"white o": (260, 160, 340, 240)}),
    "a mouth and a body": (
        mouth_and_body, {"white": (260, 140, 340, 160), "white o": (262, 197, 338, 273)}
    ),
    "a soft shadow": (soft_shadow, {}),
    "dark shadows on grey": (lambda: hard_shadows(0.3, (200, 200, 205)), HARD),
    "dark shadows on blue": (lambda: hard_shadows(0.4, (90, 120, 170)), HARD),
    "blue stone": (lambda: textured((70, 70, 120), 40, (165, 175, 185)), ON_GROUND),
    "grass": (lambda: textured((50, 95, 60), 12), ON_GROUND),
    "clutter": (lambda: np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8).repeat(9, 0).repeat(9, 1), {}),
}  # fmt: skip


@pytest.mark.parametrize(("picture", "expected"), PICTURES.values(), ids=PICTURES)
def test_what_is_found_in_a_picture(
    picture: Callable[[], Image], expected: dict[str, tuple[int, int, int, int]]
) -> None:
    found = {}
    for region in find_regions(jpeg(picture())):
        found[region.colour + (" o" if region.is_disc else " ?" if region.is_hidden else "")] = region.bbox
    assert found.keys() == expected.keys()
    for name, bbox in expected.items():
        assert iou(found[name], bbox) > 0.8, name


@given(st.floats(0, 100), st.floats(-120, 120), st.floats(-120, 120))
def test_every_colour_has_a_name(lightness: float, a: float, b: float) -> None:
    assert colour_name(lightness, a, b) in colour_names(lightness, a, b)


def test_colours_at_a_border_have_both_names_and_others_one() -> None:
    assert colour_names(55, 30, 52) == {"orange"}
    assert colour_names(45, 44, 47) >= {"red", "orange"}
    assert "green" not in colour_names(60, -3, 46)
    assert colour_name(22, 35, -60) == "blue"  # saturated: hue 300, as that of a pale purple


CSS = {  # colours, with the names that people also give some
    "grey": (128, 128, 128), "white": (255, 255, 255), "black": (0, 0, 0), "red": (255, 0, 0), "purple": (128, 0, 128),
    "pink": (255, 192, 203), "green": (0, 128, 0), "yellow": (255, 255, 0), "blue": (0, 0, 255), "brown": (165, 42, 42),
    "orange": (255, 165, 0), "cyan": (0, 255, 255), "silver grey": (192, 192, 192), "maroon red": (128, 0, 0),
    "fuchsia pink": (255, 0, 255), "lime green": (0, 255, 0), "olive green": (128, 128, 0), "navy blue": (0, 0, 128),
    "teal cyan": (0, 128, 128), "turquoise cyan": (64, 224, 208),
}  # fmt: skip


@pytest.mark.parametrize("grey", [70, 225])
@pytest.mark.parametrize("half", [0, 1])
def test_a_plain_colour_is_found_and_named_on_a_dark_and_on_a_light_floor(grey: int, half: int) -> None:
    image, expected = floor(grey=grey), {}
    # On a light floor silver and grey, darker and of its hue, cannot be distinguished from a shadow.
    names = [name for name in sorted(CSS)[half::2] if grey < 200 or "grey" not in name]
    for place, name in enumerate(names):
        x, y = 70 + 120 * (place % 5), 110 + 160 * (place // 5)
        expected[name] = (x, y, x + 46, y + 46)
        image = block(image, expected[name], CSS[name])
    regions = find_regions(jpeg(image))
    assert len(regions) == len(expected)
    for name, bbox in expected.items():
        best = max(regions, key=lambda region: iou(region.bbox, bbox))
        assert iou(best.bbox, bbox) > 0.88, name
        assert name.split()[-1] in best.colours


@pytest.mark.slow
@given(
    st.tuples(st.floats(-50, 250), st.floats(-50, 200)),
    st.tuples(st.floats(2, 300), st.floats(2, 300)),
)
def test_any_box_gives_a_mask(corner: tuple[float, float], size: tuple[float, float]) -> None:
    image = ball(floor(200, 150), (100, 75), 30, RED)
    mask = mask_from_bbox(image, (corner[0], corner[1], corner[0] + size[0], corner[1] + size[1]))
    assert mask.shape == (150, 200)
    assert mask.any()
    assert bbox_of(mask)[2] <= 200


def test_obstacles_are_named_by_the_question_first() -> None:
    image = block(ball(floor(), (120, 200), 40, RED), (280, 150, 360, 250), BLUE)
    scene = look(jpeg(ball(image, (500, 200), 35, GREEN)))
    boxes = {region.colour: region.bbox for region in scene.things}
    obstacles = scene.obstacles(boxes["red"], (LocatedObject(object="big blue cube", bbox=boxes["blue"]),))
    assert [(each.name, each.bbox) for each in obstacles] == [
        ("big blue cube", boxes["blue"]),
        ("green object", boxes["green"]),
    ]
