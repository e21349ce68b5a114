"""How a motion goes as a request and a reader say it: lengths, turns, speeds, several movers."""

from __future__ import annotations

from typing import Any

import drawn
import numpy as np
import pytest
from refusals import refused
from runs import run_of

from cow_service.readers.base import ReadResult
from cow_service.records import (
    Grounding,
    LocatedObject,
    Motion,
    MotionRequest,
    OtherMotionRequest,
    Reading,
    Trajectory,
    reading_of,
)
from cow_service.stages.keys import StageResult
from cow_service.stages.motion import settle_motion
from cow_service.stages.reconstruction import reconstruct
from cow_service.stages.run import Run
from cow_service.stages.seeing import see
from cow_service.stages.trajectory import simulate_world

IMAGE = drawn.block(drawn.ball(drawn.floor(), (150, 250), 25, (200, 40, 40)), (400, 190, 460, 280), (40, 40, 200))
BALL, BLOCK = (125.0, 225.0, 175.0, 275.0), (400.0, 190.0, 460.0, 280.0)
OTHER = LocatedObject(object="Blue block", bbox=BLOCK, source="request")
GROUNDING = Grounding(object="ball", point=(150, 250), bbox=BALL, others=(OTHER,), source="request")
PLACES = {"grounding": {"object": "ball", "bbox": BALL}, "objects": [{"object": "Blue block", "bbox": BLOCK}]}


def run_with(reading: MotionRequest | None, given_: dict[str, Any]) -> Run:
    class Reader:
        source = "embedded"
        heeds_objections = False

        def read(self, _: Any) -> ReadResult:
            assert reading is not None, "nobody is to be asked"
            return ReadResult(Reading(motion=reading))

    return run_of(IMAGE, reader=Reader, motion=given_, ensemble=0, num_frames=65, **PLACES)


def read(reading: MotionRequest | None, **given_: Any) -> StageResult[Motion]:
    """The motion of a request, and of what a reader says."""
    return settle_motion(run_with(reading, given_), GROUNDING, None)


def moved(reading: MotionRequest | None = None, **given_: Any) -> Trajectory:
    run_, found = run_with(reading, given_), read(reading, **given_).value
    situation = see(run_, run_.sight.look(), GROUNDING, found)
    return simulate_world(situation, *reconstruct(situation))


@pytest.mark.parametrize("way", [{"along_arrow": True}, {"cue": "trail"}, {"forward": True}, {"towards": "vase"}])
def test_what_is_missing_is_told_in_the_same_words_whoever_said_it(way: dict[str, Any]) -> None:
    """The question is "?": nothing can be said of what it speaks of."""
    with refused("cannot-read-direction") as caught:
        read(None, **way)
    assert "question" not in caught.value.detail


@pytest.mark.parametrize("law", ["contact", "ballistic"])
def test_a_distance_and_a_turn_and_a_duration(law: str) -> None:
    steps = [{"direction": (-1, 0), "distance": 30}]
    path = np.array(moved(direction=(1, 0), speed=100, distance=60, steps=steps, law=law).path.points)
    assert path[:, 0].max() == pytest.approx(210, abs=4)
    assert path[-1, 0] == pytest.approx(180, abs=4)
    words, lasts = (
        MotionRequest(kind="linear", direction=(0.0, -3.0), cue="text", speed="slow"),
        {"duration": 1, "speed": 40, "law": law},
    )
    found, path = read(words, **lasts).value, moved(words, **lasts).path.points
    assert (found.direction, found.speed, found.speed_deviation) == ((0, -1), 40, 0), "what the request says counts"
    assert path[-1][1] < 245
    assert path[17] == pytest.approx(path[-1], abs=1)


def test_two_movers_meet_half_way() -> None:
    both = {
        "direction": (1, 0),
        "speed": 100,
        "others": [{"object": "blue  BLOCK", "direction": (-1, 0), "speed": 100}],
    }
    assert read(None, **both).value.others[0].object.bbox == BLOCK
    trajectory = moved(**both)
    contact = next(each for each in trajectory.contacts if each.b is not None)
    assert contact.time == pytest.approx((400 - 175) / 200, abs=0.25)
    assert contact.point[0] == pytest.approx(287, abs=25)
    assert {path.body for path in trajectory.paths} == {0, 1}
    with refused("invalid-request", "/motion/others/0/object"):
        read(None, direction=(1, 0), others=[{"object": "car", "direction": (1, 0)}])


