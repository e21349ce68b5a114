"""What is put somewhere before another motion: its new place, the result of the motion, and how it is drawn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawn import Image, ball, block, bowl, floor
from hypothesis import given, settings
from hypothesis import strategies as st
from runs import run_of

from cow_service.errors import CannotGround, CowError
from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import CutoutGenerator, create
from cow_service.media.images import decode_own
from cow_service.narration.summary import narrate
from cow_service.physics.draws import ensemble
from cow_service.physics.engine import RigidShape, run_worlds
from cow_service.physics.placement import PlacementGoal, settle
from cow_service.records import Clip, Trajectory
from cow_service.settings import Settings
from cow_service.stages.generation import generate
from cow_service.stages.grounding import ground
from cow_service.stages.keys import StageResult
from cow_service.stages.motion import read_motion
from cow_service.stages.run import Run
from cow_service.stages.trajectory import compute_trajectory
from cow_service.vision.openings import SeenOpening

pytestmark = pytest.mark.slow

RED, BLUE, GREEN, YELLOW = (200, 30, 30), (40, 60, 200), (40, 160, 60), (210, 190, 40)
MOVER, CUBE, POST = (80, 255, 130, 305), (430, 230, 510, 330), (300, 90, 350, 150)
BOWL = (349.0, 204.0, 492.0, 309.0)
OBJECTS = ({"object": "cube", "bbox": CUBE, "shape": "box"}, {"object": "post", "bbox": POST, "shape": "box"})
WHOLE: dict[str, Any] = {"frames": {"indices": [0, 24], "max_side": None}}
RIGHT = {"kind": "linear", "direction": (1, 0), "speed": 200}


def picture() -> Image:
    image = block(block(floor(), CUBE, BLUE), POST, GREEN)
    return ball(image, (105, 280), 25, RED)


def with_bowl() -> Image:
    image = block(bowl(floor(), (420, 240), 70, 50, BLUE), POST, GREEN)
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


def computed(wanted: Run) -> StageResult[Trajectory]:
    grounded = ground(wanted).value
    return compute_trajectory(wanted, grounded, read_motion(wanted, grounded, None).value)


def story_of(wanted: Run) -> str:
    told = computed(wanted).value
    return narrate(ground(wanted).value, told, "en").story


def clip_of(wanted: Run) -> tuple[Trajectory, Clip]:
    grounded = ground(wanted).value
    motion = read_motion(wanted, grounded, None).value
    told = compute_trajectory(wanted, grounded, motion).value
    return told, generate(wanted, grounded, motion, told).value


def pixels(wanted: Run, artifact: Any) -> Image:
    return decode_own(wanted.backends.artifacts.read(artifact.sha256))


class TestWorlds:
    def test_the_mover_meets_what_was_put_in_its_way(self) -> None:
        result = computed(run(put("Post", "left-of", "the cube")))
        told, factual = result.value, result.value.factual
        assert factual is not None
        assert (told.placement, told.placed[0].object, told.placed[0].result) == (None, "post", "beside")
        assert (told.placed[0].visible, result.warnings) == (1, ())
        assert next(each.object for each in told.encounters if each.kind == "touches") == "post"
        assert told.outcome is not None
        assert factual.outcome is not None
        assert (told.outcome.probability, factual.outcome.probability) == (pytest.approx(1, abs=0.2), pytest.approx(0))
        story = story_of(run(put("Post", "left-of", "the cube")))
        assert story.startswith("With the post to the left of the cube: The red ball rolls to the right")
        assert ". As it is: The red ball rolls to the right, hits" in story
        body = told.placed[0].body
        assert factual.bodies[body].bbox == POST
        x0, y0, x1, y1 = told.bodies[body].bbox
        assert 130 < x0 < x1 < 430
        assert y1 == pytest.approx(CUBE[3], abs=25)
        assert x1 - x0 > 1.1 * (POST[2] - POST[0]), "it is nearer to the camera"
        path = next(each for each in told.paths if each.body == body)
        assert (path.scale[0], path.points[0]) == (1, pytest.approx(((x0 + x1) / 2, (y0 + y1) / 2), abs=4))

    def test_one_after_the_other_and_with_something_taken_away(self) -> None:
        image = block(picture(), (540, 120, 590, 180), YELLOW)
        objects = (*OBJECTS, {"object": "lid", "bbox": (540, 120, 590, 180), "shape": "box"})
        question = "Would the ball hit the post?"
        changes = ({"kind": "remove", "object": "lid"}, put("post", "onto", "cube"))
        told = computed(run(*changes, image=image, objects=objects, question=question)).value
        assert {each.object for each in told.bodies} == {"red ball", "cube", "post"}
        assert next(each for each in told.bodies if each.object == "post").support == "cube"
        story = story_of(run(*changes, image=image, objects=objects, question=question))
        assert story.startswith("With the post on the cube and without the lid: The red ball")
        stacked = computed(
            run(put("post", "left-of", "cube"), put("lid", "onto", "post"), image=image, objects=objects)
        )
        lid, post = (next(each for each in stacked.value.bodies if each.object == name) for name in ("lid", "post"))
        assert lid.support == "post"
        assert lid.position[0] == pytest.approx(post.position[0], abs=0.1)

    def test_whether_it_makes_a_difference(self) -> None:
        question = "Would the outcome change if the post were put to the left of the cube and the ball rolls right?"
        told = computed(run(put("post", "left-of", "cube"), question=question)).value
        assert told.outcome is not None
        assert (told.outcome.asked.form, told.outcome.probability) == ("changes", pytest.approx(1, abs=0.2))

    def test_in_front_of_what_sets_out_is_where_it_goes(self) -> None:
        result = computed(run(put("post", "in-front-of", "red ball")))
        assert result.value.placed[0].by_heading
        assert any("relative to the direction of motion" in warning for warning in result.warnings)
        assert next(each.object for each in result.value.encounters if each.kind == "touches") == "post"

    def test_what_stood_on_it_falls(self) -> None:
        cap = {"object": "cap", "bbox": (310, 50, 340, 95), "shape": "cylinder", "stands_on": "post"}
        image = block(picture(), (310, 50, 340, 95), YELLOW)
        told = computed(run(put("post", "left-of", "cube"), image=image, objects=(*OBJECTS, cap))).value
        index = next(i for i, body in enumerate(told.bodies) if body.object == "cap")
        assert told.bodies[index].support == "air"
        path = next(each for each in told.paths if each.body == index)
        assert path.states[-1][1] > path.states[0][1]

    def test_the_mover_can_be_put_somewhere_before_it_moves(self) -> None:
        told, clip = clip_of(wanted := run(put("red ball", "onto", "cube"), video=False, **WHOLE))
        assert told.bodies[0].support == "cube"
        x, y = told.path.points[0]
        assert CUBE[0] < x < CUBE[2]
        assert y < CUBE[1] + 20
        assert told.path.points[24][0] > x + 50
        first = pixels(wanted, clip.frames[0])
        assert is_red(first[int(y), int(x)])
        assert not is_red(first[280, 105])


class TestWhatCannotBe:
    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ((put("post", "between", "red ball", "cube"),), "no room"),
            ((put("cube", "onto", "red ball"),), "falls off"),
            ((put("post", "into", "cube"),), "not an open container"),
            ((put("lamp", "next-to", "cube"),), "'lamp'"),
        ],
    )
    def test_is_refused_by_name(self, changes: Any, words: str) -> None:
        image, objects = picture(), OBJECTS
        if changes[0]["relation"] == "between":
            near = (150, 240, 230, 330)
            image = block(ball(block(floor(), POST, GREEN), (105, 280), 25, RED), near, BLUE)
            objects = ({"object": "cube", "bbox": near, "shape": "box"}, OBJECTS[1])
        with pytest.raises(CowError, match=words):
            computed(run(*changes, image=image, objects=objects))

    def test_nothing_is_put_to_what_is_seen_going_somewhere(self) -> None:
        changes = put("red ball", "left-of", "cube"), put("post", "onto", "red ball")
        with pytest.raises(CannotGround, match="put somewhere itself"):
            computed(run(*changes, motion={"kind": "place"}))

    def test_a_given_path_does_not_begin_elsewhere(self) -> None:
        path = {"points": [(105, 280), (300, 280)], "fps": 16}
        with pytest.raises(CannotGround, match="begins where the image shows it"):
            computed(run(put("red ball", "onto", "cube"), motion=None, trajectory=path))

    def test_what_is_not_seen_there_is_told(self) -> None:
        wide = {"object": "wall", "bbox": (300, 60, 620, 345), "shape": "box"}
        image = block(ball(floor(), (105, 280), 25, RED), (300, 60, 620, 345), BLUE)
        small = {"object": "peg", "bbox": (200, 290, 230, 330), "shape": "box"}
        result = computed(run(put("peg", "behind", "wall"), image=block(image, (200, 290, 230, 330), GREEN),
                              objects=(wide, small)))  # fmt: skip
        assert result.value.placed[0].visible < 0.25
        assert any("hardly visible" in warning for warning in result.warnings)


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

    def test_what_is_in_a_container_is_behind_its_front_and_goes_with_it(self) -> None:
        objects = ({"object": "bowl", "bbox": BOWL}, {"object": "egg", "bbox": (310, 110, 350, 150), "shape": "sphere"})
        image = ball(bowl(floor(), (420, 240), 70, 50, BLUE), (330, 130), 20, GREEN)
        image = ball(image, (105, 280), 25, RED)
        frames = {"indices": [0, 48], "max_side": None}
        fast = RIGHT | {"speed": 1000}
        wanted = run(put("egg", "into", "bowl"), image=image, objects=objects, video=False, frames=frames, motion=fast)
        told, clip = clip_of(wanted)
        assert told.placed[0].result == "inside"
        egg, pushed = told.placed[0].body, next(each for each in told.paths if told.bodies[each.body].object == "bowl")
        (x0, y0, x1, _), (x, y) = told.bodies[egg].bbox, pushed.points[0]
        assert 349 < x0 < x1 < 492
        assert pushed.points[48][0] > x + 15
        for frame in clip.frames:
            shown, right = pixels(wanted, frame), round(pushed.points[frame.index][0] - x)
            down = round(pushed.points[frame.index][1] - y)
            assert is_green(shown[int(y0) + 6 + down, int((x0 + x1) / 2) + right])
            assert not is_green(shown[285 + down, 385 + right : 455 + right]).any(), "the wall below the nearer rim"

    def test_a_video_model_is_given_the_changed_scene(self) -> None:
        model = VideoModel()
        wanted = run(put("post", "left-of", "cube"), generator=model, frames={"indices": [0, 5]}, video=False)
        told, clip = clip_of(wanted)
        assert (len(model.given), clip.factual_frames) == (1, ())
        x0, y0, x1, y1 = (round(side) for side in told.bodies[told.placed[0].body].bbox)
        (given_to_model,) = model.given
        for image in (given_to_model.scene.clean, given_to_model.scene.image):
            assert is_green(image[y0 + 25 : y1 - 25, x0 + 30 : x1 - 30]).mean() > 0.95
            assert not is_green(image[POST[1] + 5 : POST[3] - 5, POST[0] + 5 : POST[2] - 5]).any()
        obstacle = next(each for each in given_to_model.obstacles if each.name == "post")
        assert obstacle.mask.contains((x0 + x1) // 2, (y0 + y1) // 2)


class VideoModel(CutoutGenerator):
    """A generator on a device of its own, which notes what it is given."""

    concurrency = 1

    def __init__(self) -> None:
        self.given: list[GeneratorInput] = []

    def render(self, given: GeneratorInput, indices: Any, progress: Any) -> Any:
        self.given.append(given)
        return super().render(given, indices, progress)


def is_red(pixel: Any) -> Any:
    return pixel[..., 0].astype(int) > pixel[..., 2].astype(int) + 40


def is_green(pixel: Any) -> Any:
    return pixel[..., 1].astype(int) > np.maximum(pixel[..., 0], pixel[..., 2]).astype(int) + 25


SHAPES = st.sampled_from(["sphere", "box", "cylinder"])
SIZES = st.floats(0.05, 0.4)


@settings(max_examples=25, deadline=None)
@given(
    SHAPES, SIZES, SIZES, st.sampled_from(["box", "cylinder"]), SIZES, SIZES,
    st.sampled_from(["onto", "into", "next-to", "behind", "left-of"]),
)  # fmt: skip
def test_what_stays_where_it_is_put_begins_at_rest(
    shape: Any, half: float, tall: float, target: Any, width: float, height: float, relation: Any
) -> None:
    """No part of it lies in another thing, so that it gains no energy when all are released."""
    tall = half if shape == "sphere" else tall
    mover = RigidShape("sphere", 0.15, 0.15, 0.15, (-3.0, 0.15, 3.0))
    under = RigidShape(target, width, width, height, (0.0, height, 3.0))
    thing = RigidShape(shape, half, half, tall, (2.5, tall, 3.0))
    opening = SeenOpening(0.9, 0.05, 0.7, None, False, has_edge=True) if relation == "into" else None
    places = PlacementGoal(relation, (1,), opening, body=2)
    draws = ensemble(3)
    settled = settle((places,), ((mover, under, thing),) * 3, draws, 24.0)
    stay = [shapes for shapes, stays in zip(settled.shapes, settled.placements[0].stays, strict=True) if stays]
    for shapes in stay:
        freed = [replace(body, starts=True, falls=True) for body in shapes]
        (told,) = run_worlds([freed], 13, 24.0, turns_wanted=True)
        energy = 0.5 * (told.velocities**2).sum(axis=2) + 9.81 * told.positions[:, :, 1]
        assert energy.max(axis=1) - energy[:, 0] == pytest.approx(0, abs=0.02)
        assert np.linalg.norm(told.positions[2] - told.positions[2, :1], axis=1).max() < 0.25 * half
