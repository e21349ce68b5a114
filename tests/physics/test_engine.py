"""The engine of rigid bodies: against closed forms, over random worlds, and along the legs of a course."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import FPS, RADIUS, G, energy, mass, rigid, spin_at_start

from cow_service.physics.ballistic import Course, Leg, course_of
from cow_service.physics.engine import FLOOR_FRICTION, FLOOR_RESTITUTION, RigidShape, WorldRun, run_worlds
from cow_service.records import MetresPerPixel, Motion

BESIDE = rigid(position=(0.0, RADIUS, 5.0))  # out of the way


def run(*bodies: RigidShape, frames: int = 49, beside: bool = False) -> WorldRun:
    """One world; with `beside`, in an ensemble with a second one."""
    return run_worlds([bodies] * (2 if beside else 1), frames, FPS)[0]


class TestOneBody:
    @pytest.mark.parametrize("beside", [False, True])
    def test_free_fall_is_that_of_the_closed_form(self, beside: bool) -> None:
        found = run(rigid(position=(0, 9, 0), velocity=(1, 2, -0.5), starts=True), frames=17, beside=beside)
        t = np.arange(17) / FPS
        # Four iterations per step, each with the velocity at its end: g dt / 8 too low per second, and a small lift.
        error = G * t / (8 * (32 if beside else 64)) + 2e-3
        assert found.positions[0, :, 0] == pytest.approx(t, abs=1e-5)
        assert found.positions[0, :, 2] == pytest.approx(-t / 2, abs=1e-5)
        assert (np.abs(found.positions[0, :, 1] - (9 + 2 * t - G * t * t / 2)) <= error).all()
        assert found.velocities[0, :, 1] == pytest.approx(2 - G * t, abs=1e-3)

    @pytest.mark.parametrize("radius", [0.02, 2.0])
    def test_it_bounces_to_the_height_that_its_restitution_leaves(self, radius: float) -> None:
        drop = 8 * radius
        seconds = 2.2 * math.sqrt(2 * drop / G)
        fps = 120 / seconds
        ball = rigid(half=radius, position=(0, radius + drop, 0), starts=True, restitution=1.0)
        found = run_worlds([[ball]], 160, fps)[0]
        heights = found.positions[0, :, 1] - radius
        lowest = int(np.nonzero(np.diff(heights) > 0)[0][0])
        assert heights[lowest:].max() == pytest.approx(FLOOR_RESTITUTION**2 * drop, rel=0.12)
        assert heights.min() > -0.05 * radius

    def test_bounces_are_told_with_their_impulse_and_end(self) -> None:
        found = run(rigid(position=(0, 2, 0), starts=True, restitution=1.0), frames=81)
        floor = [meeting for meeting in found.meetings if meeting.b is None]
        speed = math.sqrt(2 * G * (2 - RADIUS))
        assert floor[0].time == pytest.approx(speed / G, abs=2 / 64)
        assert floor[0].impulse == pytest.approx((1 + FLOOR_RESTITUTION) * speed, rel=0.05)
        assert all(later.impulse < 0.7 * sooner.impulse for sooner, later in pairwise(floor))
        assert found.positions[0, -1, 1] == pytest.approx(RADIUS, abs=2e-3)
        assert np.abs(found.velocities[0, -1]).max() < 1e-3

    @pytest.mark.parametrize(
        ("shape", "half", "height", "x", "z"),
        [("sphere", RADIUS, RADIUS, 1.2, 0.4), ("cylinder", RADIUS, 0.3, 1.2, 0.4), ("box", 0.64, 0.4, 0.25, 0)],
    )
    def test_what_glides_keeps_its_velocity_however_large_and_slow(self, shape, half, height, x, z) -> None:
        body = rigid(shape, half, height, velocity=(x, 0, z), starts=True, glides=True)
        found = run(body, BESIDE, frames=81)
        assert np.abs(found.velocities[0] - [x, 0, z])[:, [0, 2]].max() < 2e-3
        assert found.positions[0, -1] == pytest.approx([5 * x, height, 5 * z], abs=0.01)

    def test_a_ball_that_glides_rolls(self) -> None:
        found = run(rigid(velocity=(1.0, 0, 0), starts=True, glides=True), frames=5)
        angle = 2 * np.arcsin(np.abs(found.turns[0, :, 2]))  # about the axis across its way alone
        assert angle == pytest.approx(np.arange(5) / FPS / RADIUS, abs=0.02)
        slower = run(gliding(Course((Leg(0.25, (1.0, 0, 0)), Leg(0.25, (0.5, 0, 0))))), frames=9)
        for each in (found, slower):
            assert np.abs(each.turns[0, :, :2]).max() < 1e-3

    def test_what_does_not_glide_comes_to_rest(self) -> None:
        body = rigid("box", velocity=(1.5, 0, 0), starts=True, friction=1.0)
        found = run(body, frames=65)
        assert found.positions[0, -1, 0] == pytest.approx(1.5**2 / (2 * FLOOR_FRICTION * G), rel=0.05)
        assert np.abs(found.velocities[0, -1]).max() < 1e-3


class TestSeveralBodies:
    def test_equal_bodies_exchange_their_velocities(self) -> None:
        other = {"falls": False, "friction": 0.0, "restitution": 1.0}
        found = run(
            rigid(position=(-1, 3, 0), velocity=(2, 0, 0), starts=True, **other), rigid(position=(0, 3, 0), **other)
        )
        assert found.velocities[:, -1] == pytest.approx(np.array([[0, 0, 0], [2, 0, 0]]), abs=1e-4)
        (met,) = (meeting for meeting in found.meetings if meeting.b == 1)
        assert (met.a, met.impulse) == (0, pytest.approx(2.0, abs=1e-4))
        assert met.time == pytest.approx((1 - 2 * RADIUS) / 2, abs=2 / 64)

    def test_momentum_of_unequal_ones_stays(self) -> None:
        other = {"falls": False, "friction": 0.0, "restitution": 0.6}
        bodies = (
            rigid(position=(-1, 3, 0), velocity=(2, 0, 0.1), starts=True, **other),
            rigid("box", half=0.3, position=(0.2, 3, 0), **other),
        )
        found = run(*bodies)
        before, after = (
            sum(mass(body) * found.velocities[i, frame] for i, body in enumerate(bodies)) for frame in (0, -1)
        )
        assert after == pytest.approx(before, abs=1e-5)
        assert found.velocities[1, -1, 0] > 0.05
        ball = rigid(position=(-1, RADIUS, 0), velocity=(1.5, 0, 0), starts=True, glides=True)
        pushed = run(ball, rigid("box", height=0.1), BESIDE, frames=81)
        assert pushed.moved == {0, 1}
        assert np.abs(pushed.velocities[1, -1]).max() < 1e-3, "friction takes it away on the floor"

    @pytest.mark.parametrize("beside", [False, True])
    def test_what_leans_on_a_thing_that_is_hit_moves_with_it(self, beside: bool) -> None:
        ball = rigid(position=(-1.5, RADIUS, 0), velocity=(4, 0, 0), starts=True, glides=True)
        row = [rigid(position=(x, RADIUS, 0)) for x in (0, 2 * RADIUS, 4 * RADIUS)]
        found = run(ball, *row, beside=beside)
        assert found.moved == {0, 1, 2, 3}
        assert (np.diff(found.positions[:, -1, 0]) > 1.9 * RADIUS).all(), "none passes through another"
        table = rigid("box", half=0.3)
        found = run(ball, table, rigid(position=(0, 2 * RADIUS + 0.1, 0), half=0.1), frames=33, beside=beside)
        assert 2 in found.moved

    def test_what_is_passed_by_closely_is_not_touched(self) -> None:
        for speed in (1.0, 3.0, 10.0):
            for beside in (False, True):
                ball = rigid(position=(-2, RADIUS, 0), velocity=(speed, 0, 0), starts=True, glides=True)
                missed, hit = (
                    run(ball, rigid(position=(0, RADIUS, 2 * RADIUS * reach)), beside=beside) for reach in (1.03, 0.97)
                )
                assert [meeting for meeting in missed.meetings if meeting.b == 1] == []
                assert [meeting.a for meeting in hit.meetings if meeting.b == 1] == [0]

    def test_a_fast_thing_does_not_pass_through_a_thin_one(self) -> None:
        wall = rigid("box", half=0.02, half_depth=1.0, height=0.5, position=(0, 0.5, 0))
        found = run(rigid(position=(-3, 0.3, 0), velocity=(50, 0, 0), starts=True, falls=False), wall, frames=5)
        assert any(meeting.b == 1 for meeting in found.meetings)

    def test_a_ghost_passes_through_everything_and_is_told_what_it_meets(self) -> None:
        others = rigid("box", position=(1, RADIUS, 0)), rigid("cylinder", position=(2, RADIUS, 0))
        path = np.linspace((0, RADIUS, 0), (3, RADIUS, 0), 49)
        ghost = rigid(velocity=(1, 0, 0), starts=True, ghost=True, falls=False)
        led = rigid(follows=path, falls=False)
        for body in (ghost, led):
            found = run(body, *others)
            assert found.positions[0] == pytest.approx(path, abs=1e-5)
            assert [meeting.b for meeting in found.meetings if meeting.a == 0 and meeting.b is not None] == [1, 2]
            times = [meeting.time for meeting in found.meetings if meeting.a == 0 and meeting.b is not None]
            assert times == pytest.approx([1 - 2 * RADIUS, 2 - 2 * RADIUS], abs=2 / 64)
            assert (found.positions[1:] == found.positions[1:, :1]).all()
            assert found.moved == {0}


class TestWorldsBesideEachOther:
    def throws(self, count: int) -> list[list[RigidShape]]:
        speeds = np.linspace(0.5, 6, count)
        return [
            [rigid(position=(0, 1, 0), velocity=(v, 1, 0), starts=True), rigid(position=(2, RADIUS, 0))] for v in speeds
        ]

    def test_each_does_what_it_does_with_one_other(self) -> None:
        worlds = self.throws(30)
        together = run_worlds(worlds, 33, FPS)
        for k in (0, 13, 29):
            apart = run_worlds([worlds[k], worlds[0]], 33, FPS)[0]
            assert together[k].positions == pytest.approx(apart.positions, abs=5e-3)
            assert [(m.a, m.b) for m in together[k].meetings] == [(m.a, m.b) for m in apart.meetings]

    @pytest.mark.parametrize("speed", [30.0, 2000.0])
    def test_what_leaves_its_world_meets_nothing_of_another(self, speed: float) -> None:
        turns = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        worlds = [
            [
                rigid(
                    position=(0, 0.5, 0), starts=True, falls=False,
                    velocity=(speed * math.cos(turn), 0, speed * math.sin(turn)),
                ),
                rigid("box", half=1.0, height=2.0, position=(-2 * math.cos(turn), 2.0, -2 * math.sin(turn))),
            ]
            for turn in turns
        ]  # fmt: skip
        for turn, found in zip(turns, run_worlds(worlds, 33, FPS), strict=True):
            assert [meeting for meeting in found.meetings if meeting.a == 0] == []
            reached = speed * 2 * np.array([math.cos(turn), math.sin(turn)])
            assert found.positions[0, -1, [0, 2]] == pytest.approx(reached, rel=1e-3, abs=1e-2)
            assert (found.positions[1] == found.positions[1, 0]).all()

    def test_one_that_is_finished_goes_on_in_a_straight_line_over_the_floor(self) -> None:
        def beyond(positions, velocities):
            return positions[:, 0] > 1

        ball = rigid(position=(0, 3, 0), velocity=(2, 0, 0), starts=True)
        found = run_worlds([[ball], [replace(ball, velocity=(0.2, 0, 0))]], 65, FPS, finished=beyond)
        assert found[0].positions[0, -1, 0] == pytest.approx(8, abs=1e-3)
        assert found[1].positions[0, -1, 0] < 0.8
        assert min(world.positions[0, :, 1].min() for world in found) > 0.9 * RADIUS


@st.composite
def any_worlds(draw, apart: bool) -> list[RigidShape]:
    """Bodies of random shapes, sizes and velocities; `apart`: none overlaps another, else anything."""
    unit = 10 ** draw(st.floats(-3, 2))  # m: half the width of the first
    spread = draw(st.floats(0.5, 20))
    fastest = 10 ** draw(st.floats(-1, 5))  # in half widths per second
    count = draw(st.integers(1, 40))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    bodies: list[RigidShape] = []
    edge = 0.0
    for i in range(count):
        shape = str(rng.choice(["sphere", "box", "cylinder", "cone"]))
        half = unit * (10 ** rng.uniform(-1, 1) if i else 1.0)
        height = half if shape == "sphere" else half * 10 ** rng.uniform(-0.6, 0.8)
        lift = unit * rng.uniform(0, 8) * (rng.random() < 0.3)
        edge += 1.5 * half
        place = (edge, 0.0) if apart else (spread * unit * rng.normal(), spread * unit * rng.normal())
        edge += 1.5 * half
        starts = i == 0 or bool(rng.random() < 0.2)
        velocity = rng.normal(0, 1, 3) * unit * fastest * rng.random() ** 3 if starts else np.zeros(3)
        bodies.append(
            rigid(
                shape, half, height, position=(place[0], height + lift, place[1]), yaw=rng.uniform(-4, 4),
                velocity=tuple(velocity.tolist()), friction=rng.uniform(0, 2), restitution=rng.uniform(0, 1),
                starts=starts, glides=bool(i == 0 and rng.random() < 0.5), falls=bool(i == 0 or rng.random() < 0.8),
            )
        )  # fmt: skip
    return bodies


class TestAnyWorld:
    def run(self, bodies: list[RigidShape]) -> WorldRun:
        found, again = run_worlds([bodies], 33, FPS)[0], run_worlds([bodies, bodies], 33, FPS, every=2)[1]
        for array in (found.positions, found.velocities, found.turns, again.positions, again.velocities):
            assert np.isfinite(array).all()
        assert all(math.isfinite(meeting.impulse) for meeting in found.meetings)
        return found

    @given(any_worlds(apart=True))
    def test_of_bodies_apart_no_energy_grows_and_none_falls_through_the_floor(self, bodies: list[RigidShape]) -> None:
        found = self.run(bodies)
        have, start = energy(bodies, found), spin_at_start(bodies)
        # A body starts up to 1/150 of the first one's half width above the floor.
        lifted = sum(mass(body) for body in bodies) * G * bodies[0].half_width / 100
        assert (have <= (1 + 1e-3) * (have[0] + start) + lifted).all()
        # What is hit by something a thousand times faster than it is wide may dip into the floor, and comes back.
        low = np.array([found.positions[i, :, 1] for i, body in enumerate(bodies) if body.falls]) / bodies[0].half_width
        assert low.min() > -2
        assert low[:, -1].min() > -0.1

    @given(any_worlds(apart=False))
    def test_bodies_inside_each_other_part_slowly(self, bodies: list[RigidShape]) -> None:
        """They are pushed apart at 1 m/s in the engine, where the first is 0.15 m: for the whole clip at most, upwards
        in the worst case, and keep a few such speeds."""
        found = self.run(bodies)
        have, start = energy(bodies, found), spin_at_start(bodies)
        parting = bodies[0].half_width / 0.15  # m/s
        per_mass = G * parting * 2.0 + (3 * parting) ** 2 / 2
        assert (have <= (1 + 0.05) * (have[0] + start) + sum(mass(body) for body in bodies) * per_mass).all()


DURATIONS = st.lists(st.floats(0.05, 1.5), min_size=1, max_size=4)
SPEEDS = st.floats(-2, 2)


def gliding(course: Course, **other: Any) -> RigidShape:
    return rigid(velocity=course.legs[0].velocity, starts=True, glides=True, course=course, **other)


class TestCourse:
    @given(DURATIONS, st.lists(st.tuples(SPEEDS, SPEEDS), min_size=4, max_size=4), st.booleans())
    def test_it_ends_where_its_legs_lead(self, durations, speeds, beside: bool) -> None:
        legs = tuple(Leg(seconds, (x, 0.0, z)) for seconds, (x, z) in zip(durations, speeds, strict=False))
        found = run(gliding(Course(legs)), rigid("box", position=(50, RADIUS, 0)), frames=65, beside=beside)
        wanted = sum(leg.duration * np.array(leg.velocity) for leg in legs if leg.duration)
        end = math.ceil(Course(legs).end * FPS) + 1
        if end < 65:
            shift = found.positions[0] - found.positions[0, 0]
            assert shift[end, [0, 2]] == pytest.approx(wanted[[0, 2]], abs=2e-3)
            assert shift[-1] == pytest.approx(shift[end], abs=2e-3), "at rest after the last leg"

    @pytest.mark.parametrize("halts", [True, False])
    def test_it_stops_where_it_first_meets_something_or_pushes_it(self, halts: bool) -> None:
        course = Course((Leg(2.0, (1.0, 0.0, 0.0)), Leg(1.0, (0.0, 0.0, 5.0))), halts)
        found = run(gliding(course), rigid("box", position=(1.0, RADIUS, 0)), frames=65)
        assert (found.positions[0, -1, 0] == pytest.approx(1 - 2 * RADIUS, abs=0.02)) or not halts
        assert (found.positions[1, -1, 0] > 1.1) is not halts
        assert abs(found.positions[0, -1, 2]) < 0.2, "the second leg is not taken any more"

    def test_what_it_stands_on_does_not_end_it_and_in_the_air_it_stays_where_it_stops(self) -> None:
        table = rigid("box", half_width=1.0, half_depth=1.0, half_height=0.5, position=(0.0, 0.5, 0.0))
        ball = gliding(Course((Leg(0.2, (1.0, 0.0, 0.0)),)), position=(0.0, 1.0 + RADIUS, 0.0))
        assert run(ball, table).positions[0, -1, 0] == pytest.approx(0.2, abs=0.02)
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
        ({"duration": 0.7}, 50, [0.7]),
        ({"distance": 50, "duration": 0.2}, 100, [0.2]),
        ({"distance": 50, "steps": [DOWN]}, 100, [0.5, math.inf]),
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
    assert course_of(motion(), [np.zeros(3)], 100) is None, "what just goes on has no course"
