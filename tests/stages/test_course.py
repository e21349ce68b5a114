"""How far and how long a motion goes: legs, stops, several movers, from a request to the path."""

from __future__ import annotations

import math
from typing import Any

import drawn
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from runs import run_of
from worlds import RADIUS, rigid

from cow_service.errors import InvalidRequest
from cow_service.physics.ballistic import Course, Leg, course_of
from cow_service.physics.engine import RigidShape, WorldRun, run_worlds
from cow_service.readers.base import MotionReading, Quantity
from cow_service.records import Grounding, LocatedObject, MetresPerPixel, Motion
from cow_service.stages.keys import StageResult
from cow_service.stages.motion import read_motion
from cow_service.stages.reconstruction import Situation, reconstruct
from cow_service.stages.trajectory import simulate_world

FPS = 16.0
DURATIONS = st.lists(st.floats(0.05, 1.5), min_size=1, max_size=4)
SPEEDS = st.floats(-2, 2)


def run(*bodies: RigidShape, beside: bool = False) -> WorldRun:
    return run_worlds([bodies] * (2 if beside else 1), 65, FPS)[0]


def gliding(course: Course, **other: Any) -> RigidShape:
    return rigid(velocity=course.legs[0].velocity, starts=True, glides=True, course=course, **other)


class TestCourse:
    @given(DURATIONS, st.lists(st.tuples(SPEEDS, SPEEDS), min_size=4, max_size=4), st.booleans())
    def test_it_ends_where_its_legs_lead(self, durations, speeds, beside: bool) -> None:
        legs = tuple(Leg(seconds, (x, 0.0, z)) for seconds, (x, z) in zip(durations, speeds, strict=False))
        found = run(gliding(Course(legs)), rigid("box", position=(50, RADIUS, 0)), beside=beside)
        wanted = sum(leg.duration * np.array(leg.velocity) for leg in legs if leg.duration)
        end = math.ceil(Course(legs).end * FPS) + 1
        if end < 65:
            shift = found.positions[0] - found.positions[0, 0]
            assert shift[end, [0, 2]] == pytest.approx(wanted[[0, 2]], abs=2e-3)
            assert shift[-1] == pytest.approx(shift[end], abs=2e-3), "at rest after the last leg"

    def test_it_stops_where_it_first_meets_something(self) -> None:
        for halts in (True, False):
            course = Course((Leg(math.inf, (1.0, 0.0, 0.0)),), halts)
            found = run(gliding(course), rigid("box", position=(1.0, RADIUS, 0)))
            assert found.positions[0, -1, 0] == pytest.approx(1 - 2 * RADIUS, abs=0.02) or not halts
            assert (found.positions[1, -1, 0] > 1.1) is not halts

    def test_what_it_stands_on_does_not_end_it(self) -> None:
        table = rigid("box", half_width=1.0, half_depth=1.0, half_height=0.5, position=(0.0, 0.5, 0.0))
        ball = gliding(Course((Leg(0.2, (1.0, 0.0, 0.0)),)), position=(0.0, 1.0 + RADIUS, 0.0))
        found = run(ball, table)
        assert found.positions[0, -1, 0] == pytest.approx(0.2, abs=0.02)

    def test_what_is_met_on_the_way_ends_the_course(self) -> None:
        course = Course((Leg(2.0, (1.0, 0.0, 0.0)), Leg(1.0, (0.0, 0.0, 5.0))))
        found = run(gliding(course), rigid("box", position=(1.0, RADIUS, 0)))
        assert abs(found.positions[0, -1, 2]) < 0.2, "the second leg is not taken any more"

    def test_in_the_air_it_stays_where_it_stops(self) -> None:
        lifted = gliding(Course((Leg(0.5, (0.0, 1.0, 0.0)),)), falls=False, position=(0, 1, 0))
        assert run(lifted).positions[0, -1] == pytest.approx((0, 1.5, 0), abs=1e-4)


def motion(**fields: Any) -> Motion:
    return Motion(
        kind="linear", direction=(1.0, 0.0), cue="request", speed=100.0, sentence="", source="request",
        metres_per_pixel=MetresPerPixel(value=0.01, source="request"), **fields,
    )  # fmt: skip


RIGHT, DOWN = {"direction": (1.0, 0.0)}, {"direction": (0.0, 1.0)}


@pytest.mark.parametrize(
    ("fields", "speed", "seconds"),
    [
        ({"distance": 50}, 100, [0.5]),
        ({"distance": 50}, 50, [1.0]),
        ({"duration": 0.7}, 50, [0.7]),
        ({"distance": 50, "duration": 0.2}, 100, [0.2]),
        ({"distance": 50, "steps": [DOWN]}, 100, [0.5, math.inf]),
        ({"steps": [DOWN]}, 100, [2.5, math.inf]),
        ({"steps": [DOWN | {"distance": 100}, RIGHT]}, 100, [2.0, 1.0, math.inf]),
        ({"until": "contact"}, 100, [math.inf]),
    ],
)
def test_how_long_legs_are(fields: dict[str, Any], speed: float, seconds: list[float]) -> None:
    given_ = motion(**fields)
    course = course_of(given_, [np.zeros(3)] * (1 + len(given_.steps)), speed)
    assert course is not None
    assert [leg.duration for leg in course.legs] == pytest.approx(seconds)
    assert course.halts == (fields.get("until") == "contact")