@pytest.mark.parametrize(
    ("speed", "pixels", "deviation"),
    [
        (50, 50, 0),
        ({"value": 50, "unit": "px/s"}, 50, 0),
        ({"value": 1, "unit": "m/s"}, 640 / 3, 0.25),
        ({"value": 0.5, "unit": "widths/s"}, 320, 0),
        ("slow", 0.13 * 640, 0.25),
    ],
)
def test_speeds_as_they_are_said_by_readers_and_callers(speed: Any, pixels: float, deviation: float) -> None:
    said = {"kind": "linear", "direction": (1.0, 0.0), "speed": speed}
    for found in (read(MotionRequest.model_validate(said | {"cue": "text"})).value, read(None, **said).value):
        assert found.speed == pytest.approx(pixels)
        assert found.speed_deviation == deviation


@pytest.mark.parametrize(("distance", "pixels"), [(60, 60), ({"value": 0.3, "unit": "m"}, 0.3 * 640 / 3)])
def test_distances_have_units(distance: Any, pixels: float) -> None:
    assert read(None, direction=(1, 0), distance=distance).value.distance == pytest.approx(pixels)


def test_a_goal_is_found_by_what_describes_it_and_reported() -> None:
    for name in ("blue block", "the big blue block"):
        found = read(None, towards=name, others=[{"object": "blue block", "towards": "the ball"}]).value
        assert found.towards == OTHER
        assert found.direction == pytest.approx((1, 0), abs=0.1)
        (other,) = found.others
        assert (other.towards and other.towards.bbox, other.direction) == (BALL, pytest.approx((-1, 0), abs=0.1))
    with refused("cannot-read-direction"):
        read(None, towards="ball")
    with refused("invalid-request", "/motion/others/0/towards"):
        read(None, direction=(1, 0), others=[{"object": "blue block", "towards": "block"}])


def test_a_reading_has_every_field_of_the_motion() -> None:
    """All but those that its direction stands for."""
    step = {"direction": (-1.0, 0.0), "depth": 0.1, "distance": 30.0, "duration": 2.0}
    way = {"direction": (0.6, 0.8), "direction_deviation": 5.0, "depth": 0.2, "speed": 50.0, "speed_deviation": 0.1}
    said = {
        "kind": "linear", "law": "ballistic", **way, "other_direction": (0.0, 1.0), "cue": "arrow", "rises": True,
        "distance": 60.0, "duration": 3.0, "until": "contact", "steps": (step,), "metres_per_pixel": 0.004,
        "others": ({"object": "Blue block", "kind": "projectile", **way},), "depth_deviation": 3.0, "down": (0.6, 0.8),
    }  # fmt: skip
    carried = reading_of(GROUNDING, read(None, **said).value).motion
    assert carried is not None
    assert carried.model_dump(include=said.keys(), exclude={"others": {"__all__": {"towards"}}}) == said
    assert MotionRequest.model_fields.keys() - said.keys() == {"towards", "along_arrow", "forward"}
    assert OtherMotionRequest.model_fields.keys() - said["others"][0].keys() == {"towards"}


def test_a_throw_has_no_length() -> None:
    found = read(MotionRequest(kind="projectile", direction=(1.0, -1.0), cue="text"), duration=2)
    assert found.value.duration is None
    assert len(found.warnings) == 2, "that it was not used, and that the speed was assumed"


def test_the_sentence_tells_the_whole_motion() -> None:
    steps = [{"direction": (0, 1)}, {"direction": (-1, 0), "distance": 30}]
    others = [{"object": "blue block", "direction": (-1, 0)}]
    told = read(None, direction=(1, 0), distance=60, steps=steps, others=others).value.sentence
    assert told == (
        "The ball sets off to the right, then down, then to the left, and then stops. "
        "At the same time the Blue block moves to the left. The camera stays still."
    )
    assert "towards the camera" in read(None, direction=(0, 1), depth=-0.9).value.sentence
    falls = read(None, kind="fall").value.sentence
    assert falls == ("The ball falls straight down, faster and faster, pulled down by gravity. The camera stays still.")
