"""Each stage on its own: defaults, overrides, and what each refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from drawn import ball, floor
from hypothesis import given
from hypothesis import strategies as st
from runs import run_of

from cow_service.errors import InvalidRequest
from cow_service.readers.base import MotionReading
from cow_service.records import Asked, Contact, Encounter, Grounding, Motion, Outcome, Path, Trajectory
from cow_service.requests import AnswerRequest, FramesRequest, SimulateRequest, TrajectoryRequest
from cow_service.stages.generation import choose_frames
from cow_service.stages.grounding import ground
from cow_service.stages.keys import KEY_FIELDS, key_of
from cow_service.stages.motion import read_motion
from cow_service.stages.reconstruction import Situation, reconstruct
from cow_service.stages.trajectory import simulate_world
from cow_service.vision.masks import CroppedMask
from cow_service.vision.scene import Obstacle, Scene

RED = (200, 30, 30)


POINT = {"point": (200, 200)}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(ball(floor(640, 400), (200, 200), 40, RED))


def run(scene: Scene, **request):
    return run_of(scene.image, **request)


def grounded(scene: Scene, **place) -> Grounding:
    return ground(run(scene, grounding=place)).value


def moved(scene: Scene, path: TrajectoryRequest | None = None, **motion) -> Motion:
    given = ({"motion": motion} if motion else {}) | ({} if path is None else {"trajectory": path})
    return read_motion(run(scene, **given), grounded(scene, **POINT), None).value


def rolled(
    scene: Scene, motion: Motion, path: TrajectoryRequest | None = None, frames=81, fps=16.0, obstacles=()
) -> Trajectory:
    """The trajectory under the paper's law, whose paths are known in closed form."""
    request = run(scene, trajectory=path, num_frames=frames, fps=fps, ensemble=0).request
    ballistic = motion.model_copy(update={"law": "ballistic"})
    return simulate_world(
        situation := Situation(scene, grounded(scene, **POINT), ballistic, request, obstacles), *reconstruct(situation)
    )


def test_a_point_grounds_the_object_under_it(scene: Scene) -> None:
    grounding = grounded(scene, point=(220, 190))
    assert grounding.bbox == pytest.approx((160, 160, 240, 240), abs=4)
    assert grounding.point == pytest.approx((200, 200), abs=3)
    assert (grounding.object, grounding.source) == ("object", "request")


def test_a_box_is_taken_as_it_is_and_clipped_to_the_image(scene: Scene) -> None:
    assert grounded(scene, bbox=(150, 150, 250, 250), object="ball").bbox == (150, 150, 250, 250)
    beyond = ground(run(scene, grounding={"bbox": (-50, 150, 250, 250)}))
    assert beyond.value.bbox == (0, 150, 250, 250)
    assert any("[-50.0, 150.0, 250.0, 250.0] reaches beyond" in warning for warning in beyond.warnings)


@pytest.mark.parametrize("bbox", [(0, 0, 640, 400), (-900, -900, 9000, 9000), (2, 2, 639, 399)])
def test_a_box_all_over_the_image_is_refused(scene: Scene, bbox) -> None:
    with pytest.raises(InvalidRequest, match=r"of the image\. Give pixels of the object alone") as caught:
        grounded(scene, bbox=bbox)
    assert caught.value.errors[0].pointer == "/grounding/bbox"


@pytest.mark.parametrize("given", [{"point": (640, 10)}, {"point": (-1, 10)}, {"bbox": (700, 10, 800, 90)}])
def test_a_place_outside_the_image_is_refused(scene: Scene, given) -> None:
    with pytest.raises(InvalidRequest, match="outside the upright image of 640 x 400") as caught:
        grounded(scene, **given)
    assert caught.value.errors[0].pointer == f"/grounding/{next(iter(given))}"


