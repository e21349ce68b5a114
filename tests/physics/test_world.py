"""Worlds of placed bodies: what the mover touches, covers and is covered by, and when."""

from __future__ import annotations

import math

import numpy as np
import pytest
from floors import TrueCamera, known, outline

from cow_service.physics.bodies import SeenBody
from cow_service.physics.draws import ensemble, likeliest
from cow_service.physics.events import Events, encounters, find_world_events, seen_paths
from cow_service.physics.recording import rotation, states
from cow_service.physics.world import DrawnWorlds, WorldInput, Worlds, run_world
from cow_service.records import MetresPerPixel, Motion
from cow_service.vision.masks import CroppedMask

CAMERA = TrueCamera(pitch=25, height=1.5)
HALF = 0.12  # m
SPEED = 1.2  # m/s
FRAMES, FPS = 65, 16.0


def drawn(name: str, shape: str, bbox) -> SeenBody:
    x0, y0, x1, y1 = bbox
    ys, xs = np.mgrid[:400, :640] + 0.5
    inside = (xs >= x0) & (xs < x1) & (ys >= y0) & (ys < y1)
    if shape == "sphere":
        inside &= ((xs - (x0 + x1) / 2) / (x1 - x0)) ** 2 + ((ys - (y0 + y1) / 2) / (y1 - y0)) ** 2 < 0.25
    return SeenBody(name, bbox, CroppedMask.of(inside), shape)


def ball(right: float, ahead: float, above: float = 0.0) -> SeenBody:
    return drawn("ball", "sphere", CAMERA.sphere_box((right, above + HALF, ahead), HALF))


def post(right: float, ahead: float, half: float = 0.12, height: float = 0.35, name: str = "post") -> SeenBody:
    return drawn(name, "cylinder", CAMERA.box(outline("cylinder", (right, ahead), half, height)))


def moving(mover: SeenBody, ahead: float, kind="linear", direction=(1.0, 0.0), speed=SPEED, above=0.0) -> Motion:
    """At a scale that makes metres those of the true camera."""
    middle = np.array([[0.0, above + HALF, ahead]])
    scale = CAMERA.positions(middle)[0, 2] / CAMERA.focal
    return Motion(
        kind=kind, law="contact", direction=direction, cue="request", speed=speed / scale, sentence="",
        metres_per_pixel=MetresPerPixel(value=scale, source="reference"), source="request",
    )  # fmt: skip


def happened(bodies, motion: Motion, draws=None, every: int = 1, doubt: float = 1e-6) -> tuple[Worlds, Events]:
    world = WorldInput(tuple(bodies), motion, known(CAMERA, doubt), CAMERA.size, FRAMES, FPS)
    rows = likeliest() if draws is None else draws
    worlds = run_world(world, rows, every)
    return worlds, find_world_events(worlds, bodies, rows, CAMERA.size).of[0]


def kinds(events: Events, body: int = 1) -> set[str]:
    return {kind for kind in events.times if np.isfinite(events.times[kind][0, body])}


class TestRolling:
    def roll(self, *others: SeenBody, **more) -> tuple[Worlds, Events]:
        mover = ball(-1.2, 3.0)
        return happened([mover, *others], moving(mover, 3.0), **more)

    def test_what_stands_on_the_way_is_touched_when_the_rims_meet(self) -> None:
        worlds, events = self.roll(post(0.2, 3.0))
        assert "touches" in kinds(events)
        assert events.times["touches"][0, 1] == pytest.approx((1.4 - 0.24) / SPEED, abs=0.1)
        assert 1 in worlds.runs[0].moved
        bodies = [ball(-1.2, 3.0), post(0.2, 3.0)]
        found = find_world_events(worlds, bodies, likeliest(), CAMERA.size)
        (met,) = (each for each in encounters(found, None, bodies, FPS, FRAMES) if each.kind == "touches")
        assert met.first_frame == math.ceil(events.times["touches"][0, 1] * FPS)

    def test_before_it_it_covers_and_behind_it_it_is_covered(self) -> None:
        assert kinds(self.roll(post(0.2, 3.4, half=0.1, height=0.12))[1]) == {"occludes"}
        worlds, events = self.roll(post(0.2, 2.5, height=0.5))
        assert kinds(events) == {"occluded-by"}
        assert events.shares["occluded-by"][0, 1] > 0.8
        assert events.times["occluded-by"][0, 1] == pytest.approx((1.2 + 0.2 * 3 / 2.5 - 0.2) / SPEED, abs=0.25)
        assert worlds.runs[0].moved == {0}

    def test_far_beside_its_way_nothing_is_met(self) -> None:
        assert kinds(self.roll(post(0.2, 6.0, height=0.2))[1]) == set()
        assert kinds(self.roll(post(-2.0, 3.0))[1]) == set(), "it rolls away from it"

    def test_the_nearer_of_two_on_the_way_is_met_first(self) -> None:
        _, events = self.roll(post(0.9, 3.0), post(-0.1, 3.0))
        assert events.times["touches"][0, 2] < events.times["touches"][0, 1]

    def test_an_ensemble_knows_how_sure_it_is(self) -> None:
        on, beside, edge = (
            self.roll(post(0.0, ahead), draws=ensemble(60), every=2, doubt=0.08)[1] for ahead in (3.0, 3.9, 3.24)
        )
        shares = [events.share("touches", 1) for events in (on, beside, edge)]
        assert shares[0] > 0.9
        assert shares[1] < 0.1
        assert 0.1 < shares[2] < 0.9

    def test_a_ball_turns_as_it_rolls_and_states_agree_with_points(self) -> None:
        worlds, _ = self.roll()
        turned = rotation(worlds, 0)
        rolled = np.degrees(SPEED * np.arange(FRAMES) / FPS / HALF)
        assert turned[16] == pytest.approx(rolled[16], rel=0.15), "clockwise, nearly: it is seen from above"
        found = states(worlds, 0)
        points = found[:, :2] / found[:, 2:3] * CAMERA.focal + np.array([320, 200])
        assert points == pytest.approx(seen_paths(worlds, 0).points[0], abs=0.01)
        assert np.diff(found[:17, :3], axis=0) * FPS == pytest.approx(found[1:17, 3:], abs=0.15)


