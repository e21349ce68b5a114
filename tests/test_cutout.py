"""The compositor: the mover is where its trajectory says, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn import DrawnArrow, ball, block, floor
from hypothesis import given, settings
from hypothesis import strategies as st
from runs import run_of

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import MAX_SIDE, CutoutGenerator, CutoutOptions
from cow_service.stages.grounding import ground
from cow_service.stages.motion import read_motion
from cow_service.stages.trajectory import compute_trajectory
from cow_service.vision.inpainting import exemplar_inpaint

RED, BLUE = (210, 20, 20), (50, 80, 200)
CENTRE, RADIUS = (160.0, 200.0), 40.0
generator = CutoutGenerator()


def ignore(done: float) -> None:
    """Nobody listens."""


def shot(image, frames: int = 33, fps: float = 16, clean: bool = True, **motion) -> GeneratorInput:
    run = run_of(image, grounding={"point": CENTRE}, motion=motion, num_frames=frames, fps=fps)
    grounding = ground(run).value
    moving = read_motion(run, grounding, None).value
    trajectory = compute_trajectory(run, grounding, moving).value
    obstacles = run.scene.obstacles(grounding.bbox)
    options = CutoutOptions(clean_cues=clean)
    return GeneratorInput(run.scene, grounding, moving, trajectory, obstacles, 0, options)


def frame_of(filmed: GeneratorInput, index: int) -> np.ndarray:
    return next(generator.render(filmed, [index], ignore))


def redness(frame) -> np.ndarray:
    return frame[..., 0].astype(int) - np.maximum(frame[..., 1], frame[..., 2]) > 60


def centre_of(mask: np.ndarray) -> tuple[float, float]:
    ys, xs = np.nonzero(mask)
    return float(xs.min() + xs.max() + 1) / 2, float(ys.min() + ys.max() + 1) / 2


def test_the_mover_is_within_two_pixels_of_its_point() -> None:
    filmed = shot(ball(floor(), CENTRE, RADIUS, RED), direction=(1, -0.3), speed=137)
    for index, frame in enumerate(generator.render(filmed, range(33), ignore)):
        x, y = filmed.trajectory.points[index]
        if x < 590:
            assert centre_of(redness(frame)) == pytest.approx((x, y), abs=2)


@settings(max_examples=15)
@given(st.floats(0, 1), st.floats(0, 1))
def test_fractions_of_a_pixel_move_the_mover(dx: float, dy: float) -> None:
    filmed = shot(ball(floor(320, 300), CENTRE, RADIUS, RED), frames=2, fps=1, direction=(1, 0), speed=0)
    start = filmed.trajectory.points[0]
    moved = filmed.trajectory.model_copy(update={"points": (start, (start[0] + dx, start[1] + dy))})
    first, second = generator.render(replace(filmed, trajectory=moved), [0, 1], ignore)

    def balance(frame) -> np.ndarray:
        weight = np.clip(frame[..., 0].astype(float) - frame[..., 1] - 40, 0, None)
        ys, xs = np.mgrid[: weight.shape[0], : weight.shape[1]]
        return np.array([(xs * weight).sum(), (ys * weight).sum()]) / weight.sum()

    assert balance(second) - balance(first) == pytest.approx([dx, dy], abs=0.12)


def test_away_from_mover_and_hole_pixels_equal_the_input() -> None:
    image = block(ball(floor(), CENTRE, RADIUS, RED), (440, 150, 520, 250), BLUE)
    filmed = shot(image, direction=(0, -1), speed=100)
    ys, xs = np.mgrid[:400, :640] + 0.5
    for index, frame in zip((0, 5, 20), generator.render(filmed, (0, 5, 20), ignore), strict=True):
        x, y = filmed.trajectory.points[index]
        near = (np.hypot(xs - x, ys - y) < RADIUS + 15) | (np.hypot(xs - CENTRE[0], ys - CENTRE[1]) < RADIUS + 15)
        assert (frame[~near] == image[~near]).all()


def test_behind_the_mover_the_floor_is_filled_in() -> None:
    plain = floor()
    filmed = shot(ball(plain, CENTRE, RADIUS, RED), direction=(1, 0), speed=400)
    frame = frame_of(filmed, 30)
    ys, xs = np.mgrid[:400, :640] + 0.5
    hole = np.hypot(xs - CENTRE[0], ys - CENTRE[1]) < RADIUS
    assert np.abs(frame[hole].astype(int) - plain[hole]).mean() < 8
    assert not redness(frame).any()


@pytest.mark.parametrize(("foot", "hidden"), [(180, False), (300, True)])
def test_what_stands_lower_is_drawn_in_front(foot: int, hidden: bool) -> None:
    image = block(ball(floor(), CENTRE, RADIUS, RED), (330, foot - 110, 410, foot), BLUE)
    filmed = shot(image, frames=16, direction=(1, 0), speed=230)
    index = min(range(16), key=lambda i: abs(filmed.trajectory.points[i][0] - 370))
    frame = frame_of(filmed, index)
    middle = frame[205 if hidden else 175, 370]
    assert (middle[2] > middle[0]) == hidden


def test_drawn_cues_are_taken_out_unless_asked_to_stay() -> None:
    image = DrawnArrow((220, 200), 0.0, 120, 6, (30, 160, 30), "filled").on(ball(floor(), CENTRE, RADIUS, RED))
    for clean in (True, False):
        frame = frame_of(shot(image, clean=clean, direction=(0, -1)), 12).astype(int)
        green = frame[..., 1] - np.maximum(frame[..., 0], frame[..., 2]) > 60
        assert green.any() != clean


def test_coming_closer_it_grows() -> None:
    filmed = shot(ball(floor(), CENTRE, RADIUS, RED), frames=17, direction=(0, 1), depth=-0.9, speed=60)
    sizes = [redness(frame).sum() for frame in generator.render(filmed, (0, 8, 16), ignore)]
    assert sizes[0] < sizes[1] < sizes[2]
    assert sizes[2] / sizes[0] == pytest.approx(filmed.trajectory.scale[16] ** 2, rel=0.15)


def test_past_the_camera_it_is_gone() -> None:
    image = ball(floor(320, 240), CENTRE, 20, RED)
    filmed = shot(image, frames=81, direction=(0, 1), depth=-1, speed=400)
    assert filmed.trajectory.visible[-1] is False
    assert not redness(frame_of(filmed, 80)).any()


def test_edges_are_soft() -> None:
    filmed = shot(ball(floor(), CENTRE, RADIUS, RED), frames=3, direction=(0, -1), speed=0)
    frame = frame_of(filmed, 1).astype(int)
    row = frame[200, 110:130, 0] - frame[200, 110:130, 1]
    assert ((row > 3) & (row < 0.9 * row.max())).sum() >= 2


def test_a_varied_background_is_continued_not_smeared() -> None:
    rng = np.random.default_rng(0)
    tiles = rng.integers(40, 220, (50, 80, 1)).astype(np.uint8).repeat(8, axis=0).repeat(8, axis=1).repeat(3, axis=2)
    filmed = shot(ball(tiles, CENTRE, RADIUS, RED), frames=33, direction=(1, 0), speed=500)
    frame = frame_of(filmed, 32).astype(int)
    hole = frame[175:225, 135:185, 1]
    assert hole.std() > 25
    assert not redness(frame[160:240, 120:200]).any()


def test_out_of_the_image_only_the_background_is_left() -> None:
    filmed = shot(ball(floor(), CENTRE, RADIUS, RED), direction=(-1, 0), speed=600)
    frame = frame_of(filmed, 32)
    assert not redness(frame).any()


def test_large_images_give_a_smaller_clip() -> None:
    filmed = shot(ball(floor(2000, 1000), CENTRE, RADIUS, RED), direction=(1, 0), speed=300)
    assert generator.size(2000, 1000) == (MAX_SIDE, 640)
    frame = frame_of(filmed, 16)
    assert frame.shape == (640, 1280, 3)
    x, y = filmed.trajectory.points[16]
    assert centre_of(redness(frame)) == pytest.approx((x * 0.64, y * 0.64), abs=2)


@given(st.integers(1, 4000), st.integers(1, 4000))
def test_any_size_stays_within_bounds(width: int, height: int) -> None:
    w, h = generator.size(width, height)
    assert 1 <= w <= min(width, MAX_SIDE)
    assert 1 <= h <= min(height, MAX_SIDE)


def test_quilting_copies_what_is_around() -> None:
    rng = np.random.default_rng(1)
    stripes = np.repeat(np.where(np.arange(96) // 6 % 2, 200, 60)[None], 96, axis=0)
    source = np.repeat(stripes[..., None], 3, axis=2).astype(np.float32) + rng.normal(0, 2, (96, 96, 1)).astype(
        np.float32
    )
    hole = np.zeros((96, 96), bool)
    hole[36:60, 36:60] = True
    damaged = np.where(hole[..., None], 0, source).astype(np.float32)
    shading = np.full_like(source, 130)
    filled = exemplar_inpaint(damaged, hole, np.zeros_like(hole), shading)
    assert np.abs(filled - source)[hole].mean() < 30
    assert np.allclose(exemplar_inpaint(damaged, np.ones_like(hole), hole, shading), shading)
