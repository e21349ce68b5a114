"""The second family: real runs of MuJoCo, its real pictures, and the sample of it in git."""

import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from cow_scenes.check import check_set, expected_answer
from cow_scenes.errors import UsageError
from cow_scenes.other import require_libraries
from cow_scenes.plan import LEVELS, OTHER_FORMS, TASKS, plan_items
from cow_scenes.settings import Settings

try:
    require_libraries()
except UsageError as error:
    pytest.skip(str(error), allow_module_level=True)

from cow_scenes.camera import Camera
from cow_scenes.meta import contacts_of, world_of
from cow_scenes.other.physics import Fixture, Matter, OtherWorld, Variation, simulate
from cow_scenes.other.shapes import Solid, shapes
from cow_scenes.raster import depth_of, placed

ROOT = Path(__file__).parents[1]
FOLDERS = sorted((ROOT / "sample_other").glob("truth/*/*"))
COMMAND = Path(sys.executable).parent / "cow-scenes"


def metas():
    return [json.loads((folder / "meta.json").read_text()) for folder in FOLDERS]


def world_at(meta):
    """The world of a record."""
    start = {name: tuple(at[0]) for name, at in (meta["factual"] or meta)["world"].items()}
    things = tuple(Solid(o["shape"], o["colour"], start[n], o["yaw"], o["scale"]) for n, o in meta["objects"].items())
    fixtures = tuple(Fixture(f["name"], tuple(f["centre"]), f["yaw"], tuple(f["size"])) for f in meta["fixtures"])
    told = meta["physics"]
    return OtherWorld(
        things, meta["object"], tuple(meta["v0"]), tuple(told["spin"]), removed=meta["removed"], fixtures=fixtures,
        carry_to=told["carry_to"], matter=Matter(told["friction"], told["restitution"], told["sliding"]),
    )  # fmt: skip


def told_by(run, meta):
    """What follows from a run, judged as `cow-scenes check` does."""
    contacts, names = contacts_of(run), set(meta["objects"])
    mine = [c for c in contacts if meta["object"] in {c["a"], c["b"]}]
    hits = {n: c["first_sample"] for c in reversed(mine) for n in (c["a"], c["b"]) if n in names - {meta["object"]}}
    chain = meta["chain"] and {"hit": getattr(run.first(meta["chain"]["via"], meta["target"]), "sample", None)}
    return expected_answer({**meta, "contacts": contacts, "hits": hits, "chain": chain, "world": world_of(run)})


def test_the_sample_is_sound_small_and_varied():
    report = check_set(ROOT / "sample_other")
    assert report.problems == []
    assert len(report.ids) == 10
    sizes = [p.stat().st_size for p in (ROOT / "sample_other").rglob("*") if p.is_file()]
    assert sum(sizes) < 2_500_000
    assert max(sizes) < 1_000_000
    assert len({m["form"] for m in metas()}) >= 8
    assert {m["family"] for m in metas()} == {"other"}
    assert len({tuple(m["image_size"]) for m in metas()}) >= 4
    assert all(-1 < m["camera"]["pitch"] < 61 for m in metas())


def test_ids_and_depth_of_the_pictures_fit_camera_and_records():
    for folder, meta in zip(FOLDERS, metas(), strict=True):
        told, world = meta["camera"], world_at(meta)
        with Image.open(folder / "ids.png") as numbers, Image.open(folder / "depth.png") as far:
            ids, depth = np.asarray(numbers), np.asarray(far) * told["depth_scale"]
        camera = Camera(told["focal"], *meta["image_size"], np.array(told["world_from_camera"]))
        y, x = np.nonzero(depth)
        points = camera.pose[:3, 3] + camera.ray(np.stack([x, y], 1) + 0.5) * depth[y, x, None]
        for thing in world.things:
            vertices = placed(thing, np.array(thing.centre), [0, 0, np.sin(thing.yaw / 2), np.cos(thing.yaw / 2)])
            mine = points[ids[y, x] == meta["id_of"][thing.name]]
            assert np.maximum(vertices.min(0) - mine, mine - vertices.max(0)).max() < 0.003, (folder.name, thing.name)
            # Our own raster of the same mesh gives the silhouette that nothing hides.
            alone = np.isfinite(depth_of(camera, vertices, thing.surface[1])).sum()
            least = 0.88 if thing.name in {meta["object"], meta["target"]} else 0.58
            assert len(mine) > least * alone, (folder.name, thing.name)
        left, top, right, bottom = np.array(meta["bbox"]).round().astype(int)
        assert (ids[top:bottom, left:right] == meta["id_of"][meta["object"]]).mean() > 0.3
        assert np.abs(points[ids[y, x] == 0][:, 2]).min() < 0.001


