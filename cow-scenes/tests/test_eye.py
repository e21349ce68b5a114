"""The eye: its pictures and their truth, a toy that is trained, exported and looks, and the file that is shipped."""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from cow_scenes.errors import UsageError
from cow_scenes.eye import require_libraries

try:
    require_libraries()
except UsageError as error:
    pytest.skip(str(error), allow_module_level=True)

from typer.testing import CliRunner

from cow_scenes.eye.batches import THING, Album
from cow_scenes.eye.calibrate import fit
from cow_scenes.eye.commands import app, draw_groups
from cow_scenes.eye.decode import Eye, grouped, input_size, joined, tidied
from cow_scenes.eye.decode import Limits as DecodeLimits
from cow_scenes.eye.evaluate import look_at, reliability, summary
from cow_scenes.eye.pictures import DRAWN, PER_STAGE, Pen, Shard, draw_group
from cow_scenes.eye.room import FIRST_FLAT, FIRST_SUPPORT, FIRST_THING, FIRST_WALL
from cow_scenes.eye.shapes import MAKERS
from cow_scenes.eye.surfaces import plane_points, retextured
from cow_scenes.eye.training import Recipe, train

ROOT = Path(__file__).parents[1]
WEIGHTS = ROOT.parent / "models" / "things.onnx"
SEED, GROUP = 7, 0
TOY = ((4, 64, 96), (1, 384, 640))


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """A folder with one shard."""
    folder = tmp_path_factory.mktemp("eye")
    draw_groups(folder, SEED, [GROUP])
    return folder


@pytest.fixture(scope="module")
def pictures(shards):
    shard = Shard(next(shards.glob("seed*.npz")))
    return [shard[k] for k in range(len(shard))]


@pytest.mark.parametrize("name", MAKERS)
def test_shapes_are_whole_and_stand_on_the_ground(name):
    for seed in range(8):
        parts = MAKERS[name][0](np.random.default_rng(seed))
        low = min(part.vertices[:, 2].min() for part in parts)
        assert abs(low) < 0.1, seed
        for part in parts:
            assert np.isfinite(part.vertices).all()
            assert part.vertices.shape == (len(part.texture), 3)
            assert 0 <= part.faces.min() <= part.faces.max() < len(part.vertices)


def test_a_picture_of_a_seed_is_always_the_same(pictures):
    with Pen():
        again = next(draw_group(SEED, GROUP))
    assert np.array_equal(again.ids, pictures[0].ids)
    assert np.array_equal(again.marks, pictures[0].marks)
    # The shard has it as a JPEG.
    assert np.abs(again.image.astype(int) - pictures[0].image).mean() < 4


def test_pictures_hold_what_there_is_to_see(pictures):
    ids = np.stack([p.ids for p in pictures])
    for first, limit in ((FIRST_THING, FIRST_FLAT), (FIRST_FLAT, FIRST_SUPPORT), (FIRST_SUPPORT, FIRST_WALL)):
        assert ((ids >= first) & (ids < limit)).any()
    assert any((p.marks & DRAWN).any() for p in pictures)
    for picture in pictures:
        supports = [k for k in np.unique(picture.ids) if FIRST_SUPPORT <= k < FIRST_WALL]
        lengths = np.linalg.norm(picture.normals[supports].astype(float), axis=1)
        assert np.allclose(lengths, 1, atol=0.01)
        assert (picture.normals[supports, 1] < 0.2).all(), "supports face up or towards the camera"
        assert (picture.depth > 0).all()


def test_a_shard_that_is_there_is_not_drawn_again(shards):
    path = next(shards.glob("seed*.npz"))
    before = path.stat().st_mtime_ns
    draw_groups(shards, SEED, [GROUP])
    assert path.stat().st_mtime_ns == before


def test_cuttings_mostly_show_things_and_batches_have_their_targets(shards):
    album = Album(shards)
    assert album.refresh() == PER_STAGE
    shown = []
    for seed in range(4):
        batch = album.batch(np.random.default_rng(seed), (8, 96, 160))
        assert batch.images.shape == (8, 96, 160, 3)
        assert batch.classes.shape == batch.rim.shape == (8, 48, 80)
        assert batch.offsets.shape == (8, 2, 24, 40)
        assert batch.classes.min() >= -1
        # What belongs to a thing points to its centre, which is where the map of centres is high.
        n, y, x = np.nonzero(batch.belongs > 0)
        ends = np.round([y + 8 * batch.offsets[n, 0, y, x], x + 8 * batch.offsets[n, 1, y, x]]).astype(int)
        inside = (ends[0] < 24) & (ends[1] < 40)
        assert (batch.centres[n[inside], ends[0, inside], ends[1, inside]] > 0.3).all()
        shown += list((batch.classes == THING).any((1, 2)))
    assert np.mean(shown) > 0.6


