"""What may be a thing and is too faint to tell is named, is in no world, and makes what depends on it not sure."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from conftest import DATA
from drawn import Image, ball, block, floor, jpeg, png_bytes

from cow_service.requests import AnswerRequest
from cow_service.service import Service
from cow_service.vision.scene import Scene

CONE = (273, 178, 367, 308)
QUESTION = "If the red ball moves to the right, will it hit the blue cube? (A) Yes (B) No (C) Not sure"


def with_cone(image: Image, paler: int, grey: int = 200) -> Image:
    result = np.ascontiguousarray(image).copy()
    corners = np.array([[320, 170], [370, 310], [270, 310]], np.int32)
    cv2.fillPoly(result, [corners], (grey + paler,) * 3, cv2.LINE_AA)
    return result


@pytest.mark.parametrize("grey", [150, 190, 215])
@pytest.mark.parametrize("paler", [8, 10, 14])
def test_a_pale_cone_on_a_pale_floor_may_be_a_thing(grey: int, paler: int) -> None:
    [(x0, y0, x1, y1)] = Scene(jpeg(with_cone(floor(grey=grey), paler, grey))).faint
    assert np.allclose((x0, y0, x1, y1), CONE, atol=8)


def test_neither_a_floor_nor_a_shadow_nor_what_was_found_is_faint() -> None:
    shadow = with_cone(floor(), -12, 150)
    assert Scene(jpeg(floor())).faint == Scene(jpeg(shadow)).faint == ()
    assert Scene(jpeg(ball(floor(), (300, 180), 45, (200, 30, 30)))).faint == ()


def test_a_tile_beside_a_thing_is_not_faint() -> None:
    image = np.ascontiguousarray(floor(grey=170))
    image[:, 250:254], image[190:194], image[300:304] = 130, 130, 130
    assert Scene(jpeg(block(image, (360, 150, 460, 330), (20, 20, 20)))).faint == ()


@pytest.mark.parametrize(("height", "in_way"), [(270, True), (370, False)])
def test_an_answer_is_not_sure_where_the_way_leads_over_something_faint(
    service: Service, height: int, in_way: bool
) -> None:
    image = with_cone(floor(grey=200, height=420), 9)
    image = block(ball(image, (80, height), 24, (200, 30, 30)), (560, 40, 610, 90), (50, 80, 200))
    info = service.keep_image(png_bytes(image))
    answer = service.answer(AnswerRequest.model_validate({"image": {"artifact": info.sha256}, "question": QUESTION}))
    assert answer.simulation is not None
    trajectory = answer.simulation.trajectory
    assert len(trajectory.faint) == 1
    assert trajectory.outcome is not None
    assert trajectory.outcome.probability == 0.0
    assert ("faint" in trajectory.outcome.depends_on) is in_way
    assert answer.not_sure is in_way
    assert any("may stand at (3" in each for each in answer.simulation.warnings)


def test_an_answer_is_not_sure_of_a_thing_that_two_ways_of_cutting_out_do_not_agree_on(service: Service) -> None:
    info = service.keep_image(
        (DATA / "half_vase.jpg").read_bytes()
    )  # the lower half of the vase is as grey as the floor
    question = "If the purple ball is thrown opposite to the direction of the arrow, will it hit the white vase?"
    asked = {"image": {"artifact": info.sha256}, "question": question}
    answer = service.answer(AnswerRequest.model_validate(asked))
    assert answer.simulation is not None
    assert answer.not_sure
    outcome = answer.simulation.trajectory.outcome
    assert outcome is not None
    assert outcome.depends_on[0] == "outline"
    assert "'white vase' was not seen clearly" in " ".join(answer.warnings)
    whole = {"object": "white vase", "bbox": [263, 152, 359, 333]}
    answer = service.answer(AnswerRequest.model_validate(asked | {"objects": [whole]}))
    assert answer.simulation is not None
    outcome = answer.simulation.trajectory.outcome
    assert outcome is not None
    assert "outline" not in outcome.depends_on
