"""Hollow bodies in the engine, their openings in the image, and bodies that are put somewhere and stay there."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import RADIUS, energy, rigid

from cow_service.physics.bodies import SeenOpening
from cow_service.physics.draws import COLUMN, ensemble, likeliest
from cow_service.physics.engine import BOX_SIDES, ROUND_SIDES, Hollow, RigidShape, WorldRun, run_worlds
from cow_service.physics.placement import PlacementGoal, carry, classify, hollow_of, settle

INTO = PlacementGoal("into", (1,))
HALF, HEIGHT = 0.2, 0.1  # m: half the width and half the height of the container


def container(opening: float = 0.9, base: float = 0.6, sides: int = ROUND_SIDES) -> RigidShape:
    """With an opening and a floor of shares of its half width."""
    hollow = Hollow(opening * HALF, base * opening * HALF, 1.85 * HEIGHT, sides)
    return rigid("cylinder", HALF, HEIGHT, position=(0.0, HEIGHT, 2.0), hollow=hollow)


def dropped(body: RigidShape, into: RigidShape, seconds: float = 2.0) -> WorldRun:
    return run_worlds([[body, into]], round(30 * seconds), 30)[0]


def over(into: RigidShape, share: float, shape: str = "sphere", off: float = 0.0, **more) -> RigidShape:
    """A body of a share of the opening's width, just above the rim."""
    assert into.hollow is not None
    half = share * into.hollow.opening
    position = (off * half, 2 * HEIGHT + 1.1 * half, 2.0)
    return rigid(shape, half, position=position, starts=True, **more)


class TestFallingIn:
    @settings(max_examples=20)
    @given(
        share=st.floats(0.25, 0.85), off=st.floats(-0.05, 0.05), base=st.floats(0.4, 1.0),
        sides=st.sampled_from([ROUND_SIDES, BOX_SIDES]),
    )  # fmt: skip
    def test_a_ball_smaller_than_the_opening_ends_inside(self, share, off, base, sides) -> None:
        into = container(base=base, sides=sides)
        ball = over(into, share, off=off)
        run = dropped(ball, into)
        result, clearance, _ = classify(INTO, (ball, into), run, (ball, into))
        assert result in ("inside", "sticks-out")
        assert share > 0.6 or result == "inside"
        assert clearance == pytest.approx(1 - share)
        low = run.positions[0, :, 1] - ball.half_width
        assert low.min() > -0.01 * HALF  # nothing sinks through the bottom
        assert math.hypot(*(run.positions[0, -1] - run.positions[1, -1])[[0, 2]]) < HALF

    @given(share=st.floats(1.1, 1.8), off=st.floats(-0.03, 0.03), base=st.floats(0.4, 1.0))
    def test_a_larger_one_rests_on_the_rim(self, share, off, base) -> None:
        into = container(base=base)
        ball = over(into, share, off=off)
        run = dropped(ball, into)
        assert classify(INTO, (ball, into), run, (ball, into))[0] == "on-the-rim"
        assert run.positions[0, -1, 1] > 2 * HEIGHT
        met = [each for each in run.meetings if (each.a, each.b) == (0, 1)]
        assert 1 <= len(met) <= 4, "however many pieces touch"

    @given(share=st.floats(0.3, 1.5), base=st.floats(0.4, 1.0), shape=st.sampled_from(["sphere", "cylinder", "box"]))
    def test_energy_does_not_grow(self, share, base, shape) -> None:
        into = container(base=base)
        body = over(into, share, shape)
        run = dropped(body, into)
        one = energy([body], WorldRun(run.positions[:1], run.velocities[:1], run.turns[:1], [], set()))
        assert one.max() <= one[0] * 1.01
        assert run.positions[1, :, 1].max() < HEIGHT * 1.1  # nor is the container thrown up

    def test_a_cube_goes_through_a_round_opening_by_its_diagonal_and_a_bottle_sticks_out(self) -> None:
        round_one, square = container(base=1.0), container(base=1.0, sides=BOX_SIDES)
        cube = over(round_one, 0.8, "box")  # 0.8 of the opening along its side, 1.13 across
        bottle = rigid("cylinder", 0.1, 0.25, position=(0.0, 2 * HEIGHT + 0.26, 2.0), starts=True)
        for body, into, clearance, result in (
            (cube, round_one, 1 - 0.8 * math.sqrt(2), "on-the-rim"),
            (cube, square, 0.2, "inside"),
            (bottle, container(), 1 - 0.1 / (0.9 * HALF), "sticks-out"),
        ):
            found = classify(INTO, (body, into), dropped(body, into, 1.5), ())
            assert found[:2] == (result, pytest.approx(clearance))

    def test_the_draw_decides_the_width(self) -> None:
        seen, row = SeenOpening(0.9, 0.05, 0.5), likeliest()[0]
        row[COLUMN["opening"]] = 1.0
        wide, usual = hollow_of(seen, HALF, HEIGHT, row), hollow_of(seen, HALF, HEIGHT, likeliest()[0])
        assert usual.opening == pytest.approx(0.9 * HALF)
        assert wide.opening == pytest.approx(0.9 * math.exp(0.05) * HALF)
        assert usual.bottom < usual.opening
        assert usual.depth < 2 * HEIGHT


