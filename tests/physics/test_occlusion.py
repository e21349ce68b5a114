"""How much of one silhouette another hides: rectangles with known answers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cow_service.media.masks import CroppedMask
from cow_service.physics.events import SeenPaths, Shares
from cow_service.physics.events import shares as shares_of


def block(x0: int, y0: int, x1: int, y1: int) -> CroppedMask:
    mask = np.zeros((200, 400), bool)
    mask[y0:y1, x0:x1] = True
    return CroppedMask.of(mask)


def path(points, depth, scale=None) -> SeenPaths:
    """One draw, a point per frame."""
    frames = len(points)
    grown = np.ones(frames) if scale is None else np.array(scale, float)
    depths = np.full(frames, depth) if scale is None else depth / grown
    return SeenPaths(np.array([points], float), depths[None], grown[None], np.zeros((1, frames), bool))


def shares(mover: CroppedMask, seen: SeenPaths, other: CroppedMask, depths) -> Shares:
    """Of another body that stays where it is, at depths [K]."""
    frames = seen.depth.shape
    deep, size = np.broadcast_to(depths[:, None], frames), np.ones(frames)
    return shares_of(mover, seen, other, SeenPaths(np.full((*frames, 2), 100.0), deep, size, np.zeros(frames, bool)))


MOVER = block(20, 80, 60, 120)  # its middle at (40, 100)
OTHER = block(200, 80, 240, 120)


def test_before_the_other_it_covers_it_and_behind_it_it_is_covered() -> None:
    places = [(40, 100), (180, 100), (200, 100), (220, 100), (230, 110), (280, 100)]
    before, behind = (shares(MOVER, path(places, depth), OTHER, np.array([3.0])) for depth in (2.0, 4.0))
    assert before.covers[0] == pytest.approx([0, 0, 0.5, 1, 0.75 * 0.75, 0], abs=0.06)
    assert behind.covered[0] == pytest.approx([0, 0, 0.5, 1, 0.75 * 0.75, 0], abs=0.06)
    assert before.covered.tolist() == behind.covers.tolist() == [[0] * 6]


def test_shares_are_of_what_is_hidden_and_it_grows_as_it_comes_nearer() -> None:
    large, there, other = block(180, 40, 280, 140), [(40, 100), (230, 100)], np.array([3.0])
    assert shares(MOVER, path(there, 4.0), large, other).covered[0, 1] == pytest.approx(1, abs=0.03)
    assert shares(MOVER, path(there, 2.0), large, other).covers[0, 1] == pytest.approx(0.16, abs=0.05)
    large = block(180, 60, 260, 140)
    found = shares(MOVER, path([(40, 100), (220, 100), (220, 100)], 4.0, [1, 1, 2]), large, np.array([4.5]))
    assert found.covers[0] == pytest.approx([0, 0.25, 1], abs=0.06)


def test_each_draw_has_its_own_depths_and_what_has_passed_the_camera_hides_nothing() -> None:
    one = path([(40, 100), (220, 100)], 2.0)
    two = SeenPaths(*(np.repeat(v, 2, axis=0) for v in (one.points, one.depth, one.scale, one.passed)))
    found = shares(MOVER, two, OTHER, np.array([3.0, 1.0]))
    assert found.covers[:, 1] == pytest.approx([1, 0])
    assert found.covered[:, 1] == pytest.approx([0, 1])
    gone = SeenPaths(one.points, one.depth, one.scale, np.array([[False, True]]))
    assert shares(MOVER, gone, OTHER, np.array([3.0])).covers[0].tolist() == [0, 0]


@given(
    st.tuples(st.integers(0, 300), st.integers(0, 150), st.integers(1, 100), st.integers(1, 50)),
    st.tuples(st.integers(0, 300), st.integers(0, 150), st.integers(1, 100), st.integers(1, 50)),
    st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)),
    st.floats(1e-3, 12.5),
    st.floats(0.1, 100),
)
def test_shares_are_shares(a, b, point, scale, depth) -> None:
    mover, other = (block(x, y, x + w, y + h) for x, y, w, h in (a, b))
    found = shares(mover, path([(50, 50), point], depth, [1, scale]), other, np.array([10.0]))
    for values in (found.covers, found.covered):
        assert ((values >= 0) & (values <= 1)).all()
    assert ((found.covers == 0) | (found.covered == 0)).all()