def test_defaults_of_speed_scale_and_gravity(scene: Scene) -> None:
    linear = moved(scene, direction=(3, 4))
    assert linear.direction == pytest.approx((0.6, 0.8))
    assert linear.speed == pytest.approx(0.26 * 640)
    assert linear.gravity == (0, 0)
    thrown = moved(scene, direction=(1, 0), kind="projectile")
    assert thrown.metres_per_pixel.value == pytest.approx(3 / 640)
    assert thrown.metres_per_pixel.source == "default"
    assert "3 m wide" in thrown.metres_per_pixel.note
    assert thrown.gravity == pytest.approx((0, 9.81 * 640 / 3))
    fall = moved(scene, kind="fall", metres_per_pixel=0.01)
    assert (fall.direction, fall.speed) == (None, 0)
    assert fall.gravity == pytest.approx((0, 981))
    assert fall.metres_per_pixel.source == "request"


def test_static_stays(scene: Scene) -> None:
    trajectory = rolled(scene, moved(scene, kind="static"))
    assert len(set(trajectory.path.points)) == 1


def test_linear_points_move_by_speed_over_fps(scene: Scene) -> None:
    trajectory = rolled(scene, moved(scene, direction=(1, 0), speed=160))
    points = np.array(trajectory.path.points)
    assert np.allclose(np.diff(points, axis=0), [10, 0])
    assert len(trajectory.path.states) == len(trajectory.path.visible) == len(trajectory.path.scale) == 81
    outside = points[:, 0] >= 640
    assert (np.array(trajectory.path.visible) == ~outside).all()
    metres = 3 / 640
    assert trajectory.path.states[0][3:] == pytest.approx((160 * metres, 0, 0))
    assert trajectory.path.states[0][2] == pytest.approx(640 * metres)


def test_a_fall_follows_gravity(scene: Scene) -> None:
    trajectory = rolled(scene, moved(scene, kind="fall"), fps=16)
    start, later = trajectory.path.points[0], trajectory.path.points[8]
    assert later[0] == pytest.approx(start[0])
    assert later[1] - start[1] == pytest.approx(0.5 * 9.81 * (640 / 3) * 0.25)


def test_tracks_follow_the_object_and_grow_with_it(scene: Scene) -> None:
    trajectory = rolled(scene, moved(scene, direction=(0, 1), depth=-0.8, speed=60), frames=33)
    assert trajectory.path.scale[-1] > trajectory.path.scale[0] == 1
    centre, track = np.array(trajectory.path.points), np.array(trajectory.path.tracks[1])
    spread = np.linalg.norm(track - centre, axis=1)
    assert np.allclose(spread / spread[0], trajectory.path.scale, atol=1e-4)


def test_anchors_keep_off_object_and_path(scene: Scene) -> None:
    trajectory = rolled(scene, moved(scene, direction=(1, 0)))
    assert len(trajectory.anchors) == 8
    assert all(abs(y - 200) > 40 for x, y in trajectory.anchors if x > 160)


def test_anchors_keep_off_where_they_would_else_stand(scene: Scene) -> None:
    free = rolled(scene, moved(scene, kind="static")).anchors
    x, y = next(anchor for anchor in free if math.dist(anchor, (200, 200)) > 120)
    here = np.zeros((400, 640), bool)
    here[int(y) - 15 : int(y) + 15, int(x) - 15 : int(x) + 15] = True
    obstacle = Obstacle("vase", (x - 15, y - 15, x + 15, y + 15), CroppedMask.of(here))
    kept = rolled(scene, moved(scene, kind="static"), frames=5, obstacles=(obstacle,)).anchors
    assert (x, y) not in kept
    assert all(not here[int(b), int(a)] for a, b in kept)
    away = rolled(scene, moved(scene, direction=(x - 200, y - 200), speed=300)).anchors
    assert (x, y) not in away


def test_the_sentence_says_what_the_record_says(scene: Scene) -> None:
    assert "towards the camera" in moved(scene, direction=(0, 1), depth=-0.9).sentence
    assert "camera." not in moved(scene, kind="fall").sentence.split("The camera")[0]


