"""Trails: several positions of one ball, found, taken out of the image, and measured."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from conftest import example
from drawn import ball, block, floor, jpeg, thrown_past, trail
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from runs import run_of

from cow_service.perception.classical.circles import Edges
from cow_service.perception.classical.trails import find_trails
from cow_service.perception.observation import look
from cow_service.physics.bodies import Position
from cow_service.physics.camera import FloorCamera, prior
from cow_service.physics.trail_fit import fit_throw, is_thrown, straight_direction
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.records import Grounding
from cow_service.stages.grounding import ground
from cow_service.stages.motion import settle_motion
from cow_service.stages.run import Run

ORANGE, GREEN, PURPLE = (220, 120, 30), (40, 160, 60), (120, 50, 160)
PLACES = thrown_past((300, 110), (36, -2), 12, 4)  # the oldest first
QUESTION = "If the orange ball flies on along the trail of positions that is shown{}, will it hit the green cube?"


SCENE = block(floor(), (460, 230, 530, 300), GREEN)
OPAQUE = jpeg(trail(SCENE, PLACES, [26.0] * 4, ORANGE, [1.0] * 4), 95)


def test_a_multiple_exposure_is_found_whole_and_leaves_its_end_to_the_words() -> None:
    (found,) = find_trails(OPAQUE)
    seen = sorted(position.centre for position in found.positions)
    assert np.abs(np.array(seen) - np.array(sorted(PLACES))).max() < 1.5
    assert all(abs(position.radius - 26) < 1 for position in found.positions)
    assert not found.end_known
    for ended, place in (
        (found.ending(near=(460, 230, 530, 300)), PLACES[-1]),
        (found.ending(side=(1.0, 0.0)), PLACES[-1]),
        (found.ending(side=(-1.0, 0.0)), PLACES[0]),
    ):
        assert math.dist(ended.present.centre, place) < 1.5


def test_what_is_no_trail() -> None:
    capsule, three = floor(), floor()
    cv2.line(capsule, (120, 300), (200, 120), GREEN, 44, cv2.LINE_AA)
    for x, rgb in ((150, ORANGE), (210, GREEN), (270, PURPLE)):
        three = ball(three, (x, 200), 24, rgb)
    for image in (capsule, three, *(example(name).pixels("image.jpg") for name in ("ball-and-mug", "car-forward"))):
        assert find_trails(image) == ()


def test_three_balls_are_a_trail_only_where_the_question_says_so() -> None:
    image = trail(floor(), thrown_past((420, 120), (110, 6), 8, 3), [24.0] * 3, ORANGE, [1.0] * 3)
    for scene, trails, regions in ((look(image), 0, 3), (look(image).with_trails(), 1, 1)):
        assert (len(scene.trails), len(scene.things)) == (trails, regions)


def test_the_earlier_positions_are_taken_out_and_the_present_one_is_whole() -> None:
    x, y = PLACES[0]
    scene = look(OPAQUE, trails=True).with_mover((x - 26, y - 26, x + 26, y + 26))
    wanted = ball(SCENE, (x, y), 26, ORANGE)
    off = np.abs(scene.clean.astype(int) - wanted).max(axis=2)
    ys, xs = np.mgrid[: off.shape[0], : off.shape[1]]
    assert np.percentile(off[np.abs(np.hypot(xs + 0.5 - x, ys + 0.5 - y) - 26) > 2.5], 99.5) < 40
    assert [region.is_disc for region in scene.things if region.colour == "orange"] == [True]
    assert len(scene.obstacles((x - 26, y - 26, x + 26, y + 26))) == 1  # the cube, and no earlier position


def grounded(image: np.ndarray, question: str) -> tuple[Run, Grounding]:
    run = run_of(image, reader=EmbeddedReader, question=QUESTION.format(question))
    return run, run.stage("grounding", ground)


@pytest.mark.slow
def test_the_question_tells_the_end_and_the_trail_the_motion() -> None:
    run, grounding = grounded(OPAQUE, ", the last of which is the rightmost")
    motion = run.stage("motion", settle_motion, grounding, run.read_motion)
    assert math.dist(grounding.point, PLACES[-1]) < 2
    assert (motion.kind, motion.cue) == ("projectile", "trail")
    assert np.abs(np.array(motion.trail) - np.array(PLACES[:-1])).max() < 1.5
    angle = math.degrees(math.atan2(motion.direction[1], motion.direction[0]))
    assert abs(angle - math.degrees(math.atan2(-2, 36))) < 5
    froude = motion.speed**2 * motion.metres_per_pixel.value / (9.81 * 26)
    as_drawn = (36**2 + 2**2) / 26 / (12 / math.cos(math.radians(28)))  # of a camera with the prior's pitch
    assert math.sqrt(froude) == pytest.approx(math.sqrt(as_drawn), rel=0.12)
    assert motion.speed_deviation < 0.15


@pytest.mark.slow
def test_an_end_that_nothing_tells_is_that_nearest_to_what_is_asked_about() -> None:
    run, grounding = grounded(OPAQUE, "")
    assert grounding.point == pytest.approx(PLACES[-1], abs=1.5)
    assert run.results["grounding"].warnings


def test_a_trail_that_is_not_there_is_refused() -> None:
    run, grounding = grounded(ball(SCENE, (300, 110), 26, ORANGE), "")
    with refused("cannot-read-direction"):
        run.stage("motion", settle_motion, grounding, run.read_motion)


def test_what_rolls_goes_on_straight() -> None:
    rolled = [Position(100 + 30 * i, 200 + 12 * i + 0.3 * (-1) ** i, 20.0, 1.0) for i in range(4)]
    assert not is_thrown(rolled)
    assert straight_direction(rolled) == pytest.approx((0.93, 0.37), abs=0.02)
    assert is_thrown([Position(*place, 26.0, 1.0) for place in PLACES])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 100_000))
def test_a_throw_is_measured_within_its_deviations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    seen = None
    while seen is None:
        seen = throw_seen(rng)
    positions, log_speed, direction, turn = seen
    fit = fit_throw(positions, prior(), (832, 480))
    assert fit is not None
    angle = math.degrees(math.atan2(*reversed(fit.direction)) - math.atan2(*reversed(direction)))
    assert abs(math.log(fit.froude) / 2 - log_speed) < 4.5 * fit.speed_deviation + 0.02
    assert abs((angle + 180) % 360 - 180) < 4.5 * fit.direction_deviation + 1
    assert abs(fit.turn - turn) < 4.5 * fit.turn_deviation + 2
    assert fit.speed_deviation < 0.3


def throw_seen(rng: np.random.Generator) -> tuple[list[Position], float, tuple[float, float], float] | None:
    """Positions of a ball (radius 1) thrown before a camera as the priors have them, and what is true of the throw."""
    pitch, focal = math.radians(28 + 8 * rng.normal()), 832 * math.exp(0.1 * rng.normal())
    camera = FloorCamera(832, 480, focal, pitch, 0.0, 10.0)
    now = np.array([rng.uniform(-4, 4), rng.uniform(-3, 3), rng.uniform(14, 26)])
    turn, rise, gravity = rng.normal(0, 25), rng.uniform(-45, 45), rng.uniform(0.2, 0.6)
    speed = 1.48 * math.exp(0.3 * rng.normal()) * math.sqrt(gravity)
    level = math.copysign(1, rng.normal()) * math.cos(math.radians(turn)) * camera.right
    level = level + math.sin(math.radians(turn)) * camera.ahead
    velocity = speed * (math.cos(math.radians(rise)) * level + math.sin(math.radians(rise)) * camera.up)
    times = np.arange(1 - int(rng.integers(3, 7)), 1)[:, None]
    places = now + times * velocity - times**2 * gravity / 2 * camera.up
    if abs(turn) > 60 or places[:, 2].min() < 6:
        return None
    centres, radii = camera.project(places), focal / places[:, 2]
    step = camera.project(np.stack([now, now + 1e-4 * velocity]))
    direction = (step[1] - step[0]) / np.linalg.norm(step[1] - step[0])
    # Seen towards the camera's other side than it goes, or hardly moving across: its turn has no meaning there.
    if abs(direction[0]) < 0.3 or direction[0] * (velocity @ camera.right) < 0:
        return None
    positions = [
        Position(x + 0.3 * rng.normal(), y + 0.3 * rng.normal(), r * (1 + 0.008 * rng.normal()), 1.0)
        for (x, y), r in zip(centres.tolist(), radii.tolist(), strict=True)
    ]
    return positions, math.log(speed / math.sqrt(gravity)), (float(direction[0]), float(direction[1])), turn


def test_no_circle_goes_through_edges_on_a_line() -> None:
    along, fixed = np.arange(90.0, 111.0), np.full(21, 100.0)
    for points, normal, centre in (
        (np.stack([fixed, along], axis=1), (1.0, 0.0), (70.5, 100.5)),
        (np.stack([along, fixed], axis=1), (0.0, 1.0), (100.5, 70.5)),
    ):
        edges = Edges(points, np.tile(normal, (21, 1)), (200, 200), (1.0, 1.0))
        assert edges.fit(*centre, 30.0) is None
