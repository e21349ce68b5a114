from dataclasses import replace

import numpy as np
import pytest

from cow_scenes.forms.base import stand
from cow_scenes.physics import simulate
from cow_scenes.world import FPS, World

TIME = np.arange(61) / FPS


def world(shape, target, velocity, at=(0, 0), **more):
    things = (stand(shape, "red", np.array([-0.8, 0])), stand(target, "blue", np.array(at)))
    return World(things, things[0].name, velocity, frictionless=frozenset({things[0].name}), **more)


def test_a_flight_follows_the_parabola():
    ball = stand("ball", "red", np.array([0, 0]), lift=2.0)
    run = simulate(World((ball,), ball.name, (0.5, 0.2, 1.0)))
    t = TIME[:20]
    expected = np.stack([0.5 * t, 0.2 * t, ball.centre[2] + t - 9.81 * t * t / 2], 1)
    assert np.allclose(run.centres[ball.name][:20], expected, atol=0.03)


def test_what_slides_keeps_its_speed():
    run = simulate(world("cube", "mug", (1.0, 0.0, 0.0), at=(0, 1.5)))
    assert np.allclose(run.centres["red cube"][:, 0], -0.8 + TIME, atol=0.01)
    assert run.contacts == ()
    assert run.gaps["blue mug"] == pytest.approx(1.5 - 0.15 - 0.12, abs=0.1)


def test_a_hit_is_told_with_time_point_and_impulse():
    run = simulate(world("cube", "cube", (1.0, 0.0, 0.0)))
    contact = run.first("red cube", "blue cube")
    assert contact.time == pytest.approx(0.5, abs=0.01)
    assert contact.sample in {15, 16}
    assert contact.point[0] == pytest.approx(-0.15, abs=0.02)
    assert contact.impulse == pytest.approx(0.5 * 1.25, abs=0.1)
    assert run.gaps["blue cube"] == 0
    assert run.centres["blue cube"][-1][0] > 0.02


@pytest.mark.parametrize("target", ["ball", "cube", "mug", "bottle", "vase", "candle", "cylinder", "cone", "bowl"])
def test_every_shape_can_be_hit_and_stands_still_before(target):
    run = simulate(world("cube", target, (1.0, 0.0, 0.0)))
    contact = run.first("red cube", f"blue {target}")
    assert contact is not None
    still = run.centres[f"blue {target}"][: contact.sample]
    assert np.abs(still - still[0]).max() < 0.005


def test_the_same_world_gives_the_same_numbers():
    a, b = (simulate(world("ball", "vase", (1.3, 0.02, 0.0))) for _ in range(2))
    assert a.contacts == b.contacts
    assert all((a.centres[n] == b.centres[n]).all() for n in a.centres)


def test_what_is_taken_away_is_not_met():
    barred = world("cube", "mug", (1.2, 0.0, 0.0))
    run = simulate(replace(barred, removed="blue mug"))
    assert run.first("red cube", "blue mug") is None
    assert (run.centres["blue mug"] == [0, 0, -9]).all()
    assert simulate(barred).first("red cube", "blue mug") is not None


@pytest.mark.parametrize(("scale", "inside"), [(0.8, True), (1.9, False)])
def test_a_ball_put_into_a_bowl(scale, inside):
    ball, bowl = stand("ball", "red", np.array([-0.9, 0]), scale=scale), stand("bowl", "blue", np.array([0, 0]))
    run = simulate(World((ball, bowl), ball.name, carry_to=(0.0, 0.0, 0.25 + ball.height / 2)))
    assert (run.centres[ball.name][-1][2] < 0.2) == inside
    assert np.hypot(*run.centres[ball.name][-1][:2]) < 0.05