def test_a_given_path_is_followed_and_held(scene: Scene) -> None:
    path = TrajectoryRequest(points=((200, 200), (300, 200), (300, 300)), fps=2)
    motion = moved(scene, path=path)
    assert motion.kind == "linear"
    assert motion.direction == pytest.approx((math.sqrt(0.5), math.sqrt(0.5)))
    assert motion.speed == pytest.approx(200)
    trajectory = rolled(scene, motion, path, frames=33, fps=16)
    assert trajectory.path.points[0] == pytest.approx((200, 200))
    assert trajectory.path.points[4] == pytest.approx((250, 200))
    assert trajectory.path.points[8] == pytest.approx((300, 200))
    assert trajectory.path.points[16] == pytest.approx((300, 300))
    assert trajectory.path.points[32] == pytest.approx((300, 300))
    assert trajectory.path.states[32][3:] == (0, 0, 0)
    assert trajectory.path.states[12][4] > 0


def test_a_path_that_returns_has_a_first_direction_and_one_that_stays_is_static(scene: Scene) -> None:
    assert moved(scene, path=TrajectoryRequest(points=((0, 0), (0, 9), (0, 0)))).direction == (0, 1)
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


def test_event_frames_show_contacts_that_no_other_frame_shows() -> None:
    def at(time: float, b: int | None) -> Contact:
        return Contact(a=0, b=b, time=time, point=(0, 0), impulse=1)

    contacts = (at(0.0, None), at(0.5, None), at(1.0, 1), at(1.05, 2))
    events = FramesRequest(count=5)
    assert choose_frames(events, plain(81, (40,), contacts=contacts)) == (8, 16, 20, 40, 80)  # 1.05 s is as 1 s
    assert max(choose_frames(events, plain(81, contacts=contacts, moving_until=2.0))) == 32


def test_event_frames_show_what_is_asked_about_first() -> None:
    met = tuple(
        Encounter(object=name, bbox=(0, 0, 1, 1), first_frame=i, kind="touches") for name, i in (("a", 20), ("b", 60))
    )
    asked = Outcome(asked=Asked(relation="touches", target="b"), object="b", probability=1.0, sure=True, robust=True)
    trajectory = plain(81).model_copy(update={"encounters": met, "outcome": asked})
    assert choose_frames(FramesRequest(count=3), trajectory) == (30, 60, 80)


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


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ({"grounding": {"object": "ball"}}, "exactly one of `bbox`"),
        ({"grounding": {"bbox": [0, 0, 9, 9], "point": [1, 1]}}, "exactly one of `bbox`"),
        ({"grounding": {"mask": "https://example.org/mask.png"}}, "must be a data URL"),
        ({"objects": [{"object": "mug"}]}, "exactly one of `bbox`"),
        ({"objects": [{"bbox": [0, 0, 9, 9]}]}, "Field required"),
        ({"objects": [{"object": "mug", "bbox": [0, 0, 9, 9], "size": 0}]}, "greater than or equal to 0.0001"),
        ({"objects": [{"object": "mug", "bbox": [0, 0, 9, 9]}] * 1000}, "at most 64 items"),
        ({"ensemble": 501}, "less than or equal to 500"),
        ({"camera": {}}, "give `focal`, `pitch` or `roll`"),
        ({"camera": {"pitch": 91}}, "less than or equal to 90"),
        ({"motion": {"law": "ballistic", "depth": 0.5}}, "need a `direction`"),
        ({"motion": {"kind": "fall", "distance": 9}}, "takes no `distance`"),
        ({"motion": {"others": [{"object": "car"}]}}, "needs a `direction`"),
        ({"interventions": [{"kind": "remove", "object": "a", "targets": ["b"]}]}, "takes only an `object`"),
        ({"interventions": [{"kind": "place", "object": "a", "relation": "into", "targets": ["A"]}]}, "different"),
        ({"interventions": [{"kind": "place", "object": "a", "relation": "between", "targets": ["b"]}]}, "of length 2"),
        ({"motion": {"kind": "fall", "depth_deviation": 9}}, "takes no `direction`"),
        ({"grounding": {"bbox": [10, 10, 10, 90]}}, "x1 and y1 at least 2 px beyond"),
        ({"motion": {"direction": [0, 0]}}, "must not have zero length"),
        ({"motion": {"kind": "projectile"}}, "needs a `direction`"),
        ({"trajectory": {"points": [[1, 1]]}}, "at least 2"),
        ({"trajectory": {"points": [[1, 1], [1e9, 0]]}}, "less than or equal to 1000000"),
        ({"motion": {"kind": "fall", "direction": [1, 0]}}, "takes no `direction`"),
        ({"question": "   "}, "empty"),
        ({"num_frames": 1}, "greater than or equal to 2"),
        ({"sede": 3}, "Extra inputs"),
    ],
)
def test_requests_that_cannot_be_meant(body, told) -> None:
    with pytest.raises(ValueError, match=told):
        SimulateRequest.model_validate({"image": "data:,", "question": "?", **body})


