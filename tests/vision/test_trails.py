"""Trails: several positions of one ball, found, taken out of the image, and measured."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import DATA, EXAMPLES
from drawn import ball, block, floor, jpeg, thrown_past, trail
from hypothesis import given, settings
from hypothesis import strategies as st
from runs import run_of

from cow_service.errors import CannotGround, CannotReadDirection
from cow_service.physics.camera import FloorCamera, prior
from cow_service.physics.trail_fit import fit_throw, is_thrown, straight_direction
from cow_service.readers.embedded.reader import EmbeddedReader
from cow_service.stages.grounding import ground
from cow_service.stages.motion import read_motion
from cow_service.vision.circles import Edges
from cow_service.vision.regions import measure
from cow_service.vision.scene import Scene
from cow_service.vision.trail_removal import without_earlier_shadows
from cow_service.vision.trails import Position, Trail, find_trails, trail_of

RENDERED = DATA / "rendered_trail.jpg"  # four positions of one ball
ORANGE, GREEN, PURPLE = (220, 120, 30), (40, 160, 60), (120, 50, 160)
PLACES = thrown_past((300, 110), (36, -2), 12, 4)  # the oldest first
QUESTION = "If the orange ball flies on along the trail of positions that is shown{}, will it hit the green cube?"


def scene_with(opacities: list[float], places: list[tuple[float, float]] = PLACES) -> np.ndarray:
    image = block(floor(), (460, 230, 530, 300), GREEN)
    return jpeg(trail(image, places, [26.0] * len(places), ORANGE, opacities), 95)


def trails_of(image: np.ndarray) -> tuple[Trail, ...]:
    return find_trails(image, measure(image))


OPAQUE, FADED = scene_with([1.0] * 4), scene_with([0.3, 0.5, 0.7, 1.0])


@pytest.mark.parametrize("image", [OPAQUE, FADED], ids=["opaque", "faded"])
def test_every_position_of_a_drawn_trail_is_found(image: np.ndarray) -> None:
    (found,) = trails_of(image)
    seen = sorted(position.centre for position in found.positions)
    assert found.evident
    assert np.abs(np.array(seen) - np.array(sorted(PLACES))).max() < 1.5
    assert all(abs(position.radius - 26) < 1 for position in found.positions)


def test_the_opaque_end_of_a_faded_trail_is_the_present_position() -> None:
    (found,) = trails_of(FADED)
    assert found.end_known
    assert math.dist(found.present.centre, PLACES[-1]) < 1.5
    assert [round(position.opacity, 1) for position in found.positions] == pytest.approx([0.3, 0.5, 0.7, 1.0], abs=0.11)


def test_a_multiple_exposure_leaves_the_end_to_the_words() -> None:
    (found,) = trails_of(OPAQUE)
    assert not found.end_known
    for ended in (found.ending(near=(460, 230, 530, 300)), found.ending(side=(1.0, 0.0))):
        assert math.dist(ended.present.centre, PLACES[-1]) < 1.5
    assert math.dist(found.ending(side=(-1.0, 0.0)).present.centre, PLACES[0]) < 1.5


def test_what_is_no_trail() -> None:
    capsule = floor()
    cv2.line(capsule, (120, 300), (200, 120), GREEN, 44, cv2.LINE_AA)
    assert trails_of(capsule) == ()
    three = floor()
    for x, rgb in ((150, ORANGE), (210, GREEN), (270, PURPLE)):
        three = ball(three, (x, 200), 24, rgb)
    assert trails_of(three) == ()


def test_three_balls_that_stand_apart_are_a_trail_only_where_the_question_says_so() -> None:
    places = thrown_past((420, 120), (110, 6), 8, 3)
    image = trail(floor(), places, [24.0] * 3, ORANGE, [1.0] * 3)
    assert Scene(image).trails == ()
    assert len(Scene(image).regions) == 3
    named = Scene(image, trail_named=True)
    assert len(named.trails) == 1
    assert len(named.regions) == 1


@pytest.mark.parametrize("image", sorted(EXAMPLES.glob("*/image.jpg")), ids=lambda path: path.parent.name)
def test_the_examples_show_no_trail(image: Path) -> None:
    assert trails_of(np.ascontiguousarray(cv2.imread(str(image))[..., ::-1])) == ()


@pytest.mark.parametrize(("image", "present"), [(FADED, 3), (OPAQUE, 3), (OPAQUE, 0)], ids=["faded", "last", "first"])
def test_the_earlier_positions_are_taken_out_and_the_present_one_is_whole(image: np.ndarray, present: int) -> None:
    x, y = PLACES[present]
    scene = Scene(image).with_mover((x - 26, y - 26, x + 26, y + 26))
    wanted = ball(block(floor(), (460, 230, 530, 300), GREEN), (x, y), 26, ORANGE)
    off = np.abs(scene.clean.astype(int) - wanted).max(axis=2)
    ys, xs = np.mgrid[: image.shape[0], : image.shape[1]]
    on_rim = np.abs(np.hypot(xs + 0.5 - x, ys + 0.5 - y) - 26) < 2.5
    assert np.percentile(off[~on_rim], 99.5) < 40
    assert [region.is_disc for region in scene.regions if region.colour == "orange"] == [True]
    assert len(scene.obstacles((x - 26, y - 26, x + 26, y + 26))) == 1  # the cube, and no earlier position


def test_the_shadows_of_earlier_positions_are_taken_out() -> None:
    image, rows = floor().astype(float), []
    ys, xs = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    for x, _ in PLACES:
        away = np.hypot((xs - x - 20) / 26, (ys - 300) / 11)
        rows.append(np.clip((1.06 - away) / 0.12, 0, 1))
    shaded = (image * (1 - 0.16 * np.max(rows, axis=0))[..., None]).astype(np.uint8)
    shown = Trail(tuple(Position(x, y, 26.0, 1.0) for x, y in PLACES), evident=True, end_known=True)
    clean = without_earlier_shadows(shaded, shown, np.zeros(shaded.shape[:2], bool))
    own, others = rows[-1] > 0.9, (np.max(rows[:-1], axis=0) > 0.5) & (rows[-1] == 0)
    left = np.abs(clean[others].astype(float) - image[others]).mean()
    assert left < 0.4 * np.abs(shaded[others].astype(float) - image[others]).mean()
    assert np.array_equal(clean[own], shaded[own])


def test_the_question_tells_the_end_and_the_trail_the_motion() -> None:
    run = run_of(OPAQUE, reader=EmbeddedReader, question=QUESTION.format(", the last of which is the rightmost"))
    grounding = run.stage("grounding", ground)
    motion = run.stage("motion", read_motion, grounding, run.hints)
    assert math.dist(grounding.point, PLACES[-1]) < 2
    assert (motion.kind, motion.cue) == ("projectile", "trail")
    assert np.abs(np.array(motion.trail) - np.array(PLACES[:-1])).max() < 1.5
    angle = math.degrees(math.atan2(motion.direction[1], motion.direction[0]))
    assert abs(angle - math.degrees(math.atan2(-2, 36))) < 5
    froude = motion.speed**2 * motion.metres_per_pixel.value / (9.81 * 26)
    as_drawn = (
        (36**2 + 2**2) / 26 / (12 / math.cos(math.radians(28)))
    )  # of a camera that looks down by the prior's pitch
    assert math.sqrt(froude) == pytest.approx(math.sqrt(as_drawn), rel=0.12)
    assert motion.speed_deviation < 0.15
    assert not any("was assumed" in warning for result in run.results.values() for warning in result.warnings)


def test_an_end_that_nothing_tells_is_that_nearest_to_what_is_asked_about() -> None:
    run = run_of(OPAQUE, reader=EmbeddedReader, question=QUESTION.format(""))
    grounding = run.stage("grounding", ground)
    assert grounding.point == pytest.approx(PLACES[-1], abs=1.5)
    assert any(
        "4 places one after another" in each and "nearest to the green cube" in each
        for each in run.results["grounding"].warnings
    )


def test_an_end_told_by_what_is_as_far_from_both_is_refused() -> None:
    image = jpeg(trail(block(floor(), (310, 290, 370, 350), GREEN), PLACES, [26.0] * 4, ORANGE, [1.0] * 4), 95)
    nearest = ", the last of which is the one nearest to the green cube"
    run = run_of(image, reader=EmbeddedReader, question=QUESTION.format(nearest))
    with pytest.raises(CannotGround, match="as far from either end"):
        run.stage("grounding", ground)


def test_a_trail_that_is_not_there_is_refused() -> None:
    image = ball(block(floor(), (460, 230, 530, 300), GREEN), (300, 110), 26, ORANGE)
    run = run_of(image, reader=EmbeddedReader, question=QUESTION.format(""))
    grounding = run.stage("grounding", ground)
    with pytest.raises(CannotReadDirection, match="no three positions"):
        run.stage("motion", read_motion, grounding, run.hints)


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


def test_a_rendered_trail() -> None:
    image = np.ascontiguousarray(cv2.imread(str(RENDERED))[..., ::-1])
    found = trail_of(Scene(image).trails, (182.8, 16.9, 261.6, 95.7))
    assert found is not None
    assert len(found.positions) == 4


@pytest.mark.parametrize("upright", [True, False])
def test_no_circle_goes_through_edges_on_a_line(upright: bool) -> None:
    along, fixed = np.arange(90.0, 111.0), np.full(21, 100.0)
    points = np.stack([fixed, along] if upright else [along, fixed], axis=1)
    normals = np.tile([1.0, 0.0] if upright else [0.0, 1.0], (21, 1))
    edges = Edges(points[np.argsort(points[:, 1], kind="stable")], normals, (200, 200), (1.0, 1.0))
    centre = (70.5, 100.5) if upright else (100.5, 70.5)
    assert edges.fit(*centre, 30.0) is None