SHAPES = st.sampled_from(["sphere", "box", "cylinder"])
SIZES = st.floats(0.05, 0.4)


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
    opening = SeenOpening(0.9, 0.05, 0.7, None, False) if relation == "into" else None
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


# A mover far away, a cube 0.4 m wide three metres ahead, a small cylinder that is put somewhere, and two more cubes.
SCENE = (
    rigid(position=(-3.0, RADIUS, 3.0)),
    rigid("box", 0.2, position=(0.0, 0.2, 3.0)),
    rigid("cylinder", 0.1, 0.15, position=(2.5, 0.15, 3.0)),
    rigid("box", 0.2, position=(0.8, 0.2, 3.0)),
    rigid("box", 0.2, position=(1.35, 0.2, 3.0)),
)


@pytest.mark.parametrize(
    ("goal", "place", "result"),
    [
        (PlacementGoal("onto", (1,), body=2), (0.0, 0.55, 3.0), "on-top"),
        (PlacementGoal("left-of", (1,), body=2), (-0.35, 0.15, 3.0), "beside"),
        (PlacementGoal("right-of", (1,), body=2), (0.35, 0.15, 3.0), "beside"),
        (PlacementGoal("next-to", (1,), side=-1, body=2), (-0.35, 0.15, 3.0), "beside"),
        (PlacementGoal("in-front-of", (1,), body=2), (0.0, 0.15, 2.65), "beside"),
        (PlacementGoal("behind", (1,), body=2), (0.0, 0.15, 3.35), "beside"),
        (PlacementGoal("between", (1, 3), body=2), (0.4, 0.15, 3.0), "beside"),
        (PlacementGoal("between", (3, 4), body=2), None, "overlaps"),
        (PlacementGoal("onto", (0,), body=2), None, "falls-off"),
    ],
)
def test_where_things_are_put_and_what_becomes_of_them(goal: PlacementGoal, place: Any, result: str) -> None:
    settled = settle((goal,), (SCENE,), likeliest(), 24.0)
    (found,) = settled.placements
    assert (found.meant, found.results, found.fits.tolist()) == (goal.meant, (result,), [place is not None])
    assert found.stays.tolist() == [place is not None]
    if place is not None:
        assert settled.shapes[0][2].position == pytest.approx(place, abs=0.01)
        assert settled.shapes[0][1].position == pytest.approx(SCENE[1].position, abs=1e-3)
    if goal.relation == "between":
        assert found.clearance.tolist() == pytest.approx([0.5 if place is not None else -1 / 3])


def test_what_is_carried_goes_up_over_and_down_and_is_released_there() -> None:
    begun, (run,), found = carry(PlacementGoal("onto", (1,), body=2), (SCENE,), likeliest(), 1.0, 49, 24.0, 1)
    way = run.positions[2]
    assert (found.released, found.results, found.times.tolist()) == (1.0, ("on-top",), [1.0])
    assert begun[0][0] == SCENE[0]
    assert way[0] == pytest.approx((2.5, 0.15, 3.0))
    assert way[24] == pytest.approx((0.0, 0.55, 3.0), abs=0.02)
    assert way[48] == pytest.approx((0.0, 0.55, 3.0), abs=0.01)
    assert way[12] == pytest.approx((1.25, 0.35 + 0.3 * 2.5, 3.0), abs=0.01), "half way in half the time"
    assert np.abs(run.velocities[2, [0, 24]]).max() < 0.4, "it sets out and arrives at rest"
    assert (np.diff(way[:25, 0]) <= 0).all()
    assert min(meeting.time for meeting in run.meetings if 2 in (meeting.a, meeting.b)) >= 1.0
