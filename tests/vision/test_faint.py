"""What may be a thing and is too faint to tell is named, is in no world, and makes what depends on it not sure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import DATA
from drawn import Image, ball, block, floor, jpeg, png_bytes

from cow_service.records import Answer, Outcome
from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.vision.scene import Scene

QUESTION = "If the red ball moves to the right, will it hit the blue cube? (A) Yes (B) No (C) Not sure"


def with_cone(image: Image, paler: int, grey: int = 200) -> Image:
    result = np.ascontiguousarray(image).copy()
    corners = np.array([[320, 170], [370, 310], [270, 310]], np.int32)
    cv2.fillPoly(result, [corners], (grey + paler,) * 3, cv2.LINE_AA)
    return result


@pytest.mark.parametrize(("grey", "paler"), [(150, 8), (190, 10), (215, 14)])
def test_a_pale_cone_on_a_pale_floor_may_be_a_thing(grey: int, paler: int) -> None:
    (box,) = Scene(jpeg(with_cone(floor(grey=grey), paler, grey))).faint
    assert np.allclose(box, (273, 178, 367, 308), atol=8)


def test_neither_a_floor_nor_a_shadow_nor_a_thing_nor_a_tile_is_faint() -> None:
    tiles = np.ascontiguousarray(floor(grey=170))
    tiles[:, 250:254], tiles[190:194], tiles[300:304] = 130, 130, 130
    for image in (
        floor(),
        with_cone(floor(), -12, 150),
        ball(floor(), (300, 180), 45, (200, 30, 30)),
        block(tiles, (360, 150, 460, 330), (20, 20, 20)),
    ):
        assert Scene(jpeg(image)).faint == ()


def test_what_is_known_is_not_faint_any_more() -> None:
    scene = Scene(jpeg(with_cone(floor(grey=190), 10, 190)))
    assert scene.faint_beside([(0, 0, 200, 400)]) == scene.faint
    assert scene.faint_beside([(0, 0, 200, 400), (300, 200, 340, 300)]) == ()


def outcome_of(service: Service, image: bytes, question: str, **more) -> tuple[Answer, Outcome]:
    asked = {"image": {"artifact": service.keep_image(image).sha256}, "question": question}
    answer = service.answer(AnswerRequest.model_validate(asked | more))
    assert answer.simulation is not None
    assert answer.simulation.trajectory.outcome is not None
    return answer, answer.simulation.trajectory.outcome


@pytest.mark.slow
@pytest.mark.parametrize(("height", "in_way"), [(270, True), (370, False)])
def test_an_answer_is_not_sure_where_the_way_leads_over_something_faint(
    service: Service, height: int, in_way: bool
) -> None:
    image = ball(with_cone(floor(grey=200, height=420), 9), (80, height), 24, (200, 30, 30))
    answer, outcome = outcome_of(service, png_bytes(block(image, (560, 40, 610, 90), (50, 80, 200))), QUESTION)
    assert answer.simulation is not None
    assert len(answer.simulation.trajectory.faint) == 1
    assert outcome.probability == 0.0
    assert ("faint" in outcome.depends_on) is in_way
    assert answer.not_sure is in_way


@pytest.mark.slow
def test_an_answer_is_not_sure_of_a_thing_that_two_ways_of_cutting_out_do_not_agree_on(service: Service) -> None:
    image = (DATA / "half_vase.jpg").read_bytes()  # the lower half of the vase is as grey as the floor
    question = "If the purple ball is thrown opposite to the direction of the arrow, will it hit the white vase?"
    answer, outcome = outcome_of(service, image, question)
    assert answer.not_sure
    assert outcome.depends_on[0] == "outline"
    whole = {"object": "white vase", "bbox": [263, 152, 359, 333]}
    _, outcome = outcome_of(service, image, question, objects=[whole])
    assert "outline" not in outcome.depends_on
