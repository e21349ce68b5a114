"""Openings of containers in the image: how wide the rim is, and the bottom."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import bowl, floor
from hypothesis import given
from hypothesis import strategies as st

from cow_service.media.masks import CroppedMask
from cow_service.perception.classical.openings import measure_opening


@given(half=st.floats(25, 90), base=st.floats(0.4, 0.9), seed=st.integers(0, 3))
def test_the_rim_of_a_bowl_is_measured(half: float, base: float, seed: int) -> None:
    plain = floor(seed=seed)
    image = bowl(plain, (320, 180), half, 0.8 * half, (60, 160, 60), base)
    seen = measure_opening(CroppedMask.of(np.abs(image.astype(int) - plain).max(axis=2) > 20))
    assert seen.rim is not None
    assert seen.rim[2] == pytest.approx(half, abs=max(2.0, 0.05 * half))
    assert seen.inner == pytest.approx(0.93, abs=max(0.04, 2 / half))
    assert seen.bottom == pytest.approx(base, abs=0.12)
