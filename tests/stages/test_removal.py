"""Something is taken away before the motion: where it is found, what happens without it and with it, and its frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawn import ball, block, floor
from floors import TrueCamera, known, outline
from runs import run_of

from cow_service.errors import InvalidRequest
from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import CutoutGenerator, create
from cow_service.media.images import decode_own
from cow_service.narration.summary import narrate
from cow_service.physics.bodies import SeenBody
from cow_service.physics.draws import ensemble, likeliest
from cow_service.physics.ensemble import Query, run_ensemble
from cow_service.physics.events import find_world_events
from cow_service.physics.world import WorldInput, run_world
from cow_service.records import Asked, Clip, Frame, Grounding, MetresPerPixel, Motion, Trajectory
from cow_service.settings import Settings
from cow_service.stages.generation import generate
from cow_service.stages.grounding import ground
from cow_service.stages.motion import read_motion
from cow_service.stages.run import Run
from cow_service.stages.trajectory import compute_trajectory
from cow_service.vision.masks import CroppedMask
from cow_service.vision.types import Image

RED, BLUE, GREEN = (200, 30, 30), (40, 60, 200), (40, 160, 60)
MOVER, GOAL, BETWEEN = (80, 210, 130, 260), (480, 196, 550, 274), (280, 200, 350, 272)
QUESTION = "Will the ball hit the cube?"
ALL = ({"object": "cube", "bbox": GOAL, "shape": "box"}, {"object": "Green  block", "bbox": BETWEEN, "shape": "box"})
REMOVE = ({"kind": "remove", "object": "the green block"},)


def picture(*, with_block: bool = True) -> Image:
    image = block(floor(640, 400), GOAL, BLUE)
    image = block(image, BETWEEN, GREEN) if with_block else image
    return ball(image, (105, 235), 25, RED)


def run(interventions=REMOVE, objects=ALL, generator: Any = None, **request: Any) -> Run:
    motion = {"kind": "linear", "direction": (1, 0), "speed": 200}
    asked = {"question": QUESTION, "num_frames": 49, "ensemble": 15} | request
    given = {"grounding": {"object": "red ball", "bbox": MOVER}, "motion": motion, "objects": objects}
    backend = {} if generator is None else {"generator": lambda: generator}
    return run_of(picture(), **backend, **given, interventions=interventions, **asked)


def simulated(**given: Any) -> tuple[Grounding, Trajectory]:
    wanted = run(**given)
    grounded = ground(wanted).value
    return grounded, compute_trajectory(wanted, grounded, read_motion(wanted, grounded, None).value).value


class TestWorlds:
    def test_without_it_the_mover_gets_to_what_is_behind_it(self) -> None:
        grounding, told = simulated(camera={"pitch": 28, "focal": 640})
        assert [each.object.object for each in grounding.interventions] == ["Green  block"]
        assert [other.object for other in grounding.others] == ["cube"]
        factual = told.factual
        assert factual is not None
        assert (factual.factual, factual.anchors, bool(told.anchors)) == (None, (), True)
        assert {body.object for body in factual.bodies} - {body.object for body in told.bodies} == {"Green  block"}
        assert told.outcome is not None
        assert factual.outcome is not None
        assert (told.outcome.probability, factual.outcome.probability) == (pytest.approx(1), pytest.approx(0))
        assert [each.object for each in told.encounters if each.kind == "touches"] == ["cube"]
        story = narrate(grounding, told, "en").story
        assert story.startswith("Without the Green block: The red ball rolls to the right, hits")
        assert ". As it is: The red ball rolls to the right, hits and pushes the Green block" in story
        first, same = (told.bodies[0].position, factual.bodies[0].position)
        assert first == same, "both worlds have the same draws"

    def test_where_nothing_is_taken_away_there_is_one_world(self) -> None:
        assert simulated(interventions=())[1].factual is None

    def test_what_stood_on_it_falls(self) -> None:
        camera, half = TrueCamera(pitch=25, height=1.5), 0.12
        bodies = [_drawn("ball", "sphere", camera.sphere_box((-1.2, half, 3.0), half))]
        raised = outline("cylinder", (0.6, 3.2), 0.08, 0.16) + np.array([0.0, 0.4, 0.0])
        bodies.append(_drawn("cup", "cylinder", camera.box(raised)))
        table = _drawn("table", "box", camera.box(outline("box", (0.6, 3.2), 0.4, 0.4)))
        still = _moving(camera, half).model_copy(update={"kind": "static", "direction": None, "speed": 0.0})
        world = WorldInput(tuple(bodies), still, known(camera), camera.size, 33, 16.0, removed=(table,))
        assert run_world(world.as_it_is(), likeliest()).layout.supports[1] == 2
        fallen, kept = run_world(world, likeliest()), run_world(world.as_it_is(), likeliest())
        assert fallen.runs[0].positions[1, 0, 1] == pytest.approx(kept.runs[0].positions[1, 0, 1])
        assert fallen.runs[0].positions[1, -1, 1] < fallen.runs[0].positions[1, 0, 1] - 0.3
        assert kept.runs[0].positions[1, -1, 1] == pytest.approx(kept.runs[0].positions[1, 0, 1], abs=0.01)
        events = find_world_events(fallen, bodies, likeliest(), camera.size)
        assert np.isfinite(events.moved[0, 1])

    @pytest.mark.parametrize(("negated", "likely"), [(False, 1.0), (True, 0.0)])
    def test_whether_it_makes_a_difference(self, negated: bool, likely: float) -> None:
        camera, half = TrueCamera(pitch=25, height=1.5), 0.12
        mover = _drawn("ball", "sphere", camera.sphere_box((-1.2, half, 3.0), half))
        post, vase = (
            _drawn(name, "cylinder", camera.box(outline("cylinder", (right, ahead), 0.12, 0.35)))
            for name, right, ahead in (("post", 0.9, 3.0), ("vase", -0.2, 3.0))
        )
        far = _drawn("far", "cylinder", camera.box(outline("cylinder", (0.0, 4.2), 0.12, 0.35)))
        for taken, other, changes in ((vase, far, likely), (far, vase, 1 - likely)):
            bodies = (mover, post, other)
            world = WorldInput(bodies, _moving(camera, half), known(camera), camera.size, 65, 16.0, removed=(taken,))
            asked = Asked(form="changes", relation="touches", target="post", negated=negated)
            changed, factual = run_ensemble(world, Query(asked, target=1), 9)
            assert changed.decided is not None
            assert factual.query is not None
            assert (changed.decided.probability, changed.decided.sure) == (changes, True)
            assert factual.query.asked.form == "whether"


class TestLocating:
    @pytest.mark.parametrize(
        ("interventions", "pointer", "words"),
        [
            (({"kind": "remove", "object": "bowl"},), "/interventions/0/object", "'bowl'"),
            (({"kind": "remove", "object": "RED ball"},), "/interventions/0", "what moves"),
            ((*REMOVE, {"kind": "remove", "object": "GREEN BLOCK"}), "/interventions/1", "twice"),
            (
                ({"kind": "place", "object": "cube", "relation": "into", "targets": ("the cube",)},),
                "/interventions/0",
                "cannot be put into itself",
            ),
            (
                ({"kind": "place", "object": "cube", "relation": "onto", "targets": ("lid",)},),
                "/interventions/0/targets/0",
                "'lid'",
            ),
            (
                (*REMOVE, {"kind": "place", "object": "cube", "relation": "onto", "targets": ("green block",)}),
                "/interventions/1",
                "taken away",
            ),
        ],
    )
    def test_what_cannot_be_done_is_refused(self, interventions: Any, pointer: str, words: str) -> None:
        with pytest.raises(InvalidRequest) as raised:
            ground(run(interventions=interventions))
        (error,) = raised.value.errors
        assert error.pointer == pointer
        assert words in raised.value.detail

    def test_the_question_says_it_of_objects_that_are_given(self) -> None:
        question = "If the green block is removed and the red ball rolls right, will it hit the cube?"
        (removed,) = ground(run(interventions=(), question=question)).value.interventions
        assert (removed.kind, removed.object.object, removed.object.bbox) == ("remove", "Green  block", BETWEEN)
        with pytest.raises(InvalidRequest, match="the question changes 'green block'"):
            ground(run(interventions=(), objects=ALL[:1], question=question))


class TestFrames:
    def clip(self, generator: Any = None, **frames: Any) -> tuple[Run, Clip]:
        wanted = run(
            generator=generator or create(Settings()),
            video=False,
            frames={"indices": [0, 10], "max_side": None} | frames,
        )
        grounded = ground(wanted).value
        motion = read_motion(wanted, grounded, None).value
        told = compute_trajectory(wanted, grounded, motion).value
        return wanted, generate(wanted, grounded, motion, told).value

    def pixels(self, wanted: Run, frame: Frame) -> Image:
        return decode_own(wanted.backends.artifacts.read(frame.sha256))

    def test_it_is_gone_from_the_frames_and_there_in_those_of_the_scene_as_it_is(self) -> None:
        wanted, clip = self.clip()
        assert [each.index for each in clip.factual_frames] == [each.index for each in clip.frames] == [0, 10]
        changed, factual = (self.pixels(wanted, frames[0]) for frames in (clip.frames, clip.factual_frames))
        x0, y0, x1, y1 = BETWEEN
        there = slice(y0 - 8, y1 + 8), slice(x0 - 8, x1 + 8)
        bare = picture(with_block=False)[there].astype(int)
        assert np.abs(changed[there].astype(int) - bare).max() < 40
        assert np.abs(changed[there].astype(int) - bare).mean() < 5
        assert np.abs(factual[there].astype(int) - bare).mean() > 30
        away = np.ones(changed.shape[:2], bool)
        away[y0 - 30 : y1 + 30, x0 - 60 : x1 + 60] = False
        assert np.array_equal(changed[away], picture()[away]), "nothing else is changed"

    def test_frames_of_the_scene_as_it_is_can_be_left_out(self) -> None:
        assert self.clip(factual=False)[1].factual_frames == ()

    @pytest.mark.parametrize(("factual", "clips"), [(None, 1), (True, 2)])
    def test_a_video_model_is_given_the_scene_without_it(self, factual: bool | None, clips: int) -> None:
        model = VideoModel()
        _, clip = self.clip(model, factual=factual)
        assert len(model.given) == clips, "what it costs is doubled only where that is asked for"
        assert len(clip.factual_frames) == (2 if factual else 0)
        x0, y0, x1, y1 = BETWEEN
        bare = picture(with_block=False)[y0:y1, x0:x1].astype(int)
        first = model.given[0].scene
        for image in (first.clean, first.image):
            assert np.abs(image[y0:y1, x0:x1].astype(int) - bare).mean() < 5
        assert first.silhouette(MOVER).any()

    def test_the_overlay_marks_it(self) -> None:
        wanted, clip = self.clip()
        drawn = decode_own(wanted.backends.artifacts.read(clip.overlay.sha256))
        x0, y0, x1, y1 = BETWEEN
        marked = (np.abs(drawn[y0:y1, x0:x1].astype(int) - (255, 120, 120)) < 30).all(axis=2)
        assert 0.05 < marked.mean() < 0.5


class VideoModel(CutoutGenerator):
    """A generator on a device of its own, which notes what it is given."""

    concurrency = 1

    def __init__(self) -> None:
        self.given: list[GeneratorInput] = []

    def render(self, given: GeneratorInput, indices: Sequence[int], progress: Any) -> Iterator[Image]:
        self.given.append(given)
        return super().render(given, indices, progress)


def _drawn(name: str, shape: Any, bbox: Any) -> SeenBody:
    x0, y0, x1, y1 = bbox
    ys, xs = np.mgrid[:400, :640] + 0.5
    return SeenBody(name, bbox, CroppedMask.of((xs >= x0) & (xs < x1) & (ys >= y0) & (ys < y1)), shape)


def _moving(camera: TrueCamera, half: float) -> Motion:
    """To the right at 1.2 m/s, at a scale that makes metres those of the true camera."""
    scale = camera.positions(np.array([[0.0, half, 3.0]]))[0, 2] / camera.focal
    return Motion(
        kind="linear", law="contact", direction=(1.0, 0.0), cue="request", speed=1.2 / scale, sentence="",
        metres_per_pixel=MetresPerPixel(value=scale, source="reference"), source="request",
    )  # fmt: skip


def test_a_world_of_an_ensemble_records_turns_only_where_they_are_wanted() -> None:
    camera, half = TrueCamera(pitch=25, height=1.5), 0.12
    mover = _drawn("ball", "sphere", camera.sphere_box((-1.0, half, 3.0), half))
    candle = _drawn("candle", "cylinder", camera.box(outline("cylinder", (0.0, 3.0), 0.05, 0.6)))
    motion = _moving(camera, half).model_copy(update={"speed": 3 * _moving(camera, half).speed})
    world = WorldInput((mover, candle), motion, known(camera), camera.size, 33, 16.0)
    rows = ensemble(4)
    for wanted in (True, False):
        worlds = run_world(replace(world, turns_wanted=wanted), rows, 2)
        tipped = find_world_events(worlds, world.bodies, rows, camera.size).tipped
        assert np.isfinite(tipped[:, 1]).all() == wanted
        assert not np.isfinite(tipped[:, 0]).any()
