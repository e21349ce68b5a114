"""Worlds of drawings that are generated with a known camera: where things go, whatever the camera and the clip."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import SCALE
from drawn import Image, ball, block, floor
from floors import TrueCamera, outline
from runs import run_of
from staged import BLUE, RED, computed

from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Trajectory

pytestmark = pytest.mark.slow

RADIUS = 0.15  # m


def drawing(rng: np.random.Generator, bearing: float) -> Image | None:
    """A red ball and a blue block on a floor, which lies at a bearing (radians, 0 to the right) from it.

    None if not both are in the image, or one hides a part of the other.
    """
    camera = TrueCamera(rng.uniform(15, 45), 0.0, 640 * rng.uniform(0.8, 1.4), rng.uniform(1.0, 2.0))
    middle = camera.on_floor((320 + rng.uniform(-120, 120), 210 + rng.uniform(-60, 60)))
    if middle is None:
        return None
    away = rng.uniform(0.3, 0.7) * np.array([math.cos(bearing), math.sin(bearing)])
    near, far = (np.array(middle) - away).tolist(), (np.array(middle) + away).tolist()
    round_box = camera.sphere_box((near[0], RADIUS, near[1]), RADIUS)
    square = camera.box(outline("cylinder", (far[0], far[1]), RADIUS, 2 * RADIUS))
    for x0, y0, x1, y1 in (round_box, square):
        if min(x0, y0) < 12 or x1 > 628 or y1 > 388 or x1 - x0 < 24:
            return None
    gaps = [max(a[i] - b[i + 2] for a, b in ((round_box, square), (square, round_box))) for i in (0, 1)]
    if max(gaps) < 12:
        return None
    x0, y0, x1, y1 = (round(v) for v in square)
    image = block(floor(640, 400, seed=int(rng.integers(1000))), (x0, y0, x1, y1), BLUE)
    centre = ((round_box[0] + round_box[2]) / 2, (round_box[1] + round_box[3]) / 2)
    return ball(image, centre, (round_box[2] - round_box[0]) / 2, RED)


def drawings(count: int, seed: int) -> list[Image]:
    """As many as are asked for, with bearings all around."""
    rng, found = np.random.default_rng(seed), list[Image]()
    while len(found) < count:
        image = drawing(rng, 2 * math.pi * (len(found) + rng.random()) / count)
        found += [] if image is None else [image]
    return found


def asked(image: Image, question: str, **request) -> tuple[Trajectory, tuple[str, ...]]:
    """What the embedded reader makes of a question, and its warnings."""
    found = computed(run_of(image, reader=EmbeddedReader, question=question, **request))
    return found.value, found.warnings


class TestTowards:
    @pytest.mark.scaled
    def test_what_moves_towards_a_thing_meets_it_in_whatever_direction_it_is_seen(self) -> None:
        count = 10 * SCALE
        met = 0
        for index, image in enumerate(drawings(count, seed=1)):
            verb = ("rolls", "moves")[index % 2]
            told, _ = asked(image, f"If the red ball {verb} towards the blue block, will it hit it?")
            met += told.outcome.sure and told.outcome.probability > 0.5
            assert told.bodies[0].support == "floor"
        assert met >= 0.95 * count

    def test_up_leads_along_the_floor_unless_it_is_said_to_leave_it(self) -> None:
        (image,) = drawings(1, seed=2)
        slid, warnings = asked(image, "If the red ball moves up, will it hit the blue block?")
        assert len(warnings) == 1, "it may have been meant to leave the floor"
        assert np.ptp(heights_of(slid)) < 0.02 * np.ptp(np.array(slid.path.states)[:, 2])
        for words, request in (("is lifted", {}), ("moves up", {"motion": {"rises": True}})):
            lifted, warnings = asked(image, f"If the red ball {words}, will it hit the blue block?", **request)
            assert (lifted.bodies[0].support, warnings) == ("air", ())
            path = np.array(lifted.path.states)[:, :3]
            assert np.ptp(heights_of(lifted)) > 0.95 * np.linalg.norm(path[-1] - path[0])
        assert asked(image, "If the red ball rolls up, will it hit the blue block?")[1] == (), (
            "nothing rolls in the air"
        )

    @pytest.mark.scaled
    def test_a_throw_towards_a_thing_heads_for_it_whatever_is_asked(self) -> None:
        for image in drawings(3 * SCALE, seed=3):
            told, _ = asked(image, "If the red ball is thrown towards the blue block, will it leave the image?")
            up, (first, _, last) = up_of(told), np.array(told.path.states)[:3, :3]
            away, heading = (way - (way @ up) * up for way in (told.bodies[1].position - first, last - first))
            cosine = heading @ away / np.linalg.norm(heading) / np.linalg.norm(away)
            assert cosine > math.cos(math.radians(3))


@pytest.mark.scaled
@pytest.mark.parametrize("motion", ["rolls to the right", "is thrown to the right", "moves to the right, then up"])
def test_an_answer_does_not_depend_on_the_clip(motion: str) -> None:
    """The worlds of an ensemble have a clock of their own, and run until nothing moves any more."""
    for image in drawings(SCALE, seed=4):
        question = f"If the red ball {motion}, will it hit the blue block?"
        clips = [(17, 16.0), (49, 30.0), (81, 12.0)]
        found = [asked(image, question, num_frames=frames, fps=fps)[0].outcome for frames, fps in clips]
        assert len({(each.probability, each.time_band, each.sure) for each in found}) == 1
        times = [each.time for each in found if each.time is not None]  # of what each clip shows
        assert len(times) in (0, len(clips))
        assert max(times, default=0.0) - min(times, default=0.0) < 0.02


def test_what_happens_after_the_clip_is_told_as_such() -> None:
    (image,) = drawings(1, seed=5)
    asks = "If the red ball rolls towards the blue block, will it hit it?"
    told = asked(image, asks)[0]
    (then,) = (each for each in told.encounters if each.kind == "touches")
    clip = 0.5 * then.time
    short = asked(image, asks, num_frames=1 + math.floor(16 * clip))[0]
    assert short.outcome.probability == told.outcome.probability
    (met,) = (each for each in short.encounters if each.kind == "touches")
    assert (met.first_frame, met.time) == (short.num_frames - 1, then.time)
    assert not [each for each in short.contacts if each.time > clip]


def test_a_size_that_is_given_fixes_the_scale_and_sizes_that_disagree_are_told() -> None:
    (image,) = drawings(1, seed=6)
    asks = "If the red ball rolls to the right, will it hit the blue block?"
    found, _ = asked(image, asks)
    box, cube = found.bodies[0].bbox, {"object": "blue block", "bbox": found.bodies[1].bbox}
    for size in (0.02, 30.0):
        sized = {"object": "red ball", "bbox": box, "size": size}
        told, warnings = asked(image, asks, grounding=sized, objects=[cube])
        assert warnings == ()
        assert max(told.bodies[0].size) == pytest.approx(size, rel=0.15)
        assert told.camera.height / found.camera.height == pytest.approx(size / max(found.bodies[0].size), rel=0.15)
        other, _ = asked(image, asks, objects=[cube | {"size": size}])
        assert max(other.bodies[1].size) == pytest.approx(size, rel=0.6), "it is nearer or farther than the ball"
    scale = 30.0 / max(box[2] - box[0], box[3] - box[1])
    for factor, doubts in ((1.5, 0), (2.5, 1)):
        motion = {"metres_per_pixel": factor * scale}
        assert len(asked(image, asks, grounding=sized, objects=[cube], motion=motion, ensemble=0)[1]) == doubts


def up_of(told: Trajectory) -> np.ndarray:
    pitch = math.radians(told.camera.pitch)
    return np.array([0.0, -math.cos(pitch), -math.sin(pitch)])


def heights_of(told: Trajectory) -> np.ndarray:
    """Of the mover in each frame, above where the camera is, m."""
    return np.array(told.path.states)[:, :3] @ up_of(told)
