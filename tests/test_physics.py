"""Dynamics, camera, anchors and encounters, against closed forms and drawn truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cow_service.physics.anchors import points_inside, spread_anchors
from cow_service.physics.camera import Camera, depth_motion
from cow_service.physics.dynamics import GRAVITY, roll_out
from cow_service.physics.encounters import Sweep, box_at, find_encounters, stands_nearer, swept_mask
from cow_service.vision.masks import CroppedMask
from cow_service.vision.obstacles import Obstacle

number = st.floats(-50, 50)
vector = st.tuples(number, number, number).map(np.array)


@given(vector, vector, vector, st.floats(0.1, 5))
def test_velocity_is_the_derivative_and_gravity_its_own(position, velocity, acceleration, t) -> None:
    h = 1e-4
    states = roll_out(position, velocity, acceleration, np.array([0.0, t - h, t, t + h]))
    assert np.allclose(states[0], [*position, *velocity])
    assert np.allclose((states[3, :3] - states[1, :3]) / (2 * h), states[2, 3:], atol=1e-4)
    assert np.allclose((states[3, 3:] - states[1, 3:]) / (2 * h), acceleration, atol=1e-4)


def test_a_second_of_free_fall() -> None:
    states = roll_out(np.zeros(3), np.zeros(3), np.array([0, GRAVITY, 0]), np.array([1.0]))
    assert states[0].tolist() == pytest.approx([0, 4.905, 0, 0, 9.81, 0])


@given(st.floats(-2000, 4000), st.floats(-2000, 4000), st.integers(8, 5000), st.integers(8, 5000), st.floats(1e-5, 1))
def test_lifting_and_projecting_are_inverse(x, y, width, height, scale) -> None:
    camera = Camera(width, height, scale)
    points, sizes = camera.project(camera.lift((x, y))[None])
    assert np.allclose(points[0], [x, y], atol=1e-6 * max(1, abs(x), abs(y)))
    assert sizes[0] == pytest.approx(1)


def test_what_comes_closer_grows_and_what_leaves_shrinks() -> None:
    camera = Camera(800, 600, 3 / 800)
    for sense, growing in ((-1.0, True), (1.0, False)):
        direction, depth = depth_motion(sense)
        velocity = np.array([0.0, direction[1] * np.sqrt(1 - depth**2), depth])
        states = roll_out(camera.lift((400, 300)), velocity, np.zeros(3), np.linspace(0, 1, 10))
        points, sizes = camera.project(states[:, :3])
        assert (np.diff(sizes) > 0).all() == growing
        assert (np.diff(points[:, 1]) > 0).all() == growing


def test_behind_the_camera_there_is_no_image() -> None:
    camera = Camera(800, 600, 0.004)
    positions = np.array([[0, 0, camera.depth], [0, 0, -1.0]])
    points, sizes = camera.project(positions)
    assert camera.has_passed(positions).tolist() == [False, True]
    assert np.isfinite(points).all()
    assert np.isfinite(sizes).all()


@given(
    st.integers(20, 400),
    st.integers(20, 400),
    st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0.02, 1), st.floats(0.02, 1)),
)
def test_anchors_keep_off_what_moves(width, height, block) -> None:
    movable = np.zeros((height, width), bool)
    y, x = int(block[0] * (height - 1)), int(block[1] * (width - 1))
    movable[y : y + max(1, int(block[2] * height)), x : x + max(1, int(block[3] * width))] = True
    anchors = spread_anchors(movable)
    assert len(anchors) <= 8
    assert len(set(anchors)) == len(anchors)
    for ax, ay in anchors:
        assert 0 <= ax < width
        assert 0 <= ay < height
        assert not movable[int(ay), int(ax)]


def test_anchors_spread_over_an_empty_image() -> None:
    anchors = np.array(spread_anchors(np.zeros((480, 832), bool)))
    assert len(anchors) == 8
    assert anchors[:, 0].min() < 120
    assert anchors[:, 0].max() > 700
    assert anchors[:, 1].max() > 400
    gaps = np.linalg.norm(anchors[:, None] - anchors[None], axis=2)[~np.eye(8, dtype=bool)]
    assert gaps.min() > 150


def test_tracks_lie_inside_the_mask() -> None:
    ys, xs = np.mgrid[:200, :300]
    ring = (np.hypot(xs - 150, ys - 100) < 60) & (np.hypot(xs - 150, ys - 100) > 25)
    points = points_inside(ring, (150, 100))
    assert len(points) == 5
    assert all(ring[int(y), int(x)] for x, y in points)
    assert points_inside(np.zeros((10, 10), bool), (4.0, 5.0)) == ((4.0, 5.0),)


def disc(centre, radius, shape=(400, 800)):
    ys, xs = np.mgrid[: shape[0], : shape[1]] + 0.5
    return np.hypot(xs - centre[0], ys - centre[1]) <= radius


def box(centre, radius):
    return (centre[0] - radius, centre[1] - radius, centre[0] + radius, centre[1] + radius)


def sweep(start, end, radius=30, frames=41, airborne=False, scale=None, visible=None) -> Sweep:
    points = np.linspace(start, end, frames)
    return Sweep(
        mask=disc(start, radius),
        bbox=box(start, radius),
        start=np.array(start, float),
        points=points,
        scale=np.ones(frames) if scale is None else scale,
        visible=np.ones(frames, bool) if visible is None else visible,
        airborne=airborne,
    )


def obstacle(centre, radius=30, name="vase") -> Obstacle:
    return Obstacle(name, box(centre, radius), CroppedMask.of(disc(centre, radius)))


def kinds(moving: Sweep, *others: Obstacle):
    return [(e.object, e.kind) for e in find_encounters(moving, others)]


def test_at_the_same_depth_they_touch() -> None:
    found = find_encounters(sweep((100, 200), (700, 200)), [obstacle((400, 200))])
    assert [(e.object, e.kind) for e in found] == [("vase", "touches")]
    # The rims meet when the centres are 60 px apart: frame 16 of 15 px each; the overlap must then be visible.
    assert 16 <= found[0].first_frame <= 18


def test_in_front_it_occludes_and_behind_it_is_occluded() -> None:
    assert kinds(sweep((100, 200), (700, 200)), obstacle((400, 150), 40)) == [("vase", "occludes")]
    assert kinds(sweep((100, 200), (700, 200)), obstacle((400, 265), 50)) == [("vase", "occluded-by")]


def test_past_it_there_is_nothing() -> None:
    assert kinds(sweep((100, 200), (700, 200)), obstacle((400, 320))) == []
    assert kinds(sweep((100, 200), (300, 200)), obstacle((400, 200))) == []


def test_a_graze_is_no_encounter() -> None:
    assert kinds(sweep((100, 200), (700, 200)), obstacle((400, 257))) == []


def test_outside_the_image_nothing_is_met() -> None:
    visible = np.arange(41) < 10
    assert kinds(sweep((100, 200), (700, 200), visible=visible), obstacle((400, 200))) == []


def test_several_are_listed_in_order_of_time() -> None:
    others = obstacle((600, 200), name="far"), obstacle((300, 200), name="near")
    assert kinds(sweep((100, 200), (700, 200)), *others) == [("near", "touches"), ("far", "touches")]


def test_a_falling_thing_lands_on_what_is_below_it() -> None:
    assert kinds(sweep((400, 60), (400, 390), airborne=True), obstacle((410, 250))) == [("vase", "touches")]
    assert kinds(sweep((400, 60), (400, 390), airborne=True), obstacle((520, 250))) == []


def test_growing_it_reaches_further() -> None:
    still = np.full((41, 2), 1.0)
    growing = sweep((300, 200), (300, 200), scale=np.linspace(1, 4, 41) * still[:, 0])
    assert kinds(sweep((300, 200), (300, 200)), obstacle((400, 200))) == []
    assert kinds(growing, obstacle((400, 200)))


def test_the_swept_mask_covers_the_whole_way() -> None:
    swept = swept_mask(sweep((100, 200), (700, 200)))
    assert swept[200, 80:720].all()
    assert not swept[120].any()


def test_nearer_stands_lower() -> None:
    assert stands_nearer((0, 0, 10, 50), (0, 0, 10, 40), airborne=False)
    assert not stands_nearer((0, 0, 10, 30), (0, 0, 10, 40), airborne=False)
    assert stands_nearer((0, 0, 10, 30), (0, 0, 10, 40), airborne=True)


def test_the_box_moves_and_grows_about_its_centre() -> None:
    assert box_at((10, 20, 30, 60), np.array([20, 40]), np.array([100, 100]), 2.0) == (80, 60, 120, 140)