def test_the_law_alone_leaves_the_motion_to_the_reader() -> None:
    asked = SimulateRequest.model_validate({"image": "data:,", "question": "?", "motion": {"law": "ballistic"}})
    assert (asked.law, asked.stated_motion, asked.left_to_reader) == ("ballistic", None, {"grounding", "motion"})
    kept = SimulateRequest.model_validate(asked.model_dump(mode="json", exclude_defaults=True))
    assert kept == asked
    default = SimulateRequest(image="data:,", question="?")
    assert (default.law, default.ensemble) == ("contact", 50)


def test_a_throw_without_a_speed_reaches_as_far_as_a_toy_does(scene: Scene) -> None:
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


def read_as(scene: Scene, reading: MotionReading, **request) -> Motion:
    class OneReader:
        source = "mllm"

        def read_motion(self, given, grounding, hints):
            return reading

    return read_motion(run(scene, reader=OneReader, **request), grounded(scene, **POINT), None).value


def test_what_a_reader_leaves_open_of_a_motion(scene: Scene) -> None:
    slow = read_as(scene, MotionReading("linear", (1, 0), "text", speed="slow"))
    assert (slow.speed, slow.speed_deviation) == (pytest.approx(0.13 * 640), 0.25)
    thrown = read_as(scene, MotionReading("projectile", (1, 0), "text", down=(0.6, 0.8)))
    assert (thrown.down, thrown.depth_deviation) == ((0.6, 0.8), 20)
    fast = read_as(scene, MotionReading("projectile", (1, 0), "text", speed="fast", depth_deviation=30.0))
    assert (fast.speed / thrown.speed, fast.depth_deviation) == (pytest.approx(2), 30)
    assert read_as(scene, fall := MotionReading("fall", None, "gravity")).speed_deviation == 0
    assert read_as(scene, fall, motion={"law": "ballistic"}).law == "ballistic"


def test_a_reader_is_asked_where_the_request_is_silent(scene: Scene) -> None:
    class OneReader:
        source = "embedded"

        def read_motion(self, given, grounding, hints):
            assert given.question == "Where to?"
            assert hints is None
            return MotionReading("linear", (-2.0, 0.0), "text", warnings=("careful",))

    result = read_motion(run(scene, reader=OneReader, question="Where to?"), grounded(scene, **POINT), None)
    assert result.value.direction == (-1, 0)
    assert result.value.source == "embedded"
    assert result.warnings == ("careful",)


