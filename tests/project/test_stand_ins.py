"""The stand-ins for models of depth and masks: that they are the truth, and that their errors are as large as said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

pytestmark = pytest.mark.slow
FOLDERS = sorted((ROOT / "cow-scenes" / "sample" / "truth").glob("*/*"))


@pytest.fixture
def stand_ins(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    import stand_ins

    return stand_ins


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_depth_and_camera_lead_to_a_flat_floor_with_the_things_in_their_boxes_above_it(
    stand_ins: Any, folder: Path
) -> None:
    scene = stand_ins.read_truth(folder)
    camera, pitch = scene.camera, np.radians(scene.camera.pitch)
    points = stand_ins.points_of(scene.depth, camera.focal, camera.centre)
    height = camera.height - points[..., 1] * np.cos(pitch) - points[..., 2] * np.sin(pitch)  # m above the floor
    assert (scene.depth.dtype, camera.roll) == (np.float32, 0)
    nobody = ~np.any([each.mask for each in scene.things], 0)
    assert np.abs(height[-1][nobody[-1]]).max() < 0.002
    for each in scene.things:
        assert height[each.mask].min() > -0.002, each.name
        assert height[each.mask].max() > 0.05, each.name
        rows, columns = np.nonzero(each.mask)
        x0, y0, x1, y1 = each.bbox
        assert x0 - 1 <= columns.min() < columns.max() <= x1 + 1
        assert y0 - 1 <= rows.min() < rows.max() <= y1 + 1
        assert scene.thing_in((x0 + 3, y0 - 2, x1 + 2, y1)) is each
        assert scene.thing(each.name) is each
    assert scene.thing_in((0, 0, 2, 2)) is None
    with pytest.raises(KeyError, match="pink"):
        scene.thing("pink")


def test_errors_are_seeded_smooth_and_as_large_as_said(stand_ins: Any) -> None:
    depth = np.full((240, 416), 3.0, np.float32)
    depth[0, 0] = np.nan

    def given(level: float, seed: int) -> Any:
        return stand_ins.with_errors(depth, 800.0, level, seed=seed)[0]

    assert np.isnan(given(0.03, 1)[0, 0])
    assert np.array_equal(given(0.03, 1), given(0.03, 1), equal_nan=True)
    for level in stand_ins.LEVELS:
        if level:
            logs = np.array([np.log(given(level, seed) / 3)[1:] for seed in range(30)])
            assert np.sqrt((logs**2).mean()) == pytest.approx(np.hypot(0.743 * level, 0.01), rel=0.1)
            # Neighbours differ by the white noise alone: a cell of the grid is some 60 px wide.
            assert np.diff(logs, axis=2).std() == pytest.approx(0.01 * np.sqrt(2), rel=0.05)
