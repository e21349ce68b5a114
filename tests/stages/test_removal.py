"""Something is taken away before the motion: where it is found, what happens without it and with it, and its frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawn import ball, block, floor
from refusals import refused
from runs import run_of
from staged import BLUE, GREEN, RED, YELLOW, VideoModel, clip_of, computed, pixels

from cow_service.generators.cutout import create
from cow_service.media.types import Image
from cow_service.physics.ensemble import run_ensemble
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.settings import Settings
from cow_service.stages.grounding import ground, look_again
from cow_service.stages.motion import settle_motion
from cow_service.stages.reconstruction import reconstruct
from cow_service.stages.run import Run
from cow_service.stages.seeing import see
from cow_service.stages.trajectory import judge

MOVER, GOAL, BETWEEN = (80, 210, 130, 260), (480, 196, 550, 274), (280, 200, 350, 272)
THERE = slice(BETWEEN[1] - 8, BETWEEN[3] + 8), slice(BETWEEN[0] - 8, BETWEEN[2] + 8)
QUESTION = "Will the ball hit the cube?"
ALL = ({"object": "cube", "bbox": GOAL, "shape": "box"}, {"object": "Green  block", "bbox": BETWEEN, "shape": "box"})
ASIDE = {"object": "yellow block", "bbox": (300, 40, 350, 90), "shape": "box"}
REMOVE = ({"kind": "remove", "object": "the green block"},)


def picture(*, with_block: bool = True) -> Image:
    image = block(floor(640, 400), GOAL, BLUE)
    image = block(image, BETWEEN, GREEN) if with_block else image
    image = block(image, ASIDE["bbox"], YELLOW)
    return ball(image, (105, 235), 25, RED)


def off_bare(image: Image) -> float:
    """How far the place of the block is from the floor behind it, in grey levels."""
    return float(np.abs(image[THERE].astype(int) - picture(with_block=False)[THERE].astype(int)).mean())


def run(interventions: Any = REMOVE, objects=ALL, generator: Any = None, **request: Any) -> Run:
    motion = {"kind": "linear", "direction": (1, 0), "speed": 200}
    asked = {"question": QUESTION, "num_frames": 49, "ensemble": 15} | request
    given = {"grounding": {"object": "red ball", "bbox": MOVER}, "motion": motion, "objects": objects}
    made_by = generator or create(Settings())
    return run_of(picture(), generator=lambda: made_by, **given | {"interventions": interventions} | asked)


def test_without_it_the_mover_gets_to_what_is_behind_it() -> None:
    wanted = run(camera={"pitch": 28, "focal": 640})
    grounding, told = ground(wanted).value, computed(wanted).value
    assert [each.object.object for each in grounding.interventions] == ["Green  block"]
    assert [other.object for other in grounding.others] == ["cube"]
    factual = told.factual
    assert (factual.factual, factual.anchors, bool(told.anchors)) == (None, (), True)
    assert {body.object for body in factual.bodies} - {body.object for body in told.bodies} == {"Green  block"}
    assert (told.outcome.probability, factual.outcome.probability) == (pytest.approx(1), pytest.approx(0))
    assert [each.object for each in told.encounters if each.kind == "touches"] == ["cube"]
    assert next(each.object for each in factual.encounters if each.kind == "touches") == "Green  block"
    assert told.bodies[0].position == factual.bodies[0].position, "both worlds have the same draws"
    assert computed(run(interventions=(), ensemble=0)).value.factual is None, "nothing is taken away"


def test_which_one_to_take_away_is_told_of_each_in_the_scene_with_all() -> None:
    asked = {"form": "which-to-remove", "relation": "touches", "target": "cube", "negated": True}
    known = {"interventions": (), "camera": {"pitch": 28, "focal": 640}, "objects_complete": True}
    for among in ((), ("cube", "green block", "yellow block")):
        told = computed(run(objects=(*ALL, ASIDE), asked=asked | {"among": among}, **known)).value
        assert told.outcome.asked.among == tuple({"green block": "Green  block"}.get(name, name) for name in among)
        found = {each.object: (each.probability, each.sure) for each in told.outcome.candidates}
        assert found == {"cube": (0, True), "Green  block": (1, True), "yellow block": (0, True)}
        assert (told.outcome.as_it_is, told.outcome.sure, told.outcome.object) == (1, True, "cube")
        assert next(each.object for each in told.encounters if each.kind == "touches") == "Green  block"
        assert (len(told.bodies), told.factual) == (4, None), "what is shown has all of them"
    # Taken away for good, it is no reason any more; what would be hit without it is the cube.
    told = computed(
        run(objects=(*ALL, ASIDE), asked=asked | {"negated": False}, **known | {"interventions": REMOVE})
    ).value
    assert {each.object: each.probability for each in told.outcome.candidates} == {"cube": 1, "yellow block": 0}
    assert (told.factual.outcome.asked.form, told.factual.outcome.probability) == ("whether", 0)


def test_what_is_not_seen_clearly_makes_that_candidate_unsure_and_the_whole() -> None:
    asked = {"form": "which", "relation": "touches", "among": ("cube", "green block")}
    wanted = run(interventions=(), asked=asked, camera={"pitch": 28, "focal": 640}, objects_complete=True)
    grounding = ground(wanted).value
    situation = see(wanted, look_again(wanted, grounding), grounding, settle_motion(wanted, grounding, None).value)
    world, query, _ = reconstruct(situation)
    (result,) = run_ensemble(world, query, 15)
    for blurred, sure in ((None, [True, True]), (GOAL, [False, True]), (MOVER, [False, False])):
        bodies = tuple(replace(each, confidence=0.5 if each.bbox == blurred else 0.9) for each in result.world.bodies)
        outcome = judge(situation, replace(result, world=replace(result.world, bodies=bodies)))
        assert [each.sure for each in outcome.candidates] == sure
        assert (outcome.sure, outcome.depends_on[:1]) == (blurred is None, () if blurred is None else ("outline",))


CUBE_ONTO = {"kind": "place", "object": "cube", "relation": "onto"}


@pytest.mark.parametrize(
    ("interventions", "pointer"),
    [
        (({"kind": "remove", "object": "bowl"},), "/interventions/0/object"),
        (({"kind": "remove", "object": "RED ball"},), "/interventions/0"),
        ((*REMOVE, {"kind": "remove", "object": "GREEN BLOCK"}), "/interventions/1"),
        ((CUBE_ONTO | {"relation": "into", "targets": ("the cube",)},), "/interventions/0"),
        ((CUBE_ONTO | {"targets": ("lid",)},), "/interventions/0/targets/0"),
        ((*REMOVE, CUBE_ONTO | {"targets": ("green block",)}), "/interventions/1"),
        ((CUBE_ONTO | {"targets": ("green block",)}, *REMOVE), "/interventions/1"),
        ((CUBE_ONTO | {"targets": ("green block",)}, CUBE_ONTO | {"targets": ("red ball",)}), "/interventions/1"),
    ],
)
def test_what_cannot_be_done_is_refused(interventions: Any, pointer: str) -> None:
    with refused("invalid-request", pointer):
        ground(run(interventions=interventions))


def test_the_question_says_it_of_objects_that_are_given() -> None:
    question = "If the green block is removed and the red ball rolls right, will it hit the cube?"
    for said in (None, REMOVE):
        (removed,) = ground(run(interventions=said, question=question)).value.interventions
        assert (removed.kind, removed.object.object, removed.object.bbox) == ("remove", "Green  block", BETWEEN)
    with refused("invalid-request", "/objects"):
        ground(run(interventions=None, objects=ALL[:1], question=question))


@pytest.mark.parametrize("is_located", [True, False], ids=["the words say it", "the reader says it"])
def test_an_empty_list_takes_nothing_away_whatever_the_question_says(is_located: bool) -> None:
    question = "If the green block is removed and the red ball rolls right, will it hit the blue cube?"
    given = {} if is_located else {"grounding": None, "motion": None, "objects": (), "reader": EmbeddedReader}
    assert len(ground(run(interventions=None, question=question, **given)).value.interventions) == 1
    assert ground(run(interventions=(), question=question, **given)).value.interventions == ()


class TestFrames:
    def test_it_is_gone_from_the_frames_and_there_in_those_of_the_scene_as_it_is(self) -> None:
        wanted = run(video=False, frames={"indices": [0, 10], "max_side": None})
        _, clip = clip_of(wanted)
        assert [each.index for each in clip.factual_frames] == [each.index for each in clip.frames] == [0, 10]
        changed, factual = (pixels(wanted, frames[0]) for frames in (clip.frames, clip.factual_frames))
        bare = picture(with_block=False)[THERE].astype(int)
        assert np.abs(changed[THERE].astype(int) - bare).max() < 40
        assert off_bare(changed) < 5
        assert off_bare(factual) > 30
        x0, y0, x1, y1 = BETWEEN
        away = np.ones(changed.shape[:2], bool)
        away[y0 - 30 : y1 + 30, x0 - 60 : x1 + 60] = False
        assert np.array_equal(changed[away], picture()[away]), "nothing else is changed"
        marked = np.abs(pixels(wanted, clip.overlay)[y0:y1, x0:x1].astype(int) - (255, 120, 120)) < 30
        assert 0.05 < marked.all(axis=2).mean() < 0.5, "the overlay marks it"

    def test_frames_of_the_scene_as_it_is_can_be_left_out(self) -> None:
        frames = {"indices": [0], "factual": False}
        assert clip_of(run(ensemble=0, video=False, frames=frames))[1].factual_frames == ()

    @pytest.mark.parametrize(("factual", "clips"), [(None, 1), (True, 2)])
    def test_a_video_model_is_given_the_scene_without_it(self, factual: bool | None, clips: int) -> None:
        model = VideoModel()
        frames = {"indices": [0, 10], "factual": factual}
        _, clip = clip_of(run(generator=model, ensemble=0, video=False, frames=frames))
        assert len(model.given) == clips, "what it costs is doubled only where that is asked for"
        assert len(clip.factual_frames) == (2 if factual else 0)
        first = model.given[0].scene
        assert off_bare(first.clean) < 5
        assert off_bare(first.image) < 5
        assert first.mover.full().any()
