"""`POST /look`: what the server's models see at a point, in a box, and of what a question names."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from servers import IMAGE, QUESTION, SEEING, Served, data_url, problem

pytestmark = pytest.mark.slow
BALL, CUBE, FACE = [42, 62, 78, 98], [170, 60, 205, 98], [170, 69, 205, 98]


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    with Served(tmp_path_factory.mktemp("look"), **SEEING) as one:
        yield one


def look(served: Served, image: Any = None, **what: Any) -> httpx.Response:
    return served.http.post("/look", json={"image": image or data_url(IMAGE)} | what)


def things(response: httpx.Response) -> list[dict[str, Any]]:
    assert response.status_code == 200, response.text
    assert (response.json()["width"], response.json()["height"]) == (240, 160)
    return response.json()["things"]


def known(served: Served) -> dict[str, str]:
    """The image, by the digest under which the server has it in memory."""
    response = look(served)
    assert things(response) == []
    return {"artifact": response.json()["image"]}


def test_at_a_point_and_in_a_box(served: Served) -> None:
    (ball,) = things(look(served, point=[60, 80]))
    assert ball["bbox"] == BALL
    assert ball["score"] == 0.9
    mask = cv2.imdecode(np.frombuffer(base64.b64decode(ball["mask"].split(",")[1]), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert mask.shape == (160, 240)
    assert (mask[80, 60], mask[80, 20]) == (255, 0)
    assert [each["bbox"] for each in things(look(served, point=[187, 85]))] == [CUBE, FACE]
    assert things(look(served, point=[20, 20])) == []
    assert [each["bbox"] for each in things(look(served, bbox=[165, 58, 208, 100]))] == [CUBE]


def test_what_a_question_names(served: Served) -> None:
    for image in (data_url(IMAGE), known(served)):
        found = things(look(served, image, question=QUESTION))
        assert {each["name"]: each["bbox"] for each in found} == {"ball": BALL, "cube": CUBE}
    found = things(look(served, question="If the red ball moves to the right, will it hit the ghost?"))
    assert {each["name"]: each["mask"] is None for each in found} == {"ball": False, "ghost": True}


def test_an_image_is_named_by_its_digest_until_the_server_forgets_it(served: Served) -> None:
    image = known(served)
    assert [each["bbox"] for each in things(look(served, image, point=[60, 80]))] == [BALL]
    assert served.stop() == 0
    served.start()
    for place in ({"point": [60, 80]}, {"question": QUESTION}):
        problem(look(served, image, **place), 404, "artifact-not-found")
    problem(look(served, {"artifact": "0" * 64}), 404, "artifact-not-found")


def test_a_form(served: Served) -> None:
    fields = {"request": json.dumps({"point": [60, 80]})}
    response = served.http.post("/look", files={"image": ("a.png", IMAGE)}, data=fields)
    assert [each["bbox"] for each in things(response)] == [BALL]
    response = served.http.post("/look", files={"image": ("a.png", IMAGE)}, data={"question": QUESTION})
    assert [each["name"] for each in things(response)] == ["ball", "cube"]


def test_places_outside_the_image_and_two_places_are_refused(served: Served) -> None:
    for what, pointer in (
        ({"point": [240.5, 80]}, "/point"),
        ({"bbox": [100, 100, 90, 120]}, "/bbox"),
        ({"bbox": [-1, 0, 90, 120]}, "/bbox"),
        ({"point": [60, 80], "question": QUESTION}, ""),
    ):
        (error,) = problem(look(served, **what), 422, "invalid-request")["errors"]
        assert error["pointer"] == pointer
