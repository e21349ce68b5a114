"""Depth and ids against the records, and against the geometry that Blender draws."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cow_scenes.accept import still
from cow_scenes.maps import DEPTH_SCALE, depth_picture, maps_of
from cow_scenes.meta import meta_of
from cow_scenes.raster import placed, table_mesh
from cow_scenes.room import room_of
from cow_scenes.world import Thing

SAMPLE = Path(__file__).parents[1] / "sample"
NEAR = 0.001
"""Metres: half a unit of depth, along the longest ray and with the rounding of the records, is less."""


def points_of(depth, camera):
    """World points (height, width, 3) of depth in metres, from the record of the camera alone."""
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    k, pose = np.array(camera["K"]), np.array(camera["world_from_camera"])
    seen = np.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], np.ones_like(x)], -1) * depth[..., None]
    return seen @ pose[:3, :3].T + pose[:3, 3]


def heights_of(depth, camera):
    """Heights above the floor (height, width) in metres, from focal length, pitch and height of the camera alone."""
    rows = (np.arange(depth.shape[0]) + 0.5 - depth.shape[0] / 2)[:, None] / camera["focal"]
    pitch = np.radians(camera["pitch"])
    return camera["height"] - depth * (np.sin(pitch) + rows * np.cos(pitch))


def outside(points, vertices):
    """Metres (n,) by which points lie outside the extent of vertices."""
    return np.maximum(vertices.min(0) - points, points - vertices.max(0)).max(-1)


def test_every_pixel_lies_on_what_it_shows(worlds):
    tables = 0
    for item in worlds:
        ids, depth = maps_of(item)
        stored = np.asarray(depth_picture(depth)) * DEPTH_SCALE
        assert ((stored > 0) == np.isfinite(depth)).all()
        meta = meta_of(item, None)
        points, heights = points_of(stored, meta["camera"]), heights_of(stored, meta["camera"])
        assert np.abs(points[..., 2] - heights)[stored > 0].max() < NEAR
        for thing in item.draft.world.things:
            mine = points[ids == meta["id_of"][thing.name]]
            assert outside(mine, placed(thing, *still(thing))).max() < NEAR, (item.key.id, thing.name)
        if item.draft.world.table:
            vertices = table_mesh(item.draft.world.table)[0]
            assert outside(points[ids == meta["id_of"]["table"]], vertices).max() < NEAR
            tables += 1
        room = points[(ids == 0) & (stored > 0)]
        walls = [np.abs((room[:, :2] - out) @ out / np.linalg.norm(out)) for out in map(np.array, room_of(item).walls)]
        assert np.minimum(np.abs(room[:, 2]), np.min(walls, 0)).max() < NEAR
        assert (np.abs(room[:, 2]) < NEAR).mean() > 0.3
    assert tables >= 2


def test_the_sample_in_git_has_depth_that_fits_its_records():
    folders = sorted(SAMPLE.glob("truth/*/*"))
    assert len(folders) == 12
    for folder in folders:
        meta = json.loads((folder / "meta.json").read_text())
        camera = meta["camera"]
        with Image.open(folder / "depth.png") as depth, Image.open(folder / "ids.png") as numbers:
            assert depth.mode == "I;16"
            stored, ids = np.asarray(depth) * camera["depth_scale"], np.asarray(numbers)
        assert (folder / "depth.png").stat().st_size < 60_000
        points = points_of(stored, camera)
        for name, told in meta["objects"].items():
            # What is taken away has no place in the run that is asked about.
            world = (meta["factual"] or meta)["world"]
            turn = np.array([0, 0, np.sin(told["yaw"] / 2), np.cos(told["yaw"] / 2)])
            thing = Thing(told["shape"], told["colour"], tuple(world[name][0]), told["yaw"], told["scale"])
            vertices = placed(thing, np.array(thing.centre), turn)
            assert outside(points[ids == meta["id_of"][name]], vertices).max() < 0.002, (folder.name, name)
        assert np.median(np.abs(heights_of(stored, camera)[-1])) < 0.001, folder.name


def test_what_is_too_far_is_not_told():
    with io.BytesIO() as file:
        depth_picture(np.array([[1.0, 16.38], [16.4, np.inf]])).save(file, "PNG")
        with Image.open(file) as read:
            assert np.asarray(read).tolist() == [[4000, 65520], [0, 0]]


def test_the_depth_is_that_of_what_blender_draws(worlds):
    bpy = pytest.importorskip("bpy")
    from mathutils import Vector

    from cow_scenes.studio import Studio

    random = np.random.default_rng(5)
    chosen = [w for w in worlds if w.draft.world.table][:2] + [w for w in worlds if w.key.level == "L2"][:4]
    for item in chosen:
        studio = Studio(item, 1, 1)
        studio.place(0)
        bpy.context.view_layer.update()
        graph, eye = bpy.context.evaluated_depsgraph_get(), item.camera.pose[:3, 3]
        ids, depth = maps_of(item)
        named = {0: {"floor", "wall"}} | {n: {name} for name, n in meta_of(item, None)["id_of"].items()}
        drawn, apart = 0, 0
        for number in named:
            y, x = np.nonzero((ids == number) & np.isfinite(depth))
            for i in random.integers(0, len(x), 150):
                ray = item.camera.ray(np.array([x[i] + 0.5, y[i] + 0.5]))
                found, point, _, _, thing, _ = bpy.context.scene.ray_cast(graph, Vector(eye), Vector(ray))
                told = item.camera.to_camera(np.array(point))[2] if found else np.inf
                name = thing.name.split(".")[0] if found else None
                apart += name not in named[number] or abs(told - depth[y[i], x[i]]) > NEAR
                drawn += 1
        # A pixel whose centre is within a rounding error of an outline may show either side of it.
        assert apart <= drawn // 300, (item.key.id, apart, drawn)
