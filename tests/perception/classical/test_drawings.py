"""Drawings seen from the side are a world without depth: the ground is a line, and things rest on what is beneath."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import pytest
from drawn import Image, floor, jpeg, png_bytes
from drawn import ball as shaded_ball

from cow_service.media.masks import CroppedMask, bbox_of, pieces_of
from cow_service.perception.classical.side_view import find_side_view
from cow_service.perception.observation import look
from cow_service.records import Answer
from cow_service.requests import AnswerRequest
from cow_service.service import Service

pytestmark = pytest.mark.slow

WIDTH, HEIGHT, LEVEL = 640, 400, 330
RED, BLUE, GREEN, ORANGE, BROWN, BLACK = (
    (220, 40, 40), (40, 80, 220), (40, 160, 60), (240, 140, 30), (139, 90, 43), (20, 20, 20)
)  # fmt: skip
Colour = tuple[int, int, int]
Paint = Callable[[Image], Any]


def drawing(*things: Paint, sky: Colour = (255, 255, 255), ground: Colour | None = None, gap: int = 0) -> Image:
    """Things on a line, or on a filled ground with a gap of a width in its middle."""
    image = np.full((HEIGHT, WIDTH, 3), sky, np.uint8)
    ends = [0, (WIDTH - gap) // 2, (WIDTH + gap) // 2, WIDTH] if gap else [0, WIDTH]
    for left, right in list(pairwise(ends))[::2]:
        low = LEVEL if ground is None else HEIGHT
        cv2.rectangle(image, (left, LEVEL), (right, low), ground or BLACK, cv2.FILLED if ground else 3)
    for paint in things:
        paint(image)
    return image


def ball(x: int, radius: int, colour: Colour, bottom: int = LEVEL - 2, outline: bool = False) -> Paint:
    def paint(image: Image) -> None:
        cv2.circle(image, (x, bottom - radius), radius, colour, cv2.FILLED, cv2.LINE_AA)
        if outline:
            cv2.circle(image, (x, bottom - radius), radius, BLACK, 3, cv2.LINE_AA)

    return paint


def box(x: int, wide: int, high: int, colour: Colour, bottom: int = LEVEL - 2) -> Paint:
    return lambda image: cv2.rectangle(image, (x - wide // 2, bottom - high), (x + wide // 2, bottom), colour, -1)


def table(x: int, wide: int, high: int, colour: Colour) -> Paint:
    def paint(image: Image) -> None:
        box(x, wide, 16, colour, LEVEL - 2 - high + 16)(image)
        for leg in (x - wide // 2 + 20, x + wide // 2 - 20):
            box(leg, 14, high, colour)(image)

    return paint


def slope(left: int, right: int, high: int, colour: Colour) -> Paint:
    corners = np.array([(left, LEVEL - 2), (right, LEVEL - 2), (left, LEVEL - 2 - high)])
    return lambda image: cv2.fillPoly(image, [corners], colour, cv2.LINE_AA)


ON_TABLE = LEVEL - 2 - 120
CASES = {
    "rolls into a box": (
        drawing(ball(120, 30, RED), box(450, 80, 80, BLUE)),
        "If the red ball rolls to the right, will it hit the blue box?", "Yes",
    ),
    "falls beside a table": (
        drawing(table(420, 220, 120, BROWN), ball(120, 22, RED, 92), ground=GREEN),
        "If the red ball falls, will it land on the table?", "No",
    ),
    "rolls over the edge of a table onto a box": (
        drawing(table(200, 240, 120, BROWN), ball(250, 20, RED, ON_TABLE), box(420, 90, 40, BLUE)),
        "If the red ball rolls to the right, will it hit the blue box?", "Yes",
    ),
    "stays on a table and passes over a box beneath": (
        drawing(table(320, 600, 120, BROWN), ball(80, 20, RED, ON_TABLE), box(320, 60, 60, BLUE)),
        "If the red ball rolls to the right, will it hit the blue box?", "No",
    ),
    "is asked to stay on a table": (
        drawing(table(320, 600, 120, BROWN), ball(80, 20, RED, ON_TABLE)),
        "If the red ball rolls to the right by 20 px, will it stay on the table?", "Yes",
    ),
    "falls into a gap": (
        drawing(ball(120, 22, RED), box(520, 60, 70, BLUE), ground=GREEN, gap=160),
        "If the red ball rolls slowly to the right, will it hit the blue box?", "No",
    ),
    "has an outline": (
        drawing(ball(520, 30, ORANGE, outline=True), box(160, 70, 100, BLUE)),
        "If the orange ball rolls towards the blue box, will it hit it?", "Yes",
    ),
}  # fmt: skip


def answered(service: Service, image: Image, question: str) -> Answer:
    info = service.keep_image(png_bytes(image))
    answer = service.answer(AnswerRequest.model_validate({"image": {"artifact": info.sha256}, "question": question}))
    assert answer.simulation is not None, answer.warnings
    assert answer.simulation.trajectory.camera is not None
    assert answer.simulation.trajectory.camera.source == "side-view"
    return answer


@pytest.mark.parametrize("name", CASES)
def test_what_happens_in_a_drawing(service: Service, name: str) -> None:
    image, question, expected = CASES[name]
    answer = answered(service, jpeg(image), question)
    assert answer.answer == expected, answer.reasoning


def test_what_is_released_on_a_slope_rolls_down_it_and_does_not_fly(service: Service) -> None:
    image = drawing(slope(60, 330, 150, GREEN), ball(95, 18, RED, LEVEL - 133), box(500, 70, 80, BLUE))
    answer = answered(service, image, "If the red ball is released, will it hit the blue box?")
    assert answer.answer == "Yes"
    assert answer.simulation is not None
    trajectory = answer.simulation.trajectory
    assert trajectory.bodies[0].support == "green object"
    assert [each.object for each in trajectory.encounters] == ["blue box"], "on the slope it lies from the start"


def test_the_table_that_a_ball_falls_off_is_the_one_that_is_named(service: Service) -> None:
    image = drawing(table(200, 240, 120, BROWN), ball(250, 20, RED, ON_TABLE))
    answer = answered(service, image, "If the red ball rolls to the right, will it fall off the table?")
    assert answer.answer == "Yes"
    assert answer.simulation is not None
    assert answer.simulation.trajectory.bodies[0].support == "table"


def test_a_table_that_is_not_seen_is_not_the_floor(service: Service) -> None:
    image = drawing(ball(120, 22, RED, 92), slope(40, 240, 140, GREEN))
    assert answered(service, image, "If the red ball falls, will it land on the table?").not_sure


def test_a_picture_with_depth_is_no_side_view() -> None:
    assert find_side_view(shaded_ball(floor(), (300, 180), 45, RED)) is None
    before_the_line = drawing(ball(120, 30, RED), box(450, 80, 80, BLUE, LEVEL + 40))
    assert find_side_view(before_the_line) is None


def test_the_pieces_of_a_table_leave_the_room_beneath_it() -> None:
    view = find_side_view(drawing(table(320, 240, 120, BROWN)))
    assert view is not None
    pieces = pieces_of(view.shapes[0])
    assert len(pieces) == 3
    assert not any(cv2.pointPolygonTest(each.reshape(-1, 1, 2), (320, LEVEL - 40), False) > 0 for each in pieces)


def test_a_solid_block_is_no_box_drawn_over_the_picture() -> None:
    """Scaled to the size that is looked at, it has a fringe of a colour of its own, as thin as a drawn line."""
    image = np.full((600, 900, 3), (238, 246, 255), np.uint8)
    image[430:] = 201, 178, 138
    image[250:430, 760:801] = 32, 160, 64
    scene = look(image)
    assert scene.boxes == ()
    assert [region.bbox[0] for region in scene.things] == [760]
    framed = cv2.rectangle(image.copy(), (300, 200), (420, 380), (220, 30, 30), 3)
    assert len(look(framed).boxes) == 1


def test_what_is_grounded_is_no_annotation() -> None:
    image = cv2.rectangle(floor().copy(), (300, 150), (360, 260), (220, 30, 30), 3)
    scene = look(np.ascontiguousarray(image))
    (frame,) = scene.boxes
    thing = bbox_of(frame.mask)
    scene = scene.with_masks({thing: CroppedMask.of(frame.mask)})
    assert scene.keeping([thing]).boxes == ()
    assert not scene.keeping([thing]).cues.any()
    assert scene.keeping([(0.0, 0.0, 50.0, 50.0)]) is scene