class TestFalling:
    def test_it_lands_on_what_is_below_and_not_on_what_is_beside(self) -> None:
        for right, hit in ((0.0, True), (0.6, False)):
            mover = ball(0.0, 3.0, above=0.9)
            fit = known(CAMERA)
            # The height above the floor, in radii, is what a fit says of what flies.
            fit.mean[2] = math.log((0.9 + HALF) / HALF)
            world = WorldInput(
                (mover, post(right, 3.0, half=0.2, height=0.3)), moving(mover, 3.0, "fall", None, 0.0, above=0.9), fit,
                CAMERA.size, FRAMES, FPS,
            )  # fmt: skip
            worlds = run_world(world, likeliest())
            events = find_world_events(worlds, world.bodies, likeliest(), CAMERA.size).of[0]
            assert ("touches" in kinds(events)) == hit
            if hit:
                assert events.times["touches"][0, 1] == pytest.approx(math.sqrt(2 * 0.6 / 9.81), abs=0.1)
            heights = worlds.runs[0].positions[0, :, 1]
            assert heights[0] == pytest.approx(0.9 + HALF, rel=0.05)
            assert heights.min() > 0.9 * HALF

    def test_a_throw_flies_as_far_as_the_closed_form_says(self) -> None:
        mover = ball(-1.0, 3.0, above=0.5)
        fit = known(CAMERA)
        fit.mean[2] = math.log((0.5 + HALF) / HALF)
        motion = moving(mover, 3.0, "projectile", (math.cos(0.4), -math.sin(0.4)), 2.5, above=0.5)
        world = WorldInput((mover,), motion, fit, CAMERA.size, FRAMES, FPS)
        run = run_world(world, likeliest()).runs[0]
        rise, forward = run.velocities[0, 0, 1], run.velocities[0, 0, 0]
        assert np.linalg.norm(run.velocities[0, 0]) == pytest.approx(2.5, rel=0.02)
        lands = (rise + math.sqrt(rise**2 + 2 * 9.81 * 0.5)) / 9.81
        bounce = next(meeting for meeting in run.meetings if meeting.b is None)
        assert bounce.time == pytest.approx(lands, abs=0.05)
        frame = int(lands * FPS) - 1
        assert run.positions[0, frame, 0] - run.positions[0, 0, 0] == pytest.approx(forward * frame / FPS, rel=0.01)


class TestOnATable:
    def test_the_table_is_no_encounter_and_the_ball_rolls_off_it(self) -> None:
        table = drawn("table", "box", CAMERA.box(outline("box", (-0.6, 3.0), 0.5, 0.4)))
        mover = ball(-0.6, 3.0, above=0.4)
        worlds, events = happened([mover, table], moving(mover, 3.0, above=0.4))
        assert worlds.layout.supports == (1, None)
        assert not events.eligible[1]
        heights = worlds.runs[0].positions[0, :, 1]
        # Of a table the box alone is known: its near edge looks wider, so that its far one is taken to be farther.
        assert heights[0] == pytest.approx(0.4 + HALF, rel=0.25)
        assert heights[-1] == pytest.approx(float(worlds.layout.bodies[0].half_height[0]), rel=0.1), "on the floor"


def test_worlds_run_in_batches_are_those_run_at_once() -> None:
    mover, rows = ball(-1.2, 3.0), ensemble(9)
    bodies = (mover, post(0.2, 3.0))
    world = WorldInput(bodies, moving(mover, 3.0), known(CAMERA, 0.02), CAMERA.size, FRAMES, FPS)
    drawn = DrawnWorlds.of(world, rows, 2)
    parts = drawn.run(slice(0, 4)), drawn.run(slice(4, 9))
    joined, at_once = parts[0].joined(parts[1], drawn.layout.of(slice(0, 9))), run_world(world, rows, 2)
    assert len({run.positions.shape for run in joined.runs}) == 1, "the batch that rests sooner is continued"
    for one, other in zip(joined.runs, at_once.runs, strict=True):
        frames = min(one.positions.shape[1], other.positions.shape[1])
        np.testing.assert_allclose(one.positions[:, :frames], other.positions[:, :frames], atol=0.05)
    touches = [find_world_events(each, bodies, rows, CAMERA.size).of[0].times["touches"] for each in (joined, at_once)]
    assert np.isfinite(touches[1][:, 1]).any()
    np.testing.assert_allclose(touches[0], touches[1], atol=0.07)
