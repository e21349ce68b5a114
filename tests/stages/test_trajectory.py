"""Stage 3 as a whole, on drawn scenes: what happens, what is said of it, and input that cannot be meant."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from drawn import ball, block, floor
from hypothesis import given
from hypothesis import strategies as st
from runs import run_of
from staged import BLUE, RED, computed

from cow_service.media.masks import CroppedMask
from cow_service.media.types import Image
from cow_service.perception.observation import look
from cow_service.records import Grounding, LocatedObject, ObjectPrior, Trajectory
from cow_service.stages.motion import settle_motion
from cow_service.stages.reconstruction import reconstruct
from cow_service.stages.seeing import see
from cow_service.stages.trajectory import simulate_world

MOVER = {"object": "red ball", "bbox": (80, 210, 130, 260)}
BEFORE, BESIDE, BEHIND = (300, 270, 370, 350), (330, 190, 400, 268), (330, 150, 380, 200)


def scene(*blocks: tuple[int, int, int, int]) -> Image:
    image = floor(640, 400)
    for bbox in sorted(blocks, key=lambda bbox: bbox[3]):
        image = block(image, bbox, BLUE)
    return ball(image, (105, 235), 25, RED)


def simulated(image: Image, objects=(), grounding=MOVER, motion=None, **request: Any) -> Trajectory:
    """Stages 1 to 3 of a request that says all that a reader would."""
    others = [{"object": f"block {i}" if i else "cube", "shape": "box", "bbox": bbox} for i, bbox in enumerate(objects)]
    motion = {"kind": "linear", "direction": (1, 0), "speed": 160} if motion is None else motion
    asked = {"question": "Will the ball hit the cube?", "num_frames": 49, "ensemble": 15} | request
    return computed(run_of(image, grounding=grounding, motion=motion, objects=others, **asked)).value


def numbers(value: Any) -> list[float]:
    """All numbers of a record."""
    if isinstance(value, dict):
        return [number for part in value.values() for number in numbers(part)]
    if isinstance(value, list | tuple):
        return [number for part in value for number in numbers(part)]
    return [value] if isinstance(value, int | float) else []


def is_sane(trajectory: Trajectory, frames: int = 49) -> None:
    assert all(math.isfinite(number) for number in numbers(trajectory.model_dump()))
    moving = {path.body for path in trajectory.paths}
    assert trajectory.paths[0].body == 0
    assert len(moving) == len(trajectory.paths)
    for path in trajectory.paths:
        parts = [path.states, path.points, path.visible, path.scale, *path.tracks]
        assert {len(part) for part in parts} == {frames}
        assert len(path.rotation) in (0, frames)
        assert len(path.band) in (0, frames)
        assert all(x0 <= x1 and y0 <= y1 for x0, y0, x1, y1 in path.band)
        assert {len(future) for future in path.futures} <= {frames}
        assert len(path.futures) == (min(trajectory.ensemble, 8) if path.band and path.body == 0 else 0)
        assert min(path.scale) > 0
    assert all(min(body.size) > 0 for body in trajectory.bodies)
    assert {each.body for each in trajectory.still_tracks} == set(range(len(trajectory.bodies))) - moving
    names = {body.object for body in trajectory.bodies}
    assert all(body.support in names | {"floor", "air"} for body in trajectory.bodies)
    assert all(body.support != body.object for body in trajectory.bodies)
    for encounter in trajectory.encounters:
        assert 0 <= encounter.first_frame < frames
        assert trajectory.bodies[encounter.body or 0].object == encounter.object


class TestWhatHappens:
    def test_what_stands_on_its_way_is_hit_and_what_stands_before_or_behind_is_passed(self) -> None:
        told = simulated(scene(BESIDE), [BESIDE])
        is_sane(told)
        (hit,) = (encounter for encounter in told.encounters if encounter.kind == "touches")
        assert (told.law, hit.object, hit.body) == ("contact", "cube", 1)
        assert hit.probability == told.outcome.probability > 0.8
        assert told.outcome.sure
        assert [path.body for path in told.paths] == [0, 1]
        # The rims meet when the middle of the ball is 25 px before the block's near edge.
        met = next(contact for contact in told.contacts if contact.b == 1)
        assert met.time == pytest.approx((330 - 25 - 105) / 160, abs=0.25)
        told = simulated(scene(BEFORE, BEHIND), [BEFORE, BEHIND])
        is_sane(told)
        assert len(told.paths) == 1
        assert "touches" not in {encounter.kind for encounter in told.encounters}
        assert told.outcome.probability < 0.3

    @pytest.mark.parametrize("partly", [False, True])
    def test_one_covering_has_one_probability(self, partly: bool) -> None:
        """In the outcome and in the encounter, also where a part of it is enough."""
        low = (290, 236, 380, 350)  # hides the lower part of the ball
        asked = {"relation": "covered", "target": "cube", "partly": partly}
        told = simulated(scene(low), [low], asked=asked, ensemble=40)
        found = [each.probability for each in told.encounters if each.kind == "occluded-by"]
        assert found == [told.outcome.probability]

    def test_without_an_ensemble_nothing_is_said_of_probabilities(self) -> None:
        told = simulated(scene(BESIDE), [BESIDE], ensemble=0)
        is_sane(told)
        assert told.ensemble == 0
        assert [encounter.probability for encounter in told.encounters] == [None] * len(told.encounters)
        assert told.path.band == told.path.futures == ()
        assert (told.outcome.probability, told.outcome.sure) == (None, False)

    def test_futures_are_worlds_of_the_ensemble(self) -> None:
        """If all of them are listed, they make up the band."""
        told = simulated(scene(BESIDE), [BESIDE], ensemble=8)
        is_sane(told)
        futures = np.array(told.path.futures)
        assert np.array_equal(futures, futures.round(1))
        low, high = np.percentile(futures, [10, 90], axis=0)
        recorded = slice(None, None, 2)  # frames in between are interpolated
        assert np.hstack([low, high])[recorded] == pytest.approx(np.array(told.path.band)[recorded], abs=0.11)
        many = np.array(simulated(scene(BESIDE), [BESIDE], ensemble=100).path.futures)
        assert many.shape == (8, 49, 2)
        assert len(np.unique(many[:, -1, 0])) == 8
        assert many[:, 0] == pytest.approx(np.array([told.path.points[0]] * 8), abs=3)

    def test_a_question_about_nothing_has_no_outcome(self) -> None:
        assert simulated(scene(BESIDE), [BESIDE], question="What a day!").outcome is None
        unknown = simulated(scene(BESIDE), [BESIDE], question="Will the ball hit the giraffe?").outcome
        assert (unknown.object, unknown.probability, unknown.sure) == (None, None, False)

    def test_under_the_ballistic_law_or_on_a_given_path_it_passes_through_everything(self) -> None:
        ballistic = {"kind": "linear", "direction": (1, 0), "speed": 160, "law": "ballistic"}
        told = simulated(scene(BESIDE), [BESIDE], motion=ballistic)
        is_sane(told)
        assert (told.law, len(told.paths)) == ("ballistic", 1)
        assert np.array(told.path.points) == pytest.approx(np.array([(105 + 10 * i, 235) for i in range(49)]))
        nearer = simulated(scene(), motion=ballistic | {"direction": (0, 1), "depth": -0.8, "speed": 60}).path
        spread = np.linalg.norm(np.array(nearer.tracks[1]) - np.array(nearer.points), axis=1)
        assert spread / spread[0] == pytest.approx(np.array(nearer.scale), abs=1e-3), "tracks grow with it"
        assert nearer.scale[-1] > nearer.scale[0] == 1
        points = [(105, 235), (380, 235), (380, 235)]
        told = simulated(scene(BESIDE), [BESIDE], motion=None, trajectory={"points": points, "fps": 1})
        is_sane(told)
        assert [told.path.points[16], told.path.points[48]] == [pytest.approx((380, 235))] * 2
        assert len(told.paths) == 1
        assert any(encounter.kind == "touches" for encounter in told.encounters)


boxes = st.tuples(st.floats(0, 600), st.floats(0, 360), st.floats(2.1, 400), st.floats(2.1, 300)).map(
    lambda box: (box[0], box[1], min(640.0, box[0] + box[2]), min(400.0, box[1] + box[3]))
)


def masked(bbox: tuple[float, float, float, float]) -> CroppedMask:
    """A mask that fills a box: to cut one out of the image takes longer than all of stage 3."""
    mask = np.zeros((400, 640), bool)
    mask[int(bbox[1]) : max(int(bbox[1]) + 1, int(bbox[3])), int(bbox[0]) : max(int(bbox[0]) + 1, int(bbox[2]))] = True
    return CroppedMask.of(mask)


SEEN = look(scene(BESIDE, BEHIND))


def seen(mover, others, prior: ObjectPrior | None = None, **request: Any) -> Trajectory:
    """Stage 3 alone, of things whose boxes are full."""
    asked = {"question": "Will it hit thing 0?", "num_frames": 13, "ensemble": 3} | request
    run = run_of(SEEN.image, grounding={"bbox": mover}, **asked)
    named = [
        LocatedObject(object=f"thing {i}", bbox=bbox, prior=prior) for i, bbox in enumerate(others) if bbox != mover
    ]
    middle = ((mover[0] + mover[2]) / 2, (mover[1] + mover[3]) / 2)
    grounding = Grounding(
        object="ball",
        bbox=mover,
        point=middle,
        prior=prior,
        others=tuple(named),
        objects_complete=True,
        source="request",
    )
    seen = SEEN.with_masks({box: masked(box) for box in (mover, *others)})
    situation = see(run, seen, grounding, settle_motion(run, grounding, None).value)
    return simulate_world(situation, *reconstruct(situation))


BAD: dict[str, dict[str, Any]] = {
    "boxes that contradict the floor": {"others": [(300, 5, 330, 20), (320, 0, 640, 399), (10, 390, 40, 399)]},
    "objects inside each other": {"others": [(280, 180, 420, 330), (300, 200, 400, 310), (320, 220, 380, 290)]},
    "objects inside the mover": {"others": [(90, 220, 120, 250), (70, 200, 140, 270)]},
    "a mover as large as the image": {"mover": (8, 8, 632, 392), "others": [BESIDE]},
    "a sliver": {"mover": (100, 10, 102, 390), "others": [(0, 200, 640, 202)]},
    "thrown straight away": {"motion": {"kind": "projectile", "direction": (0, -1), "depth": 1, "speed": 400}},
    "straight at the camera": {"motion": {"direction": (0, 1), "depth": -1, "speed": 900}},
    "no speed": {"motion": {"direction": (1, 0), "speed": 0}},
    "the greatest throw": {"motion": {"kind": "projectile", "direction": (1, -1), "speed": 100_000}},
    "the smallest scale": {"motion": {"kind": "fall", "metres_per_pixel": 1e-6}, "others": [BESIDE]},
    "the largest scale": {"motion": {"kind": "projectile", "direction": (1, 0), "metres_per_pixel": 1000}},
    "a camera that looks straight up": {"camera": {"pitch": -90}, "others": [BESIDE]},
    "a camera that looks straight down": {"camera": {"pitch": 90}, "others": [BESIDE]},
    "a camera on its head": {"camera": {"roll": 180}, "others": [BESIDE]},
    "a telescope": {"camera": {"focal": 1_000_000}, "others": [BESIDE]},
    "a fisheye": {"camera": {"focal": 1}, "others": [BESIDE]},
    "two frames": {"num_frames": 2, "fps": 60, "others": [BESIDE]},
    "many frames": {"num_frames": 481, "fps": 60, "ensemble": 2, "others": [BESIDE]},
    "one world": {"ensemble": 1, "others": [BESIDE]},
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_meant_gives_a_sane_result(name: str) -> None:
    rolling = {"direction": (1, 0), "speed": 160}
    given_ = {"mover": MOVER["bbox"], "others": [], "motion": rolling, "num_frames": 33, "ensemble": 10} | BAD[name]
    is_sane(seen(**given_), given_["num_frames"])


@given(
    boxes,
    st.lists(boxes, max_size=8, unique=True),
    st.sampled_from(["linear", "projectile", "fall", "static"]),
    st.floats(-math.pi, math.pi),
    st.floats(-1, 1),
    st.floats(0, 5).map(lambda power: 10**power),
    st.sampled_from(["sphere", "box", "cylinder", "cone", None]),
    st.sampled_from(["floor", "air", "thing 0", None]),
    st.floats(-90, 90) | st.none(),
)
def test_any_request_gives_a_sane_result(mover, others, kind, angle, depth, speed, shape, stands_on, pitch) -> None:
    directed = {"direction": (math.cos(angle), math.sin(angle)), "depth": depth, "speed": speed}
    told = seen(
        mover, others, ObjectPrior(shape=shape, stands_on=stands_on),
        camera=None if pitch is None else {"pitch": pitch},
        motion={"kind": kind} | (directed if kind in ("linear", "projectile") else {}),
    )  # fmt: skip
    is_sane(told, 13)