def test_truths_follow_from_the_stored_physics_and_hold_under_its_variations():
    for meta in metas():
        if meta["hidden"] is not None:
            continue
        world, truth = world_at(meta), meta["options"][ord(meta["answer"]) - ord("A")]
        run = simulate(world)
        assert told_by(run, meta) == truth, meta["id"]
        # An apple rolls unevenly, so that the rounding of the record grows.
        until = min([10, *meta["hits"].values()])
        assert np.allclose(run.centres[world.mover][:until], meta["world"][world.mover][:until], atol=0.02), meta["id"]
        assert len(meta["physics"]["variations"]) >= 6
        for variation in meta["physics"]["variations"]:
            varied = world.varied(Variation(**variation), meta["physics"]["fine"])
            assert told_by(simulate(varied), meta) == truth, (meta["id"], variation)


@pytest.mark.parametrize(("ratio", "inside"), [(0.88, True), (1.12, False)])
def test_what_is_put_into_a_vessel_ends_inside_if_it_is_narrower(ratio, inside):
    pot = Solid("pot", "blue", (0, 0, 0.07))
    ball = Solid("ball", "red", (-0.4, 0, 0.1), scale=ratio * pot.opening / (2 * shapes()["ball"].radius))
    run = simulate(OtherWorld((ball, pot), ball.name, carry_to=(0.0, 0.0, 0.18 + ball.height / 2)))
    assert (run.centres[ball.name][-1][2] < pot.height) == inside


def test_placings_in_the_sample_need_looking():
    ratios = [m["fit"]["width"] / m["fit"]["opening"] for m in metas() if m["fit"]]
    assert ratios
    assert all(0.79 < ratio < 1.21 for ratio in ratios)


@pytest.mark.parametrize(("restitution", "measured"), [(0.1, 0.29), (0.3, 0.44), (0.75, 0.79)])
def test_a_ball_bounces_as_the_readme_says_and_rolls_without_loss(restitution, measured):
    ball = Solid("ball", "red", (0, 0, 1.08))
    height = simulate(OtherWorld((ball,), ball.name, matter=Matter(0.6, restitution))).centres[ball.name][:, 2] - 0.08
    assert np.sqrt(height[15:50].max()) == pytest.approx(measured, abs=0.02)
    rolling = OtherWorld((replace(ball, centre=(0, 0, 0.08), yaw=1.0),), ball.name, (1.0, 0.5, 0.0), (-6.25, 12.5, 0.0))
    assert np.allclose(simulate(rolling).centres[ball.name][-1], [2, 1, 0.08], atol=0.02)


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    digests = []
    for name, processes in (("a", "1"), ("b", "2")):
        call = [COMMAND, "make", "--family", "other", "--level", "L1", "--task", "collision", "--count", "2", "--seed"]
        call += ["3", "--width", "300", "--out", tmp_path / name, "--processes", processes]
        done = subprocess.run(list(map(str, call)), capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        files = sorted(p for p in (tmp_path / name).rglob("*") if p.is_file())
        digests.append({p.relative_to(tmp_path / name): hashlib.sha256(p.read_bytes()).digest() for p in files})
    assert digests[0] == digests[1]
    assert check_set(tmp_path / "a").problems == []


@pytest.mark.parametrize("task", TASKS)
def test_every_form_has_both_answers_in_both_levels(task):
    keys = plan_items(1, (task,), LEVELS, 48, "other")
    for level in LEVELS:
        for form in set(OTHER_FORMS[task]):
            wants = [key.want for key in keys if (key.level, key.form) == (level, form)]
            assert abs(wants.count(0) - wants.count(1)) <= len(wants) // 3


@pytest.mark.parametrize(("module", "engine"), [("other.item", "bpy"), ("item", "mujoco")])
def test_neither_family_loads_the_other_renderer(module, engine):
    code = f"import sys, cow_scenes.{module}; sys.exit({engine!r} in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, env=os.environ).returncode == 0


def test_what_is_missing_or_has_no_meaning_is_named(monkeypatch):
    with pytest.raises(UsageError, match="--height 500"):
        Settings(family="other", height=500)
    with pytest.raises(UsageError, match="'third' is not known"):
        Settings(family="third").plan()
    monkeypatch.setattr("ctypes.util.find_library", lambda name: None)
    with pytest.raises(UsageError, match="libosmesa6"):
        require_libraries()


def test_the_readme_names_every_field_of_a_record():
    text = (ROOT / "README.md").read_text()
    for meta in metas():
        assert all(f"`{field}`" in text for field in meta), meta["id"]