def test_what_just_goes_on_has_no_course() -> None:
    assert course_of(motion(), [np.zeros(3)], 100) is None


IMAGE = drawn.block(drawn.ball(drawn.floor(), (150, 250), 25, (200, 40, 40)), (400, 190, 460, 280), (40, 40, 200))
BALL, BLOCK = (125.0, 225.0, 175.0, 275.0), (400.0, 190.0, 460.0, 280.0)
OTHER = LocatedObject(object="Blue block", bbox=BLOCK, source="request")
GROUNDING = Grounding(object="ball", point=(150, 250), bbox=BALL, others=(OTHER,), source="request")
PLACES = {"grounding": {"object": "ball", "bbox": BALL}, "objects": [{"object": "Blue block", "bbox": BLOCK}]}


def read(reading: MotionReading | None, **given_: Any) -> StageResult[Motion]:
    """The motion of a request, and of what a reader says."""
    return read_motion(_run(reading, given_), GROUNDING, None)


def moved(reading: MotionReading | None = None, **given_: Any) -> tuple[Motion, Any]:
    """The motion and the trajectory of a request."""
    run_, found = _run(reading, given_), read(reading, **given_).value
    obstacles = run_.scene.obstacles(GROUNDING.bbox, GROUNDING.others)
    return found, simulate_world(
        situation := Situation(run_.scene, GROUNDING, found, run_.request, obstacles), *reconstruct(situation)
    )


def _run(reading: MotionReading | None, given_: dict[str, Any]) -> Any:
    class Reader:
        source = "embedded"

        def read_motion(self, *_: Any) -> MotionReading:
            assert reading is not None, "nobody is to be asked"
            return reading

    return run_of(IMAGE, reader=Reader, motion=given_, ensemble=0, num_frames=65, **PLACES)


@pytest.mark.parametrize("law", ["contact", "ballistic"])
class TestFromARequest:
    def test_a_distance_and_a_turn(self, law: str) -> None:
        steps = [{"direction": (-1, 0), "distance": 30}]
        _, trajectory = moved(direction=(1, 0), speed=100, distance=60, steps=steps, law=law)
        xs = np.array(trajectory.path.points)[:, 0]
        assert xs.max() == pytest.approx(210, abs=4)
        assert xs[-1] == pytest.approx(180, abs=4)

    def test_a_duration_beside_what_a_reader_says(self, law: str) -> None:
        words = MotionReading("linear", (0.0, -3.0), "text", speed="slow")
        found, trajectory = moved(words, duration=1, speed=40, law=law)
        assert (found.direction, found.speed, found.speed_deviation) == ((0, -1), 40, 0)
        assert trajectory.path.points[-1][1] < 245
        assert trajectory.path.points[17] == pytest.approx(trajectory.path.points[-1], abs=1)


def test_two_movers_meet_half_way() -> None:
    other = {"object": "blue  BLOCK", "direction": (-1, 0), "speed": 100}
    found, trajectory = moved(direction=(1, 0), speed=100, others=[other])
    assert found.others[0].object.bbox == BLOCK
    contact = next(each for each in trajectory.contacts if each.b is not None)
    assert contact.time == pytest.approx((400 - 175) / 200, abs=0.25)
    assert contact.point[0] == pytest.approx(287, abs=25)
    assert {path.body for path in trajectory.paths} == {0, 1}


def test_another_mover_must_be_located() -> None:
    with pytest.raises(InvalidRequest, match=r"motion\.others\.0\.object.*'car' matches 0 of .*'Blue block'"):
        moved(direction=(1, 0), others=[{"object": "car", "direction": (1, 0)}])


@pytest.mark.parametrize(
    ("speed", "pixels", "deviation"),
    [(Quantity(50, "px/s"), 50, 0), (Quantity(1, "m/s"), 640 / 3, 0.25), (Quantity(0.5, "widths/s"), 320, 0),
     ("slow", 0.13 * 640, 0.25), ("fast", 0.52 * 640, 0.25)],
)  # fmt: skip
def test_speeds_as_they_are_said(speed, pixels: float, deviation: float) -> None:
    found, _ = moved(MotionReading("linear", (1.0, 0.0), "text", speed=speed))
    assert found.speed == pytest.approx(pixels)
    assert found.speed_deviation == deviation


def test_a_throw_has_no_length_and_says_so() -> None:
    found = read(MotionReading("projectile", (1.0, -1.0), "text"), duration=2)
    assert found.value.duration is None
    assert any("duration of the motion was not used" in warning for warning in found.warnings)


def test_the_sentence_tells_the_whole_motion() -> None:
    steps = [{"direction": (0, 1)}, {"direction": (-1, 0), "distance": 30}]
    others = [{"object": "blue block", "direction": (-1, 0)}]
    told = read(None, direction=(1, 0), distance=60, steps=steps, others=others).value.sentence
    assert told == (
        "The ball sets off to the right, then down, then to the left, and then stops. "
        "At the same time the Blue block moves to the left. The camera stays still."
    )
