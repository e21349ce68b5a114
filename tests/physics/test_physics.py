"""Dynamics, the frontal camera, the ballistic law, anchors and swept masks, against closed forms and drawn truth."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cow_service.media.masks import CroppedMask
from cow_service.physics.ballistic import Camera, FreePath, ballistic_path, given_path
from cow_service.physics.camera import depth_motion
from cow_service.physics.tracks import points_inside, spread_anchors, swept
from cow_service.records import DIRECTED_KINDS, FALLING_KINDS, Grounding, MetresPerPixel, Motion, Path
from cow_service.requests import TrajectoryRequest


def test_what_goes_straight_away_over_the_floor_rises_in_the_image() -> None:
    assert depth_motion(1.0) == ((0.0, -1.0), pytest.approx(math.sqrt(0.75)))
    assert depth_motion(-1.0) == ((0.0, 1.0), pytest.approx(-math.sqrt(0.75)))


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
    points = points_inside(CroppedMask.of(ring), (150, 100), 5)
    assert len(points) == 5
    assert all(ring[int(y), int(x)] for x, y in points)
    assert points_inside(CroppedMask.of(np.zeros((10, 10), bool)), (4.0, 5.0), 5) == ((4.0, 5.0),)


class TestBallisticLaw:
    """The paths of before there was a floor, computed here once more in closed form."""

    def path(self, width, height, point, kind, direction, depth, speed, metres, times) -> FreePath:
        motion = Motion(
            kind=kind, law="ballistic", direction=direction, depth=depth, cue="request", speed=speed,
            gravity=(0.0, 9.81 / metres) if kind in FALLING_KINDS else (0.0, 0.0),
            metres_per_pixel=MetresPerPixel(value=metres, source="request"), sentence="", source="request",
        )  # fmt: skip
        box = (point[0] - 5, point[1] - 5, point[0] + 5, point[1] + 5)
        grounding = Grounding(object="ball", point=point, bbox=box, source="request")
        return ballistic_path(Camera(width, height, metres), grounding, motion, times)

    @given(
        st.tuples(st.floats(0, 639), st.floats(0, 399)),
        st.sampled_from(["linear", "projectile", "fall", "static"]),
        st.floats(-math.pi, math.pi),
        st.floats(-1, 1),
        st.floats(0, 2000),
        st.floats(1e-4, 0.1),
        st.integers(2, 81),
        st.sampled_from([8.0, 16.0, 24.0, 60.0]),
    )
    def test_it_is_velocity_and_gravity_before_a_frontal_camera(
        self, point, kind, angle, depth, speed, metres, frames, fps
    ) -> None:
        directed = kind in DIRECTED_KINDS
        dx, dy = (math.cos(angle), math.sin(angle)) if directed else (0.0, 0.0)
        depth, speed = (depth, speed) if directed else (0.0, 0.0)
        times = np.arange(frames) / fps
        found = self.path(640, 400, point, kind, (dx, dy) if directed else None, depth, speed, metres, times)
        first, pull = 640 * metres, 9.81 if kind in FALLING_KINDS else 0.0
        for i, t in enumerate(times.tolist()):
            across = speed * metres * math.sqrt(1 - depth**2)
            x = (point[0] - 320) * metres + across * dx * t
            y = (point[1] - 200) * metres + across * dy * t + pull * t * t / 2
            z = first + speed * metres * depth * t
            state = [x, y, z, across * dx, across * dy + pull * t, speed * metres * depth]
            assert found.states[i].tolist() == pytest.approx(state, rel=1e-9, abs=1e-9)
            passed = z <= 0.08 * first
            seen = max(z, 0.08 * first)
            u, v = 320 + 640 * x / seen, 200 + 640 * y / seen
            assert found.points[i].tolist() == pytest.approx([u, v], rel=1e-9, abs=1e-9)
            assert found.scale[i] == pytest.approx(first / seen, rel=1e-9)
            if min(abs(u), abs(u - 640), abs(v), abs(v - 400), abs(z - 0.08 * first)) > 1e-6:
                assert found.visible[i] == (0 <= u < 640 and 0 <= v < 400 and not passed)

    def test_a_given_path_is_followed_and_held(self) -> None:
        given = TrajectoryRequest(points=((200, 200), (300, 200), (300, 300)), fps=2)
        found = given_path(Camera(640, 400, 0.005), given, np.arange(33) / 16)
        expected = {0: (200, 200), 4: (250, 200), 8: (300, 200), 16: (300, 300), 32: (300, 300)}
        for frame, point in expected.items():
            assert found.points[frame].tolist() == pytest.approx(point)
        assert found.states[4, 3:].tolist() == pytest.approx([200 * 0.005, 0, 0])
        assert found.states[32, 3:].tolist() == [0, 0, 0]
        assert found.visible.all()


def test_the_swept_mask_covers_the_whole_way_and_no_more() -> None:
    ys, xs = np.mgrid[:400, :800] + 0.5
    disc = CroppedMask.of(np.hypot(xs - 100, ys - 200) <= 30)
    points = np.linspace((100, 200), (700, 200), 61)
    scale = np.linspace(1, 0.5, 61)
    path = Path(
        states=((0.0,) * 6,) * 61, points=tuple(map(tuple, points.tolist())), visible=(True,) * 61,
        scale=tuple(scale.tolist()), tracks=(),
    )  # fmt: skip
    mask = swept([disc], [np.array([100.0, 200.0])], [path])
    assert mask[200, 75:710].all()
    assert mask[175:225, 105].all()
    assert not mask[:165].any()
    assert not mask[:180, 690:].any(), "it has become half as large"
    assert not mask[:, 725:].any()
