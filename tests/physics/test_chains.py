"""What the mover sets in motion: whom it hits in turn, where it goes, what is knocked over, what leaves the image."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from floors import TrueCamera, known, outline
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import rigid

from cow_service.narration.story import Story
from cow_service.narration.words import phrases_of
from cow_service.physics.bodies import SeenBody
from cow_service.physics.draws import ensemble, likeliest
from cow_service.physics.engine import Meeting, WorldRun
from cow_service.physics.ensemble import Query, answers_of, decide
from cow_service.physics.events import WorldEvents, encounters, find_world_events, set_off
from cow_service.physics.world import WorldInput, Worlds, run_world
from cow_service.records import Asked, MetresPerPixel, Motion, Trajectory
from cow_service.vision.masks import CroppedMask

CAMERA = TrueCamera(pitch=25, height=1.5)
HALF, FRAMES, FPS = 0.12, 65, 16.0


def seen(name: str, shape: Any, bbox: Any) -> SeenBody:
    x0, y0, x1, y1 = bbox
    ys, xs = np.mgrid[:400, :640] + 0.5
    return SeenBody(name, bbox, CroppedMask.of((xs >= x0) & (xs < x1) & (ys >= y0) & (ys < y1)), shape)


def ball(name: str, right: float, ahead: float = 3.0) -> SeenBody:
    return seen(name, "sphere", CAMERA.sphere_box((right, HALF, ahead), HALF))


def ran(bodies: list[SeenBody], rows=None, speed: float = 1.2) -> tuple[Worlds, WorldEvents]:
    """The first body rolls to the right."""
    scale = CAMERA.positions(np.array([[0.0, HALF, 3.0]]))[0, 2] / CAMERA.focal
    motion = Motion(
        kind="linear", law="contact", direction=(1.0, 0.0), cue="request", speed=speed / scale, sentence="",
        metres_per_pixel=MetresPerPixel(value=scale, source="reference"), source="request",
    )  # fmt: skip
    world = WorldInput(tuple(bodies), motion, known(CAMERA), CAMERA.size, FRAMES, FPS, turns_wanted=True)
    draws = likeliest() if rows is None else rows
    worlds = run_world(world, draws)
    return worlds, find_world_events(worlds, bodies, draws, CAMERA.size)


def answer(events: WorldEvents, relation: Any, **of: Any) -> int:
    form = of.pop("form", "whether")
    return answers_of(Query(Asked(form=form, relation=relation), **of), events)[0]


class TestThreeBallsInARow:
    BODIES = (ball("one", -0.9), ball("two", -0.2), ball("three", 0.4))

    def test_the_second_hits_the_third_and_the_first_does_not(self) -> None:
        _, events = ran(list(self.BODIES))
        assert events.order == (0, 1, 2)
        assert answer(events, "touches", subject=1, target=2) == 1
        assert answer(events, "touches", subject=2, target=1) == 1, "either may be the subject"
        assert events.of[1].times["touches"][0, 2] > events.of[0].times["touches"][0, 1]
        assert answer(events, "touches", form="which-first", subject=1) == 2, "the mover, which hit it, does not count"
        assert answer(events, "moves", target=2) == 1
        assert answer(events, "touches", form="which-first", among=(2,)) == -1

    def test_encounters_name_who_meets_whom_once(self) -> None:
        _, events = ran(list(self.BODIES))
        found = encounters(events, events, self.BODIES, FPS, FRAMES)
        touched = [(each.subject, each.body) for each in found if each.kind == "touches"]
        assert touched == [(0, 1), (1, 2)]
        assert len({(frozenset((each.subject, each.body)), each.kind) for each in found}) == len(found)
        assert all(each.probability == 1 for each in found if each.kind == "touches")

    def test_what_stands_beside_the_way_is_left_alone(self) -> None:
        _, events = ran([*self.BODIES[:2], ball("three", 0.4, 3.8)])
        assert answer(events, "touches", subject=1, target=2) == 0
        assert (answer(events, "moves", target=2), answer(events, "moves", target=1)) == (0, 1)


@settings(max_examples=12, deadline=None)
@given(st.floats(-0.16, 0.16))
def test_a_struck_ball_goes_along_the_line_between_the_middles(aside: float) -> None:
    worlds, _ = ran([ball("one", -0.9), ball("two", 0.0, 3.0 + aside)])
    struck = worlds.runs[0].positions[1]
    gone = (struck[-1] - struck[0])[[0, 2]]
    drop = struck[0, 2] - worlds.runs[0].positions[0, 0, 2]
    normal = math.asin(max(-1.0, min(1.0, drop / (2 * HALF))))
    assert math.atan2(gone[1], gone[0]) == pytest.approx(normal, abs=math.radians(6))


def test_what_is_knocked_over_and_what_leaves_the_image() -> None:
    candle = seen("candle", "cylinder", CAMERA.box(outline("cylinder", (0.0, 3.0), 0.05, 0.6)))
    crate = seen("crate", "box", CAMERA.box(outline("box", (0.0, 3.0), 0.25, 0.2)))
    for other, tips in ((candle, 1), (crate, 0)):
        _, events = ran([ball("one", -0.9), other], speed=2.5)
        assert answer(events, "tips", target=1) == tips
        assert answer(events, "moves", target=1) == 1
    _, alone = ran([ball("one", -0.9)], speed=2.5)
    assert answer(alone, "leaves") == 1
    assert alone.gone[0, 0] == pytest.approx((0.9 + _edge()) / 2.5, abs=0.1)
    slow = ran([ball("one", -0.9)], speed=0.1)[1]
    assert slow.gone[0, 0] == pytest.approx((0.9 + _edge()) / 0.1, abs=0.5), "however long the clip is"
    assert answer(ran([ball("one", -0.9)], speed=0.0)[1], "leaves") == 0


def test_the_share_of_an_ensemble() -> None:
    rows = ensemble(9)
    _, events = ran([ball("one", -0.9), ball("two", -0.2), ball("three", 0.4)], rows)
    found = decide(Query(Asked(relation="touches"), target=2, subject=1), events, rows)
    assert found.probability == pytest.approx(float(np.isfinite(events.of[1].times["touches"][:, 2]).mean()))
    assert found.probability is not None
    assert found.probability > 0.8


def test_who_set_what_in_motion_and_when() -> None:
    shapes = [rigid(starts=True), rigid(), rigid(), rigid(), rigid()]
    meetings = [Meeting(1.0, 1, 2, 0.0), Meeting(0.5, 0, 1, 0.0), Meeting(0.2, 2, 3, 0.0), Meeting(0.1, 0, None, 0.0)]
    run = WorldRun(np.zeros((5, 1, 3)), np.zeros((5, 1, 3)), np.zeros((5, 1, 4)), meetings, {0, 1, 2})
    assert set_off(shapes, run) == {0: 0.0, 1: 0.5, 2: 1.0}


def test_the_facts_tell_of_what_was_set_in_motion() -> None:
    def path(body: int, moves: float) -> dict[str, Any]:
        states = [(moves * s / 10, 0, 3, 0, 0, 0) for s in range(11)]
        points = [(float(100 + 10 * moves * s), 50.0) for s in range(11)]
        ones: dict[str, Any] = {"visible": [True] * 11, "scale": [1.0] * 11, "tracks": [points]}
        return {"body": body, "states": states, "points": points} | ones

    names = ("blue ball", "cyan ball", "white ball")
    same = {"bbox": (0, 0, 9, 9), "shape": "sphere", "size": (0.3, 0.3, 0.3), "position": (0, 0, 3)}
    bodies = [same | {"object": n, "support": "floor", "source": "mllm", "confidence": 1} for n in names]
    touch = {"object": "cyan ball", "bbox": (0, 0, 9, 9), "body": 1, "kind": "touches", "first_frame": 4}
    chain = {"object": "white ball", "bbox": (0, 0, 9, 9), "body": 2, "subject": 1, "kind": "touches", "first_frame": 8}
    asked = {"relation": "touches", "target": "white ball", "subject": "cyan ball"}
    outcome = {"asked": asked, "subject": "cyan ball", "object": "white ball", "sure": True, "robust": True}
    given: dict[str, Any] = {
        "law": "contact", "fps": 10, "anchors": (), "bodies": bodies, "paths": [path(0, 1.0), path(1, -1.0)],
        "encounters": [touch, chain], "outcome": outcome | {"probability": 0.9}, "ensemble": 50,
    }  # fmt: skip
    story = Story("blue ball", Trajectory.model_validate(given), phrases_of("en")).text()
    assert story == (
        "The blue ball rolls to the right and hits and pushes the cyan ball after about 0.4 s. The cyan ball rolls to "
        "the left and hits the white ball after about 0.8 s."
    )
    given |= {"encounters": [touch], "outcome": outcome | {"probability": 0.1}}
    missed = Story("blue ball", Trajectory.model_validate(given), phrases_of("en")).text()
    assert missed.endswith("The cyan ball rolls to the left and misses the white ball.")


def _edge() -> float:
    """Where the way of a ball's middle leaves the image at the right, m."""
    rights = np.linspace(0, 4, 400)
    seen_at = CAMERA.seen(np.array([[right, HALF, 3.0] for right in rights]))[:, 0]
    return float(rights[np.argmax(seen_at > CAMERA.size[0])])
