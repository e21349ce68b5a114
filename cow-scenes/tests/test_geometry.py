from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cow_scenes.camera import Camera, draw_camera, look_at
from cow_scenes.catalogue import HEIGHT
from cow_scenes.meshes import parts_of, surface_of
from cow_scenes.pieces import pieces_of
from cow_scenes.raster import depth_of, hidden_share, id_picture, turn_matrix

seeds = st.integers(0, 2**32 - 1)
inside = st.tuples(*[st.floats(-1, 1)] * 3)


def camera_of(seed):
    return draw_camera(np.random.default_rng(seed), 832, 480, np.array([0.1, -0.1, 0.2]))


@given(seeds, inside)
def test_a_projected_point_lies_on_its_ray(seed, point):
    camera, point = camera_of(seed), np.array(point)
    depth = camera.to_camera(point)[2]
    assert np.allclose(camera.pose[:3, 3] + depth * camera.ray(camera.project(point)), point, atol=1e-8)


@given(seeds, inside)
def test_the_recorded_matrices_project_alike(seed, point):
    camera = camera_of(seed)
    seen = np.linalg.inv(camera.pose) @ np.array([*point, 1.0])
    pixel = camera.matrix @ seen[:3]
    assert np.allclose(pixel[:2] / pixel[2], camera.project(np.array(point)), atol=1e-6)


@given(seeds)
def test_cameras_have_no_roll_and_look_down(seed):
    camera = camera_of(seed)
    right, down, forward = camera.pose[:3, :3].T
    assert abs(right[2]) < 1e-9
    assert down[2] < 0
    assert 20 <= np.degrees(np.arcsin(-forward[2])) <= 36
    assert np.allclose(camera.pose[:3, :3].T @ camera.pose[:3, :3], np.eye(3))
    small = camera.at_width(208, 120)
    assert np.allclose(small.project(np.zeros(3)) * 4, camera.project(np.zeros(3)))


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_turns_keep_lengths(q):
    m = turn_matrix(np.array(q))
    assert np.allclose(m @ m.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(m) > 0


@pytest.mark.parametrize("shape", HEIGHT)
def test_meshes_are_closed_and_as_high_as_said(shape):
    for part in parts_of(shape):
        edges = Counter(frozenset(e) for a, b, c in part.triangles.tolist() for e in ((a, b), (b, c), (c, a)))
        open_edges = [e for e, n in edges.items() if n != 2]
        # The handle's two ends are inside the mug.
        assert len(open_edges) in ({0, 20} if shape == "mug" else {0})
    z = surface_of(shape)[0][:, 2]
    assert z.min() == pytest.approx(-HEIGHT[shape] / 2, abs=1e-3)
    assert z.max() == pytest.approx(HEIGHT[shape] / 2, abs=1e-3)


@pytest.mark.parametrize("shape", sorted(set(HEIGHT) - {"ball", "cube"}))
def test_bullet_and_the_picture_have_the_same_extent(shape):
    drawn, solid = surface_of(shape)[0], np.concatenate(pieces_of(shape))
    assert np.allclose(drawn.min(0), solid.min(0), atol=0.015)
    assert np.allclose(drawn.max(0), solid.max(0), atol=0.015)


@settings(max_examples=10)
@given(seeds)
def test_a_ball_is_drawn_where_it_projects(seed):
    camera = camera_of(seed).at_width(416, 240)
    depth = depth_of(camera, *surface_of("ball"))
    y, x = np.nonzero(np.isfinite(depth))
    away = np.linalg.norm(camera.pose[:3, 3])
    area = np.pi * (camera.focal * 0.15 / np.sqrt(away**2 - 0.15**2)) ** 2
    assert len(x) == pytest.approx(area, rel=0.06)
    assert np.allclose([x.mean() + 0.5, y.mean() + 0.5], camera.project(np.zeros(3)), atol=1)
    assert np.nanmin(depth) == pytest.approx(camera.to_camera(np.zeros(3))[2] - 0.15, abs=0.02)


def test_the_nearer_object_hides_the_farther():
    camera = Camera(400, 200, 120, look_at(np.array([0.0, -3, 0]), np.zeros(3)))
    vertices, triangles = surface_of("cube")
    near, far = (depth_of(camera, vertices + np.array([x, y, 0]), triangles) for x, y in ((0.15, -1.0), (0.0, 0.0)))
    ids = id_picture({"near": near, "far": far}, {"near": 1, "far": 2})
    assert ids[60, 120] == 1
    assert hidden_share(far, near) == pytest.approx((np.isfinite(far) & (ids == 1)).sum() / np.isfinite(far).sum())
    assert 0.3 < hidden_share(far, near) < 0.8
    assert hidden_share(near, far) == 0