def test_patterns_cover_surfaces_alone_and_lie_in_their_planes(pictures):
    random = np.random.default_rng(0)
    changed = [retextured(picture, random) for picture in pictures]
    assert any((a.image != b.image).any() for a, b in zip(pictures, changed, strict=True))
    for before, after in zip(pictures, changed, strict=True):
        differs = (before.image != after.image).any(2)
        assert np.isin(before.ids[differs], range(FIRST_FLAT, FIRST_WALL)).all()
        assert not (before.marks[differs] & DRAWN).any()
    floor = next(p for p in pictures if (p.ids == FIRST_SUPPORT).sum() > 20_000)
    points = plane_points(floor, FIRST_SUPPORT, 0.3)
    depth = floor.depth.astype(float)
    sparse = np.s_[2::4, 2::4]
    y, x = np.nonzero(floor.ids[sparse] == FIRST_SUPPORT)
    rays = np.stack([(4 * x + 2 - 320) / floor.focal, (4 * y + 2 - 192) / floor.focal, np.ones(len(x))], 1)
    space = rays * depth[y, x, None]
    near = np.argsort(depth[y, x])[:: max(1, len(x) // 50)][:25]
    between = np.linalg.norm(space[near][1:] - space[near][:-1], axis=1)
    flat = points[sparse][y[near], x[near]]
    assert np.allclose(np.linalg.norm(flat[1:] - flat[:-1], axis=1), between, rtol=0.1, atol=0.03)


@pytest.fixture(scope="module")
def toy(shards, tmp_path_factory):
    """A training of twelve steps."""
    out = tmp_path_factory.mktemp("run")
    train(shards, shards, out, Recipe(steps=12, threads=1, shapes=TOY), tell=lambda _: None)
    return out


def stop(_: str):
    raise KeyboardInterrupt


def test_a_toy_learns_and_a_stopped_training_goes_on_as_if_it_had_not(shards, toy, tmp_path):
    recipe = Recipe(steps=12, threads=1, shapes=TOY, check=6)
    row = json.loads((toy / "log.jsonl").read_text().splitlines()[-1])
    assert row["step"] == 12
    assert all(np.isfinite(v) for v in row["held out"].values())
    with pytest.raises(KeyboardInterrupt):
        train(shards, shards, tmp_path, recipe, tell=stop)
    resumed = train(shards, shards, tmp_path, recipe, tell=lambda _: None)
    whole = train(shards, shards, toy, recipe, tell=lambda _: None)
    for a, b in zip(resumed.average.parameters(), whole.average.parameters(), strict=True):
        assert np.allclose(a.detach(), b.detach(), atol=1e-5)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_toy_is_shipped_with_a_card_and_looks(shards, toy, tmp_path):
    weights = tmp_path / "toy.onnx"
    sample = tmp_path / "scenes"
    for scene in sorted((ROOT / "sample").glob("truth/*/*"))[:2]:
        shutil.copytree(scene, sample / scene.name)
    arguments = ["ship", str(toy), str(weights), "--held", str(shards), "--scenes", f"first={sample}"]
    outcome = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert outcome.exit_code == 0
    card = json.loads(weights.with_suffix(".json").read_text())
    assert card["sha256"] == hashlib.sha256(weights.read_bytes()).hexdigest()
    assert card["measured"]["first"]["pictures"] == 2
    scores = look_at(sample, Eye(weights))
    assert summary(scores)["things"] >= 4
    assert isinstance(reliability(scores), list)


def test_the_shipped_file_is_the_one_that_its_card_names():
    card = json.loads(WEIGHTS.with_suffix(".json").read_text())
    assert card["sha256"] == hashlib.sha256(WEIGHTS.read_bytes()).hexdigest()
    assert card["bytes"] == WEIGHTS.stat().st_size <= 3_000_000
    assert card["licence"] == "Apache-2.0"


def test_the_shipped_eye_finds_most_things_of_the_samples():
    eye = Eye(WEIGHTS)
    for family in ("sample", "sample_other"):
        figures = summary(look_at(ROOT / family, eye))
        assert figures["found at 0.5"] > 0.8, family
        assert figures["nothing"] < 1.5, family


def test_pixels_go_to_the_centre_they_point_to_and_crumbs_go():
    region = np.zeros((40, 60), bool)
    region[10:20, 10:20] = region[10:20, 20:30] = True
    region[0, 0] = True
    centres, offsets = np.array([[14.5, 14.5], [14.5, 24.5]]), np.zeros((40, 60, 2), np.float32)
    labels = tidied(grouped(region, centres, offsets, DecodeLimits(), keep_rest=True), DecodeLimits())
    assert set(np.unique(labels)) == {0, 1, 2}
    assert labels[0, 0] == 0
    assert (labels[12, 11], labels[12, 28]) == (1, 2)


def test_two_that_touch_are_one_without_a_rim_between_them():
    labels = np.zeros((20, 40), np.uint8)
    labels[5:15, 5:20], labels[5:15, 20:35] = 1, 2
    rim = np.zeros((20, 40), np.float32)
    assert set(np.unique(joined(labels, rim, 0.25))) == {0, 1}
    rim[:, 19:21] = 0.9
    assert set(np.unique(joined(labels, rim, 0.25))) == {0, 1, 2}


@pytest.mark.parametrize(("height", "width"), [(468, 832), (1280, 720), (33, 2000), (8, 8)])
def test_the_network_sees_multiples_of_32(height, width):
    assert all(side % 32 == 0 and side > 0 for side in input_size(height, width))


def test_the_calibration_tells_probabilities():
    random = np.random.default_rng(0)
    evidence = random.normal(0, 2, (4000, 4))
    truth = random.uniform(size=4000) < 1 / (1 + np.exp(-(evidence @ (1.0, 0.5, -0.3, 0.2) - 0.7)))
    fitted = fit(evidence, truth)
    told = np.array([fitted.probability(row) for row in evidence])
    for low in (0.1, 0.3, 0.5, 0.7):
        chosen = (told >= low) & (told < low + 0.2)
        assert abs(told[chosen].mean() - truth[chosen].mean()) < 0.06
