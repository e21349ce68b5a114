"""What is put somewhere before another motion: its new place, the result of the motion, and how it is drawn."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from drawn import Image, ball, block, floor
from refusals import refused
from runs import run_of
from staged import BLUE, GREEN, RED, YELLOW, clip_of, computed, is_green, is_red, pixels

from cow_service.generators.cutout import create
from cow_service.settings import Settings
from cow_service.stages.run import Run

pytestmark = pytest.mark.slow

MOVER, CUBE, POST = (80, 255, 130, 305), (430, 230, 510, 330), (300, 90, 350, 150)
OBJECTS = ({"object": "cube", "bbox": CUBE, "shape": "box"}, {"object": "post", "bbox": POST, "shape": "box"})
RIGHT = {"kind": "linear", "direction": (1, 0), "speed": 200}


def picture() -> Image:
    image = block(block(floor(), CUBE, BLUE), POST, GREEN)
    return ball(image, (105, 280), 25, RED)


def put(thing: str, relation: str, *targets: str) -> dict[str, Any]:
    return {"kind": "place", "object": thing, "relation": relation, "targets": targets}


def run(*changes: dict[str, Any], image: Image | None = None, generator: Any = None, **request: Any) -> Run:
    asked = {"question": "Will the ball hit the post?", "num_frames": 49, "ensemble": 15, "objects": OBJECTS} | request
    backend = {"generator": lambda: generator or create(Settings())}
    mover = {"object": "red ball", "bbox": MOVER}
    motion = asked.pop("motion", RIGHT)
    pixels = picture() if image is None else image
    return run_of(pixels, **backend, grounding=mover, motion=motion, interventions=changes, **asked)


class TestWorlds:
    def test_the_mover_meets_what_was_put_in_its_way(self) -> None:
        question = "Would the outcome change if the post were put to the left of the cube and the ball rolls right?"
        result = computed(run(put("Post", "left-of", "the cube"), question=question))
        told, factual = result.value, result.value.factual
        (there,) = told.placed
        assert (told.placement, there.object, there.result, there.visible) == (None, "post", "beside", 1)
        assert (there.by_heading, result.warnings) == (False, ())
        assert next(each.object for each in told.encounters if each.kind == "touches") == "post"
        assert "touches" not in {each.kind for each in factual.encounters if each.object == "post"}
        assert (told.outcome.asked.form, told.outcome.probability) == ("changes", pytest.approx(1, abs=0.2))
        assert (factual.outcome.asked.form, factual.outcome.first) == ("what-happens", "cube")
        body = there.body
        assert factual.bodies[body].bbox == POST
        x0, y0, x1, y1 = told.bodies[body].bbox
        assert 130 < x0 < x1 < 430
        assert y1 == pytest.approx(CUBE[3], abs=25)
        assert x1 - x0 > 1.1 * (POST[2] - POST[0]), "it is nearer to the camera"
        path = next(each for each in told.paths if each.body == body)
        assert (path.scale[0], path.points[0]) == (1, pytest.approx(((x0 + x1) / 2, (y0 + y1) / 2), abs=4))

    def test_one_after_the_other_and_with_something_taken_away(self) -> None:
        lid = (540, 120, 590, 180)
        image = block(picture(), lid, YELLOW)
        there = {"image": image, "objects": (*OBJECTS, {"object": "lid", "bbox": lid, "shape": "box"})}
        told = computed(run({"kind": "remove", "object": "lid"}, put("post", "onto", "cube"), **there)).value
        assert {each.object: each.support for each in told.bodies} == {
            "red ball": "floor", "cube": "floor", "post": "cube",
        }  # fmt: skip
        stacked = computed(run(put("post", "left-of", "cube"), put("lid", "onto", "post"), **there)).value
        lids, post = (next(each for each in stacked.bodies if each.object == name) for name in ("lid", "post"))
        assert lids.support == "post"
        assert lids.position[0] == pytest.approx(post.position[0], abs=0.1)

    def test_in_front_of_what_sets_out_is_where_it_goes(self) -> None:
        told = computed(run(put("post", "in-front-of", "red ball"))).value
        assert told.placed[0].by_heading
        assert next(each.object for each in told.encounters if each.kind == "touches") == "post"

    def test_what_stood_on_it_falls(self) -> None:
        cap = {"object": "cap", "bbox": (310, 50, 340, 95), "shape": "cylinder", "stands_on": "post"}
        image = block(picture(), (310, 50, 340, 95), YELLOW)
        told = computed(run(put("post", "left-of", "cube"), image=image, objects=(*OBJECTS, cap))).value
        index = next(i for i, body in enumerate(told.bodies) if body.object == "cap")
        assert told.bodies[index].support == "air"
        path = next(each for each in told.paths if each.body == index)
        assert path.states[-1][1] > path.states[0][1]

    def test_the_mover_can_be_put_somewhere_before_it_moves(self) -> None:
        frames = {"indices": [0, 24], "max_side": None}
        told, clip = clip_of(wanted := run(put("red ball", "onto", "cube"), video=False, frames=frames))
        assert told.bodies[0].support == "cube"
        x, y = told.path.points[0]
        assert CUBE[0] < x < CUBE[2]
        assert y < CUBE[1] + 20
        assert told.path.points[24][0] > x + 50
        first = pixels(wanted, clip.frames[0])
        assert is_red(first[int(y), int(x)])
        assert not is_red(first[280, 105])

    def test_what_is_not_seen_there_is_told(self) -> None:
        wide, peg = (300, 60, 620, 345), (200, 290, 230, 330)
        image = block(block(ball(floor(), (105, 280), 25, RED), wide, BLUE), peg, GREEN)
        objects = ({"object": "wall", "bbox": wide, "shape": "box"}, {"object": "peg", "bbox": peg, "shape": "box"})
        assert computed(run(put("peg", "behind", "wall"), image=image, objects=objects)).value.placed[0].visible < 0.25


class TestWhatCannotBe:
    @pytest.mark.parametrize(
        ("changes", "code"),
        [
            ((put("post", "between", "red ball", "cube"),), "cannot-ground"),
            ((put("cube", "onto", "red ball"),), "cannot-ground"),
            ((put("post", "into", "cube"),), "cannot-ground"),
            ((put("lamp", "next-to", "cube"),), "invalid-request"),
        ],
        ids=["no room", "falls off", "no container", "not there"],
    )
    def test_is_refused(self, changes: Any, code: str) -> None:
        near = (150, 240, 230, 330)
        image = block(ball(block(floor(), POST, GREEN), (105, 280), 25, RED), near, BLUE)
        objects = ({"object": "cube", "bbox": near, "shape": "box"}, OBJECTS[1])
        with refused(code):
            computed(run(*changes, image=image, objects=objects))

    def test_nothing_is_put_to_what_is_seen_going_somewhere(self) -> None:
        changes = put("red ball", "left-of", "cube"), put("post", "onto", "red ball")
        with refused("cannot-ground"):
            computed(run(*changes, motion={"kind": "place"}))

    def test_a_given_path_does_not_begin_elsewhere(self) -> None:
        path = {"points": [(105, 280), (300, 280)], "fps": 16}
        with refused("cannot-ground"):
            computed(run(put("red ball", "onto", "cube"), motion=None, trajectory=path))


class TestFrames:
    def test_it_is_drawn_at_its_new_place_from_the_first_frame_on(self) -> None:
        wanted = run(put("post", "left-of", "cube"), frames={"indices": [0, 5], "max_side": None}, video=False)
        told, clip = clip_of(wanted)
        first, factual = pixels(wanted, clip.frames[0]), pixels(wanted, clip.factual_frames[0])
        assert np.array_equal(factual, picture())
        old = slice(POST[1] + 5, POST[3] - 5), slice(POST[0] + 5, POST[2] - 5)
        assert not is_green(first[old]).any()
        x0, y0, x1, y1 = (round(side) for side in told.bodies[told.placed[0].body].bbox)
        assert is_green(first[y0 + 25 : y1 - 25, x0 + 30 : x1 - 30]).mean() > 0.95
        assert is_green(pixels(wanted, clip.overlay)[old]).any(), "the overlay shows the image"
        marked = (np.abs(pixels(wanted, clip.overlay).astype(int) - (130, 255, 130)) < 30).all(axis=2)
        assert marked[old].any()
        assert marked[y0 - 24 : y1 + 2, x0 - 2 : x1 + 2].any(), "its new place is named or drawn"
