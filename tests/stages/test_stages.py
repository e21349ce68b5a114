"""Each stage on its own: defaults, overrides, and what each refuses."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import pytest
from drawn import ball, floor
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from refusals import refused
from runs import run_of

from cow_service.perception.observation import Observation, look
from cow_service.readers.base import ReadResult
from cow_service.records import (
    Asked,
    Contact,
    Encounter,
    Grounding,
    Motion,
    MotionRequest,
    Outcome,
    Path,
    Reading,
    Trajectory,
)
from cow_service.requests import FramesRequest, SimulateRequest, TrajectoryRequest
from cow_service.stages.generation import choose_frames
from cow_service.stages.grounding import ground
from cow_service.stages.keys import StageResult
from cow_service.stages.motion import settle_motion

POINT = {"point": (200, 200)}


@pytest.fixture(scope="module")
def scene() -> Observation:
    return look(ball(floor(640, 400), (200, 200), 40, (200, 30, 30)))


def run(scene: Observation, **request):
    return run_of(scene.image, **request)


@cache
def grounded(scene: Observation, **place) -> Grounding:
    return ground(run(scene, grounding=place)).value


def moved(scene: Observation, path: TrajectoryRequest | None = None, **motion) -> Motion:
    given = ({"motion": motion} if motion else {}) | ({} if path is None else {"trajectory": path})
    return settle_motion(run(scene, **given), grounded(scene, **POINT), None).value


def test_a_point_grounds_the_object_under_it_and_a_box_is_clipped_to_the_image(scene: Observation) -> None:
    grounding = grounded(scene, point=(220, 190))
    assert grounding.bbox == pytest.approx((160, 160, 240, 240), abs=4)
    assert grounding.point == pytest.approx((200, 200), abs=3)
    assert (grounding.object, grounding.source) == ("object", "request")
    found = ground(run(scene, grounding={"bbox": (150, 150, 250, 250), "object": "ball"}))
    assert (found.value.bbox, found.value.object, found.warnings) == ((150, 150, 250, 250), "ball", ())
    beyond = ground(run(scene, grounding={"bbox": (-50, 150, 250, 250)}))
    assert (beyond.value.bbox, len(beyond.warnings)) == ((0, 150, 250, 250), 1)


@pytest.mark.parametrize(
    "given",
    [{"bbox": (-900, -900, 9000, 9000)}, {"bbox": (638.5, 10, 800, 90)}, {"point": (640, 10)}, {"point": (10, 400)}],
    ids=["all of the image", "a box outside", "beside it", "below it"],
)
def test_a_place_all_over_the_image_or_outside_is_refused(scene: Observation, given) -> None:
    with refused("invalid-request", f"/grounding/{next(iter(given))}"):
        grounded(scene, **given)


def test_defaults_of_speed_scale_and_gravity(scene: Observation) -> None:
    linear = moved(scene, direction=(3, 4))
    assert linear.direction == pytest.approx((0.6, 0.8))
    assert linear.speed == pytest.approx(0.26 * 640)
    assert linear.gravity == (0, 0)
    thrown = moved(scene, direction=(1, 0), kind="projectile")
    assert thrown.metres_per_pixel.value == pytest.approx(3 / 640)
    assert thrown.metres_per_pixel.source == "default"
    assert thrown.gravity == pytest.approx((0, 9.81 * 640 / 3))
    fall = moved(scene, kind="fall", metres_per_pixel=0.01)
    assert (fall.direction, fall.speed) == (None, 0)
    assert fall.gravity == pytest.approx((0, 981))
    assert fall.metres_per_pixel.source == "request"


def test_a_given_path_is_a_motion(scene: Observation) -> None:
    path = TrajectoryRequest(points=((200, 200), (300, 200), (300, 300)), fps=2)
    motion = moved(scene, path=path)
    assert (motion.kind, motion.speed) == ("linear", pytest.approx(200))
    assert motion.direction == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))
    assert moved(scene, path=TrajectoryRequest(points=((0, 0), (0, 9), (0, 0)))).direction == (0, 1), "its first move"
    assert moved(scene, path=TrajectoryRequest(points=((5, 5), (5, 5)))).kind == "static"


def plain(frames: int, encounters: tuple[int, ...] = (), seen: int | None = None, **more) -> Trajectory:
    visible = tuple(i < (frames if seen is None else seen) for i in range(frames))
    met = tuple(Encounter(object="o", bbox=(0, 0, 1, 1), first_frame=i, kind="touches") for i in encounters)
    zero = ((0.0, 0.0),) * frames
    path = Path(states=((0.0,) * 6,) * frames, points=zero, visible=visible, scale=(1.0,) * frames, tracks=(zero,))
    return Trajectory(fps=16, paths=(path,), anchors=(), encounters=met, **more)


def test_frame_policies() -> None:
    assert choose_frames(FramesRequest(policy="initial", count=3), plain(81)) == (1, 3, 5)
    assert choose_frames(FramesRequest(policy="uniform", count=3), plain(81)) == (0, 40, 80)
    assert choose_frames(FramesRequest(policy="uniform", count=1), plain(81)) == (80,)
    # By default: before, at and after what matters, and the end.
    assert choose_frames(FramesRequest(), plain(81, (30,))) == (15, 30, 55, 80)
    assert choose_frames(FramesRequest(), plain(81, (12, 30, 50))) == (6, 12, 30, 80)
    assert choose_frames(FramesRequest(count=1), plain(81, (12,))) == (12,)
    assert choose_frames(FramesRequest(), plain(81, (12,), seen=40)) == (6, 12, 25, 39)
    assert max(choose_frames(FramesRequest(), plain(81, seen=40))) == 39
    assert choose_frames(FramesRequest(indices=(7, 3, 3)), plain(81)) == (3, 7)


def test_event_frames_show_contacts_that_no_other_frame_shows_and_what_is_asked_about_first() -> None:
    def at(time: float, b: int | None) -> Contact:
        return Contact(a=0, b=b, time=time, point=(0, 0), impulse=1)

    contacts = (at(0.0, None), at(0.5, None), at(1.0, 1), at(1.05, 2))
    events = FramesRequest(count=5)
    assert choose_frames(events, plain(81, (40,), contacts=contacts)) == (8, 16, 20, 40, 80)  # 1.05 s is as 1 s
    assert max(choose_frames(events, plain(81, contacts=contacts, moving_until=2.0))) == 32
    first, second = plain(81, (20, 60)).encounters
    asked = Outcome(asked=Asked(relation="touches", target="b"), object="b", probability=1.0, sure=True, robust=True)
    met = {"encounters": (first, second.model_copy(update={"object": "b"})), "outcome": asked}
    assert choose_frames(FramesRequest(count=3), plain(81).model_copy(update=met)) == (30, 60, 80)


@given(
    st.sampled_from(["initial", "uniform", "events"]),
    st.integers(1, 64),
    st.integers(2, 100),
    st.lists(st.integers(0, 99), max_size=5),
    st.integers(0, 100),
)
def test_any_policy_gives_as_many_frames_as_there_are(policy, count, frames, events, seen) -> None:
    trajectory = plain(frames, tuple(e for e in events if e < frames), seen)
    chosen = choose_frames(FramesRequest(policy=policy, count=count), trajectory)
    assert len(chosen) == min(count, frames)
    assert list(chosen) == sorted(set(chosen))
    assert chosen[0] >= 0
    assert chosen[-1] < frames


PUT = {"kind": "place", "object": "a"}
MEANT_BY_NOBODY: dict[str, list[dict[str, Any]]] = {
    "grounding": [{"object": "ball"}, {"bbox": [0, 0, 9, 9], "point": [10, 1]}],
    "grounding.mask": [{"mask": "https://example.org/mask.png"}],
    "objects": [[{"object": "mug", "bbox": [0, 0, 9, 9]}] * 65, [{"object": "mug"}]],
    "camera": [{}],
    "motion": [
        {"law": "ballistic", "depth": 0.5},
        {"direction": [1, 0], "towards": "mug"},
        {"along_arrow": True, "forward": True},
        {"others": [{"object": "car", "direction": [1, 0], "towards": "mug"}]},
        {"kind": "fall", "depth_deviation": 9},
        {"kind": "fall", "direction": [1, 0]},
    ],
    "motion.others.0": [{"others": [{"object": "car"}]}],
    "interventions.0": [
        [{"kind": "remove", "object": "a", "targets": ["b"]}],
        [PUT | {"relation": "into", "targets": ["A"]}],
        [PUT | {"relation": "between", "targets": ["b"]}],
    ],
}


@pytest.mark.parametrize("field", MEANT_BY_NOBODY)
def test_requests_that_cannot_be_meant(field: str) -> None:
    """Beside those that the tests of the API send to a server."""
    for value in MEANT_BY_NOBODY[field]:
        with pytest.raises(ValidationError) as caught:
            SimulateRequest.model_validate({"image": "data:,", "question": "?", field.partition(".")[0]: value})
        places = [".".join(map(str, error["loc"])) for error in caught.value.errors()]
        assert any(place.startswith(field) for place in places), places


def test_the_law_alone_leaves_the_motion_to_the_reader() -> None:
    asked = SimulateRequest.model_validate({"image": "data:,", "question": "?", "motion": {"law": "ballistic"}})
    assert (asked.law, asked.whole_motion, asked.left_to_reader) == ("ballistic", None, {"grounding", "motion"})
    kept = SimulateRequest.model_validate(asked.model_dump(mode="json", exclude_defaults=True))
    assert kept == asked
    default = SimulateRequest(image="data:,", question="?")
    assert (default.law, default.ensemble) == ("contact", 50)


def test_a_throw_without_a_speed_reaches_as_far_as_a_toy_does(scene: Observation) -> None:
    thrown = moved(scene, direction=(1, 0), kind="projectile")
    x0, y0, x1, y1 = grounded(scene, **POINT).bbox
    radius, gravity = (x1 - x0 + y1 - y0) / 4, thrown.gravity[1]
    assert thrown.speed**2 / (gravity * radius) == pytest.approx(1.8**2 / (9.81 * 0.15))
    assert (thrown.law, thrown.speed_deviation, thrown.depth_deviation) == ("contact", 0.28, 20)
    assert moved(scene, direction=(1, 0), kind="projectile", depth=0.0).depth_deviation == 0, "its depth is given"
    ballistic = moved(scene, direction=(1, 0), kind="projectile", law="ballistic")
    assert (ballistic.law, ballistic.speed) == ("ballistic", pytest.approx(0.26 * 640))
    given = moved(scene, direction=(1, 0), kind="projectile", speed=50, depth_deviation=4)
    assert (given.speed, given.speed_deviation, given.depth_deviation) == (50, 0, 4)


def read_as(scene: Observation, reading: MotionRequest, **request) -> Motion:
    class OneReader:
        source = "mllm"

        heeds_objections = False

        def read(self, given):
            return ReadResult(Reading(motion=reading))

    return settle_motion(run(scene, reader=OneReader, **request), grounded(scene, **POINT), None).value


def test_what_a_reader_leaves_open_of_a_motion(scene: Observation) -> None:
    slow = read_as(scene, MotionRequest(kind="linear", direction=(1, 0), cue="text", speed="slow"))
    assert (slow.speed, slow.speed_deviation) == (pytest.approx(0.13 * 640), 0.25)
    thrown = read_as(scene, MotionRequest(kind="projectile", direction=(1, 0), cue="text", down=(0.6, 0.8)))
    assert (thrown.down, thrown.depth_deviation) == ((0.6, 0.8), 20)
    fast = read_as(
        scene, MotionRequest(kind="projectile", direction=(1, 0), cue="text", speed="fast", depth_deviation=30.0)
    )
    assert (fast.speed / thrown.speed, fast.depth_deviation) == (pytest.approx(2), 30)
    assert read_as(scene, fall := MotionRequest(kind="fall", cue="gravity")).speed_deviation == 0
    assert read_as(scene, fall, motion={"law": "ballistic"}).law == "ballistic"


@pytest.mark.parametrize(("given", "language"), [({}, "es"), ({"language": "en"}, "en")])
def test_the_questions_language_counts_where_the_request_names_none(scene: Observation, given, language: str) -> None:
    asked = run(scene, **given)
    assert asked.language == "en"
    asked.results["grounding"] = StageResult(value=grounded(scene, **POINT).model_copy(update={"language": "es"}))
    assert asked.language == language
