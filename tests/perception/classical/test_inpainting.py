"""Holes and drawings are filled from what is around them, and nothing else is touched."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import ball, floor
from hypothesis import given
from hypothesis import strategies as st

from cow_service.perception.classical.completion import as_disc
from cow_service.perception.classical.inpainting import blend_fill, erase_drawing, fill_hole, push_pull, shadow_beside

ROWS, COLUMNS = np.mgrid[:400, :640]


@given(
    st.integers(8, 300),
    st.integers(8, 300),
    st.tuples(st.floats(0, 0.9), st.floats(0, 0.9), st.floats(0.05, 1), st.floats(0.05, 1)),
)
def test_a_plain_surface_stays_plain_whatever_is_unknown(width: int, height: int, block) -> None:
    known = np.ones((height, width), bool)
    y, x = int(block[0] * height), int(block[1] * width)
    known[y : y + max(1, int(block[2] * height)), x : x + max(1, int(block[3] * width))] = False
    if not known.any():
        return
    source = np.where(known[..., None], 140.0, 0.0).repeat(3, axis=2).astype(np.float32)
    assert np.abs(push_pull(source, known) - 140).max() < 1


@pytest.mark.parametrize("radius", [8, 80])
def test_a_hole_in_a_floor_is_floor(radius: int) -> None:
    plain, away = floor(), np.hypot(COLUMNS - 300, ROWS - 200)
    filled = fill_hole(ball(plain, (300, 200), radius - 2, (20, 20, 20)), away < radius)
    assert np.abs(filled[away < radius].astype(int) - plain[away < radius]).mean() < 9
    assert (filled[away > radius + 15] == plain[away > radius + 15]).all()


def test_what_is_to_be_avoided_does_not_bleed_in() -> None:
    image = ball(floor(), (360, 200), 30, (220, 20, 20))
    away = np.hypot(COLUMNS - 300, ROWS - 200)
    filled = fill_hole(image, away < 28, np.hypot(COLUMNS - 360, ROWS - 200) < 33)[away < 28].astype(int)
    assert (filled[:, 0] - filled[:, 1]).max() < 12
    # Where all around is to be avoided, the hole is filled from afar.
    image = floor()
    image[away < 24] = (220, 20, 20)
    filled = fill_hole(image, away < 10, (away >= 10) & (away < 24))[away < 10].astype(int)
    assert (filled[:, 0] - filled[:, 1]).max() < 20


def test_a_pattern_goes_on_through_a_hole() -> None:
    tiles, hole = floor(), np.hypot(COLUMNS - 300, ROWS - 200) < 30
    tiles[(ROWS // 24 + COLUMNS // 24) % 2 == 0] -= 40
    filled = fill_hole(tiles, hole)[hole].astype(int)
    assert np.abs(filled - tiles[hole]).mean() == pytest.approx(2.61, abs=0.1), "steps between tiles are of 40"
    # What another painted is brought to the shading around the hole.
    paler = blend_fill(tiles, tiles + np.uint8(20), hole, np.zeros_like(hole))[hole].astype(int)
    assert np.abs(paler - tiles[hole]).mean() == pytest.approx(2.36, abs=0.1)


def test_the_shadow_of_what_is_taken_out_lies_beside_its_hole() -> None:
    image, hole = floor(), np.hypot(COLUMNS - 300, ROWS - 200) < 30
    shaded = np.hypot((COLUMNS - 330) / 60, (ROWS - 225) / 18) < 1
    image[shaded] //= 2
    shadow = shadow_beside(image, hole, np.zeros_like(hole))
    assert not (shadow & ~shaded).any()
    assert shadow.sum() == pytest.approx(545, abs=10)


def test_nothing_to_fill_is_no_work() -> None:
    image = floor()
    nothing = np.zeros(image.shape[:2], bool)
    assert fill_hole(image, nothing) is image
    assert erase_drawing(image, nothing) is image
    everything = ~nothing
    assert (fill_hole(image, everything) == image).all()


def _edges(disc: np.ndarray) -> np.ndarray:
    rows, columns = np.gradient(disc.astype(np.float32))
    return np.hypot(rows, columns) * 10


def test_a_bitten_ball_is_completed_and_a_square_is_not() -> None:
    ys, xs = np.mgrid[:120, :120]
    disc = np.hypot(xs - 60, ys - 60) < 35
    bitten = disc & ~(np.hypot(xs - 60, ys - 22) < 15)
    whole = as_disc(bitten, _edges(disc), 1.0)
    assert whole is not None
    assert (whole & disc).sum() / (whole | disc).sum() > 0.95
    assert as_disc(bitten, np.zeros((120, 120), np.float32), 1.0) is None
    square = (np.abs(xs - 60) < 30) & (np.abs(ys - 60) < 30)
    assert as_disc(square, _edges(square), 1.0) is None
