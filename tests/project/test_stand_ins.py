"""The stand-ins for models of depth and masks: that they are the truth, and that their errors are as large as said."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import EXAMPLES, ROOT
from numpy.typing import NDArray

sys.path.insert(0, str(ROOT / "benchmarks"))

import stand_ins
from stand_ins import TrueScene, points_of, read_truth, with_errors

FOLDERS = sorted((ROOT / "cow-scenes" / "sample" / "truth").glob("*/*"))


@pytest.fixture(scope="module", params=FOLDERS, ids=lambda folder: folder.name)
def scene(request: pytest.FixtureRequest) -> TrueScene:
    return read_truth(request.param)


def heights(scene: TrueScene) -> NDArray[np.floating]:
    """Heights [H, W] above the floor (m) that depth and camera lead to."""
    assert scene.camera.pitch is not None
    assert scene.camera.height is not None
    points, pitch = points_of(scene.depth, scene.camera.focal, scene.camera.centre), np.radians(scene.camera.pitch)
    return scene.camera.height - points[..., 1] * np.cos(pitch) - points[..., 2] * np.sin(pitch)


def test_depth_and_camera_lead_to_a_flat_floor_with_the_things_above_it(scene: TrueScene) -> None:
    height = heights(scene)
    assert scene.depth.dtype == np.float32
    assert scene.camera.roll == 0
    nobody = ~np.any([each.mask for each in scene.things], 0)
    assert np.abs(height[-1][nobody[-1]]).max() < 0.002
    for each in scene.things:
        assert height[each.mask].min() > -0.002, each.name
        assert height[each.mask].max() > 0.05, each.name


def test_masks_lie_in_their_boxes_and_are_found_by_them(scene: TrueScene) -> None:
    for each in scene.things:
        rows, columns = np.nonzero(each.mask)
        x0, y0, x1, y1 = each.bbox
        assert x0 - 1 <= columns.min() < columns.max() <= x1 + 1
        assert y0 - 1 <= rows.min() < rows.max() <= y1 + 1
        assert scene.thing_in((x0 + 3, y0 - 2, x1 + 2, y1)) is each
        assert scene.thing(each.name) is each
    assert scene.thing_in((0, 0, 2, 2)) is None
    with pytest.raises(KeyError, match="pink"):
        scene.thing("pink")


def test_a_table_has_the_box_of_its_mask(tmp_path: Path) -> None:
    """The sample has no table, so that one is drawn into a copy."""
    folder = shutil.copytree(FOLDERS[0], tmp_path / "scene")
    ids = cv2.imread(str(folder / "ids.png"), cv2.IMREAD_UNCHANGED)
    ids[400:440, 100:200] = 9
    cv2.imwrite(str(folder / "ids.png"), ids)
    meta = json.loads((folder / "meta.json").read_text())
    meta["id_of"]["table"] = 9
    (folder / "meta.json").write_text(json.dumps(meta))
    table = read_truth(folder).thing("table")
    assert table.bbox == (100, 400, 200, 440)
    assert table.mask.sum() == 4000


def test_the_other_family_is_read_alike(tmp_path: Path) -> None:
    """Depth as float16 metres in depth.npz, one box per thing, ids in the order of the boxes."""
    folder = FOLDERS[0]
    known = read_truth(folder)
    for name in ("image.jpg", "ids.png"):
        shutil.copy(folder / name, tmp_path / name)
    meta = json.loads((folder / "meta.json").read_text())
    camera = {name: meta["camera"][name] for name in ("focal", "pitch", "height")}
    boxes = {name: each[0] for name, each in meta["boxes"].items()}
    (tmp_path / "meta.json").write_text(json.dumps({"boxes": boxes, "camera": camera}))
    np.savez_compressed(tmp_path / "depth.npz", depth=known.depth.astype(np.float16))
    read = read_truth(tmp_path)
    assert read.camera == known.camera
    assert [(each.name, each.bbox) for each in read.things] == [(each.name, each.bbox) for each in known.things]
    assert all((one.mask == other.mask).all() for one, other in zip(read.things, known.things, strict=True))
    assert np.allclose(read.depth, known.depth, rtol=1e-3)


def test_a_scene_without_depth_is_an_error() -> None:
    with pytest.raises(FileNotFoundError, match="depth"):
        read_truth(EXAMPLES / "ball-and-mug")


def test_without_a_level_depth_stays_as_it_is() -> None:
    depth = np.full((48, 64), 3.0, np.float32)
    for factor in stand_ins.FOCAL_FACTORS:
        given, focal = with_errors(depth, 800.0, 0.0, factor, seed=4)
        assert (given == depth).all()
        assert given is not depth
        assert focal == pytest.approx(800 * factor)


@pytest.mark.parametrize("level", [level for level in stand_ins.LEVELS if level])
def test_errors_are_seeded_smooth_and_as_large_as_said(level: float) -> None:
    depth = np.full((240, 416), 3.0, np.float32)
    depth[0, 0] = np.nan
    given, _ = with_errors(depth, 800.0, level, seed=1)
    assert given.dtype == np.float32
    assert np.isnan(given[0, 0])
    assert np.array_equal(given, with_errors(depth, 800.0, level, seed=1)[0], equal_nan=True)
    assert not np.array_equal(given, with_errors(depth, 800.0, level, seed=2)[0], equal_nan=True)
    logs = np.array([np.log(with_errors(depth, 800.0, level, seed=seed)[0] / 3)[1:] for seed in range(30)])
    assert np.sqrt((logs**2).mean()) == pytest.approx(np.hypot(0.743 * level, 0.01), rel=0.1)
    # Neighbours differ by the white noise alone: a cell of the grid is some 60 px wide.
    assert np.diff(logs, axis=2).std() == pytest.approx(0.01 * np.sqrt(2), rel=0.05)


def test_levels_of_a_seed_differ_by_their_factor_only() -> None:
    depth = np.full((48, 64), 3.0, np.float32)
    small, large = (np.log(with_errors(depth, 800.0, level, seed=9)[0] / 3) for level in (0.03, 0.06))
    none = 2 * small - large
    assert none.std() == pytest.approx(0.01, rel=0.1)


def test_the_motorcycle_stands_two_to_five_metres_away() -> None:
    pytest.importorskip("skimage", reason="needs scikit-image, whose wheel holds the photo")
    scene = stand_ins.motorcycle()
    assert scene.image.shape == (500, 741, 3)
    assert scene.depth.shape == (500, 741)
    assert 0.9 < np.isfinite(scene.depth).mean() < 0.95
    assert 2 < np.nanmin(scene.depth) < np.nanmax(scene.depth) < 5.1
