import hashlib
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image

TINY = ["--width", "208", "--height", "120", "--samples", "1", "--seed", "4", "--level", "L1"]
COMMAND = Path(sys.executable).parent / "cow-scenes"


def scenes(*arguments, **environment):
    call = [str(COMMAND), *map(str, arguments)]
    return subprocess.run(call, capture_output=True, text=True, check=False, env={**os.environ, **environment})


def digests(folder):
    files = sorted(p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Three tiny items: a slide, a throw and a fall."""
    folder = tmp_path_factory.mktemp("made") / "set"
    done = scenes("make", "--out", folder, "--count", 3, *TINY)
    assert done.returncode == 0, done.stderr
    return folder


def test_rows_have_the_public_columns(made):
    table = pq.read_table(made / "collision" / "test-00000-of-00001.parquet")
    assert table.column_names == ["id", "question", "answer", "image", "not_sure"]
    features = json.loads(table.schema.metadata[b"huggingface"])["info"]["features"]
    assert features["image"] == {"_type": "Image"}
    row = table.to_pylist()[0]
    assert row["id"] == "Collision_Level_1_0"
    assert row["answer"] in {"(A)", "(B)"}
    assert row["not_sure"] == "(C)"
    assert row["question"].endswith("Answer by (A) Yes, (B) No or (C) Not sure.")
    with Image.open(io.BytesIO(row["image"]["bytes"])) as picture:
        assert picture.size == (208, 120)


def test_the_card_names_the_configurations(made):
    card = (made / "README.md").read_text()
    assert card.startswith("---\n")
    for subset in ("collision", "physics", "compatibility"):
        assert f"- config_name: {subset}\n" in card
        assert f"path: {subset}/test-*" in card


def test_truth_folders_are_complete(made):
    folders = list(made.glob("truth/*/*"))
    assert len(folders) == 3
    for folder in folders:
        pictures = {"image.jpg", "clean.jpg", "background.jpg", "ids.png", "depth.png"}
        assert {p.name for p in folder.iterdir()} == pictures | {"future_12.jpg", "future_36.jpg", "meta.json"}
        assert json.loads((folder / "meta.json").read_text())["id"] == folder.name
        with Image.open(folder / "ids.png") as ids, Image.open(folder / "depth.png") as depth:
            assert (ids.mode, depth.mode) == ("L", "I;16")


def test_a_killed_run_goes_on_and_gives_the_same_bytes(made, tmp_path):
    folder = tmp_path / "set"
    call = [str(COMMAND), "make", "--out", str(folder), "--count", "3", *TINY]
    process = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    end = time.monotonic() + 60
    while not list(folder.glob("truth/*/*_Level_*")) and time.monotonic() < end:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (folder / "manifest.json").exists()
    before = {p: p.stat().st_mtime_ns for p in folder.glob("truth/*/[A-Z]*/meta.json")}
    assert scenes("make", "--out", folder, "--count", 3, *TINY, "--processes", 2).returncode == 0
    assert digests(folder) == digests(made)
    assert all(p.stat().st_mtime_ns == told for p, told in before.items())


def test_a_crash_costs_its_item_only(tmp_path):
    folder = tmp_path / "set"
    call = ["make", "--out", folder, "--count", 3, *TINY]
    done = scenes(*call, COW_SCENES_CRASH="Physics_Level_1_0")
    assert done.returncode == 1
    assert "Physics_Level_1_0 (its process ended with code 3)" in " ".join(done.stderr.split())
    assert len(list(folder.glob("truth/*/[A-Z]*"))) == 2
    assert scenes(*call).returncode == 0


def test_check_passes_and_finds_what_was_changed(made, tmp_path):
    done = scenes("check", made)
    assert done.returncode == 0, done.stderr
    assert "3 items, no problem" in done.stdout
    copy = tmp_path / "copy"
    subprocess.run(["cp", "-r", str(made), str(copy)], check=True)
    path = next(copy.glob("truth/collision/*/meta.json"))
    meta = json.loads(path.read_text())
    path.write_text(json.dumps({**meta, "answer": "A" if meta["answer"] == "B" else "B"}))
    done = scenes("check", copy)
    assert done.returncode == 1
    for text in ("the answer differs", "the answer contradicts the motion", "its SHA-256 differs"):
        assert text in done.stderr
    path.with_name("depth.png").unlink()
    done = scenes("check", copy)
    assert done.returncode == 1
    assert "depth.png missing" in done.stderr


def test_check_finds_objects_without_depth(made, tmp_path):
    copy = tmp_path / "copy"
    subprocess.run(["cp", "-r", str(made), str(copy)], check=True)
    path = next(copy.glob("truth/collision/*/depth.png"))
    Image.fromarray(np.zeros((120, 208), np.uint16)).save(path)
    assert "depth.png is 0 at" in scenes("check", copy).stderr
    Image.new("L", (208, 120), 5).save(path)
    assert "not 16-bit grey" in scenes("check", copy).stderr


def test_a_set_of_format_1_needs_no_depth(made, tmp_path):
    copy = tmp_path / "copy"
    subprocess.run(["cp", "-r", str(made), str(copy)], check=True)
    manifest = json.loads((copy / "manifest.json").read_text())
    for path in (*copy.glob("truth/*/*/depth.png"), *copy.glob("truth/*/*/background.jpg")):
        path.unlink()
        del manifest["files"][str(path.relative_to(copy))]
    (copy / "manifest.json").write_text(json.dumps({**manifest, "format": 1}))
    done = scenes("check", copy)
    assert done.returncode == 0, done.stderr
    (copy / "manifest.json").write_text(json.dumps({**manifest, "format": 99}))
    assert "has format 99" in scenes("check", copy).stderr


@pytest.mark.parametrize("end", ["tar.zst", "zip"])
def test_packing_gives_the_same_bytes(made, tmp_path, end):
    files = [tmp_path / f"{n}.{end}" for n in "ab"]
    for file in files:
        assert scenes("pack", made, file).returncode == 0
    assert files[0].read_bytes() == files[1].read_bytes()


def test_bad_use_gives_code_2_and_one_line(made, tmp_path):
    calls = (
        ["make", "--out", tmp_path / "x", "--count", "0"],
        ["make", "--out", tmp_path / "x", "--task", "chess"],
        ["make", "--out", tmp_path / "x", "--processes", "0"],
        ["make", "--out", tmp_path / "x", "--width", "wide"],
        ["make", "--out", made, "--count", "3", "--seed", "9"],
        ["make"],
        ["check", tmp_path],
        ["pack", made, tmp_path / "x.rar"],
        ["pack", made, tmp_path / "x.zip", "--limit-mb", "0.001"],
    )
    for call in calls:
        done = scenes(*call)
        assert done.returncode == 2, call
        assert done.stderr.startswith("error: "), call
        assert len(done.stderr.strip().splitlines()) == 1, done.stderr