class TestKeys:
    """What decides a stage's key, and what does not."""

    def key(
        self,
        scene: Scene,
        stage="generation",
        inputs=(),
        identity=lambda role: {"name": role},
        repeats=True,
        heeds_seed=True,
        **request,
    ):
        one = run(scene, **request)
        one.request = AnswerRequest.model_validate(one.request.model_dump())
        decides = identity, lambda votes: repeats, lambda: heeds_seed
        return key_of(stage, one.image.info.sha256, one.request, inputs, *decides)

    @pytest.mark.parametrize("stage", ["gating", "grounding", "motion", "answering"])
    def test_the_seed_decides_where_the_reader_heeds_it(self, scene: Scene, stage: str) -> None:
        one, other = (self.key(scene, stage, seed=seed) for seed in (1, 2))
        assert one != other
        rules, same = (self.key(scene, stage, seed=seed, heeds_seed=False) for seed in (1, 2))
        assert rules == same
        assert rules != self.key(scene, stage, seed=1, heeds_seed=False, question="another")

    def test_another_wording_renders_no_clip_again(self, scene: Scene) -> None:
        assert self.key(scene, question="a") == self.key(scene, question="b")
        assert self.key(scene, seed=1) != self.key(scene, seed=2)
        assert self.key(scene, inputs=(None,)) != self.key(scene)

    def test_what_the_request_gives_decides_alone(self, scene: Scene) -> None:
        given = {"grounding": POINT, "motion": {"kind": "fall"}}
        reader = {"identity": lambda role: {"name": "another"}}
        for stage in ("grounding", "motion"):
            assert self.key(scene, stage, **given) == self.key(scene, stage, **given, **reader)
            assert self.key(scene, stage, question="a") != self.key(scene, stage, question="b")
            assert self.key(scene, stage) != self.key(scene, stage, **reader)
        assert self.key(scene, "motion", question="a", **given) == self.key(scene, "motion", question="b", **given)

    def test_what_is_asked_decides_the_grounding_and_nothing_after_it(self, scene: Scene) -> None:
        asked = {"asked": {"relation": "touches", "target": "cube"}}
        for place in ({}, {"grounding": POINT}):
            assert self.key(scene, "grounding", question="a", **place) != self.key(scene, "grounding", **place)
            assert self.key(scene, "grounding", **asked, **place) != self.key(scene, "grounding", **place)
        for stage in ("motion", "trajectory", "generation"):
            assert self.key(scene, stage, **asked) == self.key(scene, stage)
        assert self.key(scene, "trajectory", question="a") == self.key(scene, "trajectory")

    def test_a_point_given_beside_a_path_is_not_a_path_alone(self, scene: Scene) -> None:
        path = {"trajectory": {"points": [(200, 200), (300, 200)]}}
        assert self.key(scene, "grounding", grounding=POINT, **path) == self.key(scene, "grounding", **path)
        assert self.key(scene, "trajectory", grounding=POINT, **path) != self.key(scene, "trajectory", **path)

    def test_a_place_read_together_with_the_motion_is_one_read_alone(self, scene: Scene) -> None:
        both, alone = self.key(scene, "grounding"), self.key(scene, "grounding", motion={"kind": "fall"})
        assert both.digest != alone.digest
        assert (both.also, alone.also) == ((), (both.digest,))
        assert self.key(scene, "grounding", motion={"kind": "fall"}, seed=1).also != alone.also
        assert self.key(scene, "grounding", grounding=POINT, motion={"kind": "fall"}).also == ()
        assert self.key(scene, "motion", grounding=POINT).also == ()

    def test_objects_law_ensemble_and_camera_decide_their_stages(self, scene: Scene) -> None:
        mug = {"objects": [{"object": "mug", "bbox": [0, 0, 90, 90]}]}
        for place in ({}, {"grounding": POINT}):
            assert self.key(scene, "grounding", **place, **mug) != self.key(scene, "grounding", **place)
        law, path = {"law": "ballistic"}, {"trajectory": {"points": [(200, 200), (300, 200)]}}
        for motion in ({}, {"kind": "fall"}):
            given = self.key(scene, "motion", motion=motion | law, question="a")
            assert given != self.key(scene, "motion", motion=motion, question="a")
            asks_reader = given != self.key(scene, "motion", motion=motion | law, question="b")
            assert asks_reader is (not motion)
        assert self.key(scene, "motion", motion=law, **path) != self.key(scene, "motion", **path)
        for decides in ({"ensemble": 0}, {"camera": {"pitch": 20}}):
            assert self.key(scene, "trajectory", **decides) != self.key(scene, "trajectory")
            assert self.key(scene, "grounding", **decides) == self.key(scene, "grounding")

    def test_a_backend_that_does_not_say_what_decides_it_shares_nothing(self, scene: Scene) -> None:
        one, other = (self.key(scene, identity=lambda role: None, seed=seed) for seed in (1, 2))
        assert not one.shareable
        assert one.digest != other.digest
        assert self.key(scene).shareable

    def test_sampled_answers_are_not_shared_and_what_was_seen_is(self, scene: Scene) -> None:
        shared = {stage: self.key(scene, stage, repeats=False).shareable for stage in KEY_FIELDS}
        assert shared == {stage: stage not in ("gating", "answering") for stage in KEY_FIELDS}
        assert all(self.key(scene, stage).shareable for stage in KEY_FIELDS)
