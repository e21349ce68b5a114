"""Drawn arrows and boxes are found, measured and taken out, whatever their colour, style and angle."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from conftest import SCALE
from drawn import DrawnArrow, angle_between, ball, block, floor, jpeg
from hypothesis import given, settings
from hypothesis import strategies as st

from cow_service.perception.observation import look

COLOURS = {
    "red": (230, 40, 40),
    "green": (30, 160, 30),
    "blue": (20, 60, 200),
    "yellow": (240, 220, 30),
    "black": (0, 0, 0),
    "white": (255, 255, 255),
    "magenta": (220, 30, 200),
    "cyan": (0, 210, 220),
}


@settings(max_examples=12 * SCALE, deadline=None, derandomize=True)
@given(
    angle=st.floats(0, 2 * np.pi),
    length=st.floats(60, 180),
    thickness=st.integers(3, 10),
    colour=st.sampled_from(sorted(COLOURS)),
    style=st.sampled_from(["open", "filled", "outlined"]),
    quality=st.sampled_from([80, 90, 95]),
)
def test_any_arrow_on_a_floor_is_measured(
    angle: float, length: float, thickness: int, colour: str, style: str, quality: int
) -> None:
    if style == "outlined" and colour == "white":
        style = "filled"
    length = max(length, 7.0 * thickness)
    dx, dy = np.cos(angle), np.sin(angle)
    arrow = DrawnArrow((320 - dx * length / 2, 200 - dy * length / 2), angle, length, thickness, COLOURS[colour], style)
    (found,) = look(jpeg(arrow.on(floor()), quality)).arrows
    assert angle_between(found.direction, arrow.direction) < 2.5
    assert math.dist(found.tip, arrow.tip) < 3 + thickness


@pytest.mark.slow
@settings(max_examples=8 * SCALE, deadline=None, derandomize=True)
@given(
    angle=st.floats(0, 2 * np.pi),
    width=st.floats(9, 20),
    head=st.floats(1.5, 2.2),
    colours=st.sampled_from([("white", "red"), ("white", "black"), ("black", "white"), ("cyan", "black")]),
    quality=st.sampled_from([75, 90]),
)
def test_a_hollow_arrow_is_measured(
    angle: float, width: float, head: float, colours: tuple[str, str], quality: int
) -> None:
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    length, broad = 60 + 5 * width, head * width + 3
    tail = np.array([320, 200]) - along * length / 2
    neck, tip = tail + along * (length - 0.8 * broad), tail + along * length
    sides = [(tail, width / 2), (neck, width / 2), (neck, broad / 2), (tip, 0), (neck, -broad / 2), (neck, -width / 2)]
    corners = [point + across * side for point, side in [*sides, (tail, -width / 2)]]
    shape = np.round(16 * np.array(corners)).astype(np.int32)
    image = floor()
    cv2.fillPoly(image, [shape], COLOURS[colours[0]], cv2.LINE_AA, 4)
    cv2.polylines(image, [shape], True, COLOURS[colours[1]], 3, cv2.LINE_AA, 4)
    scene = look(jpeg(image, quality))
    assert len(scene.arrows) == 1
    assert angle_between(scene.arrows[0].direction, (along[0], along[1])) < 2.5
    assert np.abs(scene.clean.astype(int) - floor())[scene.cues].mean() < 12


def test_things_shaped_like_arrows_are_none() -> None:
    image = block(floor(), (100, 100, 112, 260), (200, 30, 30))  # a bar
    cv2.line(image, (300, 100), (420, 180), (0, 0, 0), 3, cv2.LINE_AA)  # a line
    cv2.putText(image, "B7", (450, 120), cv2.FONT_HERSHEY_SIMPLEX, 2, (20, 60, 200), 4, cv2.LINE_AA)
    cv2.circle(image, (520, 300), 30, (30, 160, 30), 4, cv2.LINE_AA)
    cv2.fillPoly(image, [np.array([[300, 250], [340, 330], [260, 330]], np.int32)], (230, 40, 40))
    assert look(jpeg(image)).arrows == ()
    # The side of a can behind a ball, of one dark blue: as broad at one end as a stubby arrow's head.
    can = np.array([[300, 150], [336, 150], [336, 141], [350, 156], [336, 171], [336, 162], [300, 162]], np.int32)
    assert look(jpeg(cv2.fillPoly(floor(grey=220), [can], (10, 15, 110), cv2.LINE_AA))).arrows == ()


@pytest.mark.parametrize(("line", "colour"), [(2, "red"), (3, "yellow"), (6, "blue"), (6, "black")])
def test_a_drawn_box_is_found_around_its_object(line: int, colour: str) -> None:
    image = ball(floor(), (300, 200), 40, (240, 140, 40))
    cv2.rectangle(image, (240, 140), (360, 260), COLOURS[colour], line)
    scene = look(jpeg(image))
    (box,) = scene.boxes
    half = line // 2
    assert box.bbox == pytest.approx([240 + half, 140 + half, 360 - half, 260 - half], abs=2)
    assert scene.arrows == ()
    assert scene.cues[140, 300]
    assert not scene.cues[200, 300]
