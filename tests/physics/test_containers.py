"""Hollow bodies in the engine, and their openings in the image."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from drawn import bowl, floor
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import energy, rigid

from cow_service.physics.draws import COLUMN, likeliest
from cow_service.physics.engine import BOX_SIDES, ROUND_SIDES, Hollow, RigidShape, WorldRun, run_worlds
from cow_service.physics.placement import PlacementGoal, classify, hollow_of
from cow_service.vision.masks import CroppedMask
from cow_service.vision.openings import SeenOpening, measure_opening

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
    @settings(max_examples=25, deadline=None)
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

    @settings(max_examples=15, deadline=None)
    @given(share=st.floats(1.1, 1.8), off=st.floats(-0.03, 0.03), base=st.floats(0.4, 1.0))
    def test_a_larger_one_rests_on_the_rim(self, share, off, base) -> None:
        into = container(base=base)
        ball = over(into, share, off=off)
        run = dropped(ball, into)
        assert classify(INTO, (ball, into), run, (ball, into))[0] == "on-the-rim"
        assert run.positions[0, -1, 1] > 2 * HEIGHT

    @settings(max_examples=15, deadline=None)
    @given(share=st.floats(0.3, 1.5), base=st.floats(0.4, 1.0), shape=st.sampled_from(["sphere", "cylinder", "box"]))
    def test_energy_does_not_grow(self, share, base, shape) -> None:
        into = container(base=base)
        body = over(into, share, shape)
        run = dropped(body, into)
        one = energy([body], WorldRun(run.positions[:1], run.velocities[:1], run.turns[:1], [], set()))
        assert one.max() <= one[0] * 1.01
        assert run.positions[1, :, 1].max() < HEIGHT * 1.1  # nor is the container thrown up

    def test_a_cube_goes_through_a_round_opening_by_its_diagonal(self) -> None:
        round_one, square = container(base=1.0), container(base=1.0, sides=BOX_SIDES)
        cube = over(round_one, 0.8, "box")  # 0.8 of the opening along its side, 1.13 across
        assert classify(INTO, (cube, round_one), dropped(cube, round_one), ())[0] == "on-the-rim"
        assert classify(INTO, (cube, square), dropped(cube, square), ())[0] == "inside"

    def test_a_bottle_sticks_out_of_a_bowl(self) -> None:
        into = container()
        bottle = rigid("cylinder", 0.1, 0.25, position=(0.0, 2 * HEIGHT + 0.26, 2.0), starts=True)
        assert classify(INTO, (bottle, into), dropped(bottle, into, 1.0), ())[0] == "sticks-out"

    def test_many_worlds_are_as_one_and_the_same_every_time(self) -> None:
        into = container()
        worlds = [[over(into, share), into] for share in (0.5, 1.3, 0.8)]
        first, again = (run_worlds(worlds, 60, 30, 2, turns_wanted=True) for _ in range(2))
        for a, b, bodies in zip(first, again, worlds, strict=True):
            assert np.array_equal(a.positions, b.positions)
            assert np.array_equal(a.turns, b.turns)
            alone = dropped(bodies[0], into)
            assert a.positions[0, -1, 1] == pytest.approx(alone.positions[0, -1, 1], abs=0.02)

    def test_two_bodies_meet_once_however_many_pieces_touch(self) -> None:
        into = container()
        ball = over(into, 0.9, restitution=0.0)
        met = [each.time for each in dropped(ball, into).meetings if (each.a, each.b) == (0, 1)]
        assert 1 <= len(met) <= 4


class TestOpenings:
    @settings(max_examples=20, deadline=None)
    @given(half=st.floats(25, 90), base=st.floats(0.4, 0.9), seed=st.integers(0, 3))
    def test_the_rim_of_a_bowl_is_measured(self, half, base, seed) -> None:
        plain = floor(seed=seed)
        image = bowl(plain, (320, 180), half, 0.8 * half, (60, 160, 60), base)
        mask = CroppedMask.of(np.abs(image.astype(int) - plain).max(axis=2) > 20)
        seen = measure_opening(image, mask)
        assert seen.rim is not None
        assert seen.has_edge
        assert seen.rim[2] == pytest.approx(half, abs=max(2.0, 0.05 * half))
        assert seen.inner == pytest.approx(0.9, abs=max(0.04, 2 / half))
        assert seen.bottom == pytest.approx(base, abs=0.12)

    def test_a_handle_is_not_part_of_the_opening(self) -> None:
        plain = floor()
        image = bowl(plain, (320, 180), 60, 110, (60, 160, 60), 1.0)
        cv2.ellipse(image, (385, 250), (25, 30), 0, -90, 90, (45, 120, 45), 10)
        mask = CroppedMask.of(np.abs(image.astype(int) - plain).max(axis=2) > 20)
        seen = measure_opening(image, mask)
        x0, _, x1, _ = mask.bbox
        assert x1 - x0 > 140
        assert seen.inner * (x1 - x0) / 2 == pytest.approx(54, rel=0.06)

    @pytest.mark.parametrize("half", [4, 6, 8])
    def test_a_bowl_too_small_to_be_measured_has_a_common_opening(self, half) -> None:
        plain = floor()
        image = bowl(plain, (320, 180), half, 2 * half, (60, 160, 60))
        seen = measure_opening(image, CroppedMask.of(np.abs(image.astype(int) - plain).max(axis=2) > 20))
        assert 0.8 < seen.inner < 1
        assert not seen.has_edge

    def test_what_has_no_rim_has_a_common_one_with_more_doubt(self) -> None:
        image = floor()
        mask = np.zeros(image.shape[:2], bool)
        mask[100:200, 100:220] = True
        seen = measure_opening(image, CroppedMask.of(mask), square=True)
        assert seen.rim is None
        assert not seen.has_edge
        assert seen.square
        assert 0.85 < seen.inner < 1

    def test_the_draw_decides_the_width(self) -> None:
        seen, row = SeenOpening(0.9, 0.05, 0.5), likeliest()[0]
        row[COLUMN["opening"]] = 1.0
        wide, usual = hollow_of(seen, HALF, HEIGHT, row), hollow_of(seen, HALF, HEIGHT, likeliest()[0])
        assert usual.opening == pytest.approx(0.9 * HALF)
        assert wide.opening == pytest.approx(0.9 * math.exp(0.05) * HALF)
        assert usual.bottom < usual.opening
        assert usual.depth < 2 * HEIGHT
