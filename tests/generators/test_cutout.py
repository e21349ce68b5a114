"""The compositor: bodies and shadows are where the trajectory says, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from drawn import DrawnArrow, ball, block, floor
from filmed import BLUE, CENTRE, GREEN, RADIUS, RED, World, ignore, line, shaded, shot
from hypothesis import given, settings
from hypothesis import strategies as st

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout import MAX_SIDE, CutoutGenerator
from cow_service.generators.cutout.layers import take_apart
from cow_service.media.masks import CroppedMask

generator = CutoutGenerator()


def frame_of(filmed: GeneratorInput, index: int) -> np.ndarray:
    return next(generator.render(filmed, [index], ignore))


def redness(frame) -> np.ndarray:
    return frame[..., 0].astype(int) - np.maximum(frame[..., 1], frame[..., 2]) > 60


def centre_of(mask: np.ndarray) -> tuple[float, float]:
    ys, xs = np.nonzero(mask)
    return float(xs.min() + xs.max() + 1) / 2, float(ys.min() + ys.max() + 1) / 2


@settings(max_examples=15)
@given(st.floats(0, 1), st.floats(0, 1))
def test_fractions_of_a_pixel_move_the_mover(dx: float, dy: float) -> None:
    filmed = shot(ball(floor(320, 300), CENTRE, RADIUS, RED), [CENTRE, (165.0, 205.0), (165 + dx, 205 + dy)])
    first, second = generator.render(filmed, [1, 2], ignore)

    def balance(frame) -> np.ndarray:
        weight = np.clip(frame[..., 0].astype(float) - frame[..., 1] - 40, 0, None)
        ys, xs = np.mgrid[: weight.shape[0], : weight.shape[1]]
        return np.array([(xs * weight).sum(), (ys * weight).sum()]) / weight.sum()

    assert balance(second) - balance(first) == pytest.approx([dx, dy], abs=0.12)


def test_the_mover_is_at_its_point_the_floor_is_filled_in_behind_it_and_nothing_else_changes() -> None:
    plain = block(floor(), (440, 150, 520, 250), BLUE)
    image = ball(plain, CENTRE, RADIUS, RED)
    filmed = shot(image, line(21, 8.6, -6.4))
    ys, xs = np.mgrid[:400, :640] + 0.5
    from_start = np.hypot(xs - CENTRE[0], ys - CENTRE[1])
    for index, frame in zip((0, 5, 20), generator.render(filmed, (0, 5, 20), ignore), strict=True):
        x, y = filmed.trajectory.path.points[index]
        assert centre_of(redness(frame)) == pytest.approx((x, y), abs=2)
        near = (np.hypot(xs - x, ys - y) < RADIUS + 15) | (from_start < RADIUS + 15)
        assert (frame[~near] == image[~near]).all()
    hole = from_start < RADIUS
    assert np.abs(frame[hole].astype(int) - plain[hole]).mean() < 8


@pytest.mark.parametrize(("foot", "hidden"), [(180, False), (300, True)])
def test_without_a_camera_what_stands_lower_is_drawn_in_front(foot: int, hidden: bool) -> None:
    image = block(ball(floor(), CENTRE, RADIUS, RED), (330, foot - 110, 410, foot), BLUE)
    frame = frame_of(shot(image, line(16, 14)), 15)
    middle = frame[205 if hidden else 175, 370]
    assert (middle[2] > middle[0]) == hidden


def test_drawn_cues_are_taken_out_unless_asked_to_stay() -> None:
    image = DrawnArrow((220, 200), 0.0, 120, 6, (30, 160, 30), "filled").on(ball(floor(), CENTRE, RADIUS, RED))
    for clean in (True, False):
        frame = frame_of(shot(image, line(13, 0, -10), clean=clean), 12).astype(int)
        green = frame[..., 1] - np.maximum(frame[..., 0], frame[..., 2]) > 60
        assert green.any() != clean


def test_coming_closer_it_grows_until_it_has_passed_the_camera_or_left_the_image() -> None:
    scale = [1, 1.3, 1.6, 12, 1]
    points = [*line(3, 0, 20), CENTRE, (-60.0, 200.0)]
    filmed = shot(ball(floor(), CENTRE, RADIUS, RED), points, scale=scale, depths=[1, 1 / 1.3, 1 / 1.6, 0.05, 1])
    sizes = [int(redness(frame).sum()) for frame in generator.render(filmed, range(5), ignore)]
    assert [size / sizes[0] for size in sizes] == pytest.approx([1, 1.3**2, 1.6**2, 0, 0], rel=0.08)


def test_until_something_moves_the_frame_is_the_image() -> None:
    image = ball(floor(), CENTRE, RADIUS, RED)
    filmed = shot(image, [CENTRE, (CENTRE[0] + 0.1, CENTRE[1]), (CENTRE[0] + 3, CENTRE[1])])
    first, second, third = generator.render(filmed, range(3), ignore)
    assert (first == image).all()
    assert (second == image).all()
    assert (third != image).any()


def test_large_images_give_a_smaller_clip() -> None:
    filmed = shot(ball(floor(2000, 1000), CENTRE, RADIUS, RED), line(17, 19))
    sizes = {(2000, 1000): (MAX_SIDE, 640), (1, 4000): (1, MAX_SIDE), (1280, 7): (1280, 7), (640, 1281): (640, 1280)}
    assert {size: generator.size(*size) for size in sizes} == sizes
    frame = frame_of(filmed, 16)
    assert frame.shape == (640, 1280, 3)
    x, y = filmed.trajectory.path.points[16]
    assert centre_of(redness(frame)) == pytest.approx((x * 0.64, y * 0.64), abs=2)


def test_a_shadow_without_a_camera_goes_with_the_mover_and_keeps_the_texture() -> None:
    plain = floor()
    image = shaded(plain, [((200, 244), (50, 12), 0.5)])
    filmed = shot(block(image, (160, 160, 240, 240), RED), [(200 + 12.5 * i, 200.0) for i in range(17)],
                  bbox=(160, 160, 240, 240))  # fmt: skip
    frame = frame_of(filmed, 16).astype(int)
    left, there = (slice(249, 255), slice(170, 230)), (slice(246, 252), slice(370, 430))
    assert np.abs(frame[left] - plain[left]).mean() < 5
    assert np.corrcoef(frame[left].ravel(), plain[left].ravel())[0, 1] > 0.25
    ratio = frame[there] / plain[there]
    assert 0.4 < ratio.mean() < 0.72


# With a camera: metres, as stage 3 gives them.


def colour_at(frame, x: float, y: float) -> str:
    return "rgb"[int(frame[round(y), round(x)].argmax())]


@pytest.mark.parametrize(("ahead", "seen"), [(2.5, "r"), (3.2, "b")])
def test_the_nearer_of_a_moving_and_a_still_body_is_in_front(ahead: float, seen: str) -> None:
    world = World(floor())
    world.block((-0.6, 0.15, ahead), RED, path=[(-0.6, 0.15, ahead), (0.5, 0.15, ahead)])
    x, y, r = world.block((0.5, 0.15, 2.8), BLUE)
    frame = frame_of(world.filmed(), 1)
    where = y + (0.6 if ahead < 2.8 else -0.6) * r
    assert colour_at(frame, x, where) == seen


def test_everything_that_moves_is_moved_and_the_nearer_covers_the_farther() -> None:
    world = World(floor())
    near, far = (0.0, 0.15, 2.4), (0.0, 0.15, 2.9)
    world.ball((-0.8, 0.15, 2.4), RED, path=[(-0.8, 0.15, 2.4), near])
    x0, y0, r0 = world.ball((0.8, 0.15, 2.9), GREEN, path=[(0.8, 0.15, 2.9), far])
    frame = frame_of(world.filmed(), 1)
    assert colour_at(frame, *world.pixel(near)) == "r"
    x, y = world.pixel(far)
    assert colour_at(frame, x, y - 0.7 * r0) == "g"
    gone = frame[round(y0 - r0 / 2) : round(y0 + r0 / 2), round(x0 - r0 / 2) : round(x0 + r0 / 2)].astype(int)
    assert np.abs(gone[..., 1] - gone[..., 0]).max() < 25


def test_a_body_on_top_of_another_is_in_front_of_it() -> None:
    world = World(floor())
    world.ball((0.0, 1.0, 2.75), RED, support="air", path=[(0.0, 1.0, 2.75), (0.0, 0.45, 2.75)])
    world.block((0.0, 0.15, 2.6), BLUE)  # nearer to the camera, and yet beneath
    frame = frame_of(world.filmed(), 1)
    x, y = world.pixel((0.0, 0.45, 2.75))
    assert colour_at(frame, x, y + 0.7 * world.radius((0.0, 0.45, 2.75), 0.15)) == "r"


def test_a_tipping_body_turns_about_its_centre() -> None:
    world = World(floor())
    x, y, _ = world.block((0.0, 0.15, 2.6), RED, path=[(0.0, 0.15, 2.6)] * 2, rotation=(0.0, 90.0))
    first, turned = generator.render(world.filmed(), [0, 1], ignore)
    bright = first[..., 0].astype(int) - first[..., 1] > 180  # the lit top
    assert centre_of(bright)[1] < y - 10
    lit = turned[..., 0].astype(int) - turned[..., 1] > 180
    assert centre_of(lit)[0] > x + 10
    assert centre_of(redness(turned)) == pytest.approx((x, y), abs=2)


@pytest.mark.parametrize("printed", [False, True])
def test_a_rolling_ball_turns_what_is_printed_on_it_and_not_its_shading(printed: bool) -> None:
    world = World(floor())
    x, y, r = world.ball((0.0, 0.15, 2.4), RED, path=[(0.0, 0.15, 2.4)] * 2, rotation=(0.0, 180.0))
    if printed:
        for i in range(4):
            cv2.circle(world.image, (round(x + (i - 2) * 9), round(y - r / 2)), 4, (250, 250, 250), -1)
    first, turned = (frame.astype(int) for frame in generator.render(world.filmed(), [0, 1], ignore))
    above, below = slice(round(y - 0.7 * r), round(y - 0.3 * r)), slice(round(y + 0.3 * r), round(y + 0.7 * r))
    inner = slice(round(x - r / 2), round(x + r / 2))
    white = [(frame[rows, inner, 1] > 110).sum() for frame in (first, turned) for rows in (above, below)]
    if printed:
        assert white[0] > 5 * max(1, white[1])
        assert white[3] > 5 * max(1, white[2])
    else:
        assert np.abs(first - turned)[above.start : below.stop, inner].max() <= 1


def test_a_contact_shadow_stays_behind_nowhere_and_fades_as_the_body_rises() -> None:
    plain = floor()
    world = World(plain)
    start, there, high = (-0.7, 0.15, 2.6), (0.5, 0.15, 2.6), (0.5, 0.6, 2.6)
    (x, y), r = world.pixel(start), world.radius(start, 0.15)
    world.image = shaded(plain, [((x, y + 1.1 * r), (1.2 * r, 0.3 * r), 0.5)])
    world.block(start, RED, path=[start, there, high])
    first, moved, risen = (f.astype(int) for f in generator.render(world.filmed(), range(3), ignore))
    under = slice(round(y + 1.12 * r), round(y + 1.3 * r))
    old, new = ((under, slice(round(px - r), round(px + r))) for px in (x, world.pixel(there)[0]))
    assert np.abs(first[old] - world.image[old]).mean() < 6
    assert np.abs(moved[old] - plain[old]).mean() < 6
    assert (moved[new] / plain[new]).mean() < 0.75
    assert np.abs(risen[new] - plain[new]).mean() < 6


def flying(still: bool = False) -> tuple[World, GeneratorInput, tuple[float, float]]:
    """A ball that comes down to the right, with its shadow, and where that is at the first frame."""
    world, light = World(floor()), (-0.4, 0.2)
    start = (-0.2, 0.75, 2.7)
    cast = world.pixel((start[0] + 0.75 * light[0], 0, start[2] + 0.75 * light[1]))
    r = world.radius((start[0] + 0.75 * light[0], 0, start[2] + 0.75 * light[1]), 0.15)
    world.image = shaded(world.image, [(cast, (r, 0.55 * r), 0.3)])
    world.ball(start, RED, support="air", path=[start, (0.3, 0.4, 2.7), (0.7, 0.15, 2.7)])
    if still:
        world.block((0.14, 0.15, 2.5), BLUE)
    return world, world.filmed(light=light), cast


def test_a_cast_shadow_leaves_its_place_and_meets_the_ball_as_it_lands() -> None:
    plain = floor()
    world, filmed, (x, y) = flying()
    first, middle, landed = (f.astype(int) for f in generator.render(filmed, range(3), ignore))
    spot = slice(round(y - 4), round(y + 5)), slice(round(x - 10), round(x + 11))
    assert (first[spot] / plain[spot]).mean() == pytest.approx(0.7, abs=0.06)
    for frame in (middle, landed):
        assert (frame[spot] / plain[spot]).mean() == pytest.approx(1, abs=0.04)
    x, y = world.pixel((0.3 - 0.4 * 0.4, 0, 2.7 + 0.2 * 0.4))
    assert (middle[round(y), round(x)] / plain[round(y), round(x)]).mean() == pytest.approx(0.7, abs=0.12)
    x, y = world.pixel((0.7, 0.15, 2.7))
    r = world.radius((0.7, 0.15, 2.7), 0.15)
    beneath = slice(round(y + 1.04 * r), round(y + 1.15 * r)), slice(round(x - 5), round(x + 6))
    assert (landed[beneath] / plain[beneath]).mean() < 0.6


def test_shadows_do_not_fall_onto_what_stands_there() -> None:
    world, filmed, _ = flying(still=True)
    frame = frame_of(filmed, 1)
    x0, y0, x1, y1 = (round(v) for v in world.bodies[1]["bbox"])
    inner = slice(y0 + 15, y1 - 3), slice(x0 + 3, x1 - 3)
    seen = redness(frame[inner])
    assert (frame[inner][~seen] == world.image[inner][~seen]).all(axis=-1).mean() > 0.95


def test_a_ball_partly_hidden_at_the_start_is_whole_later() -> None:
    world = World(floor())
    start = (-0.4, 0.15, 3.0)
    x, y, r = world.ball(start, RED, path=[start, (0.6, 0.15, 3.0)])
    world.block((-0.28, 0.15, 2.6), BLUE)
    filmed = world.filmed()
    ys, xs = np.mgrid[:400, :640] + 0.5
    x0, y0, x1, y1 = world.bodies[1]["bbox"]
    whole = np.hypot(xs - x, ys - y) < r
    seen = whole & ~((xs > x0) & (xs < x1) & (ys > y0) & (ys < y1))
    frame = frame_of(replace(filmed, scene=replace(filmed.scene, mover=CroppedMask.of(seen))), 1)
    assert redness(frame).sum() > 0.93 * whole.sum()


class Painter:
    """Paints the plain floor, darker than it is, and says what it was asked for."""

    fingerprint = "painter"

    def __init__(self, plain: np.ndarray, off: int = 0) -> None:
        self.plain, self.off, self.holes = plain, off, []

    def fill(self, image, hole, progress) -> np.ndarray:
        self.holes.append(hole)
        progress(0.5)
        painted = np.clip(self.plain.astype(int) + self.off, 0, 255).astype(np.uint8)
        return np.where(hole[..., None], painted, image)


def test_an_inpainter_paints_all_holes_in_one_call_in_the_shading_around_them() -> None:
    plain = floor()
    world = World(plain)
    first = world.ball((-0.8, 0.15, 2.6), RED, path=[(-0.8, 0.15, 2.6), (-0.3, 0.15, 2.4)])
    second = world.ball((0.8, 0.15, 2.6), GREEN, path=[(0.8, 0.15, 2.6), (0.4, 0.15, 2.3)])
    painter = Painter(plain, off=-12)
    filmed = replace(world.filmed(), inpainter=painter)
    background = take_apart(filmed).background
    (hole,) = painter.holes
    ys, xs = np.mgrid[:400, :640] + 0.5
    for x, y, r in (first, second):
        assert hole[np.hypot(xs - x, ys - y) < r + 1].all()
    assert (background[~hole] == world.image[~hole]).all()
    assert np.abs(background[hole].astype(int) - plain[hole]).mean() < 4  # of 12
    canceled = []
    frame = next(generator.render(filmed, [1], canceled.append))
    assert canceled[0] == canceled[1] == 0.0
    assert (frame != background).any()


def test_a_shadow_that_could_not_be_measured_is_painted_over() -> None:
    rng = np.random.default_rng(0)
    tiles = rng.integers(90, 200, (50, 80, 1)).astype(np.uint8).repeat(8, axis=0).repeat(8, axis=1).repeat(3, axis=2)
    image = shaded(tiles, [((200, 246), (46, 9), 0.6)])
    filmed = shot(block(image, (160, 160, 240, 240), RED), [(200 + 12.5 * i, 200.0) for i in range(17)],
                  bbox=(160, 160, 240, 240))  # fmt: skip
    painter = Painter(tiles)
    take_apart(replace(filmed, inpainter=painter))
    assert painter.holes[0][244:250, 180:220].mean() > 0.7
