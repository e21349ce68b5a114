"""Data sets as they are found: the published layout with its flaws, scenes, tables, and what is wrong with files."""

from __future__ import annotations

import base64
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import EXAMPLES, ROOT
from drawn import png_bytes
from hub import Blob, running
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused

from cow_service.evals.items import Item, Pictures, appended_wording, listed_wording, question_text
from cow_service.evals.loaders import load
from cow_service.evals.loaders.rows import Collected
from cow_service.readers.options import split_options

pytestmark = pytest.mark.slow

SAMPLE = ROOT / "cow-scenes" / "sample"
ASKED = "If it moves forward, will it hit the vase? Answer by (A) Yes, (B) No or (C) Not sure."
WITHOUT_ABSTAIN = "What will be hidden when it has passed? (A) The red cup, (B) the mug or (C) the ball."
# Rows of the published subsets, and their flaws: see the docstring of `causalspatial`.
ROWS = {"collision": 826, "physics": 311, "compatibility": 99, "occlusion": 189, "realworld": 116}
TASKS = {"collision", "trajectory", "compatibility", "occlusion"}
SHARED_ID, NO_ABSTAIN, NO_ABSTAIN_C_RIGHT = 192, 54, 11


def picture(number: int) -> bytes:
    """A picture of its own for every number."""
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[0, :, 0] = [255 * (number >> bit & 1) for bit in range(16)]
    return png_bytes(pixels)


@pytest.fixture
def pictures(tmp_path: Path) -> Pictures:
    return Pictures(tmp_path / "pictures")


def write_parquet(path: Path, *rows: dict[str, Any]) -> None:
    import pyarrow
    from pyarrow import parquet

    path.parent.mkdir(parents=True, exist_ok=True)
    parquet.write_table(pyarrow.Table.from_pylist(rows), path)


def published(folder: Path) -> Path:
    """A folder in the published layout: as many rows, with the same flaws, in shards of 300."""
    number = 0
    for subset, count in ROWS.items():
        rows = [row_of(subset, place, number + place + 1) for place in range(count)]
        number += count
        for shard, begin in enumerate(range(0, count, 300)):
            write_parquet(folder / subset / f"train-{shard:05}.parquet", *rows[begin : begin + 300])
    return folder


def row_of(subset: str, place: int, number: int) -> dict[str, Any]:
    image = {"bytes": picture(number), "path": f"{place}.png"}
    if subset == "realworld":
        kinds = ("collision", "occlusion", "compatibility", "trajectory")
        options = ["Yes", "No"] if place % 2 else ["The cup", "The ball", "Not sure"]
        own = {"type": kinds[place % 4], "question": "What will it hit?", "options": options}
        return {"id": str(place), **own, "answer": options[place % len(options)], "image": image}
    level, name = 1 + place % 2, subset.capitalize()
    fields = {"id": f"{name}_Level_{level}_{place}", "question": ASKED, "answer": f"({'ABC'[place % 2]})"}
    fields |= {"image": image, "not_sure": "(C)"}
    if subset == "physics" and place < SHARED_ID:
        fields["id"] = "Physics_Level_1_0"
    if subset == "occlusion" and place < NO_ABSTAIN:
        fields |= {"question": WITHOUT_ABSTAIN, "answer": "(C)" if place < NO_ABSTAIN_C_RIGHT else "(A)"}
    if subset == "compatibility" and place == 7:
        fields["image"] = {"bytes": picture(number)[:40], "path": "7.png"}
    return fields


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Collected:
    folder = tmp_path_factory.mktemp("published")
    return load(str(published(folder)), Pictures(folder / "pictures"))


def test_of_the_published_data_no_row_is_lost_and_its_flaws_are_told(found: Collected) -> None:
    by_subset: dict[str, list[Item]] = {subset: [] for subset in ROWS}
    for item in found.items:
        by_subset[item.id.partition("/")[0]].append(item)
    assert len({item.id for item in found.items}) == len(found.items) == sum(ROWS.values()) - 1
    assert {name: len(items) for name, items in by_subset.items()} == ROWS | {"compatibility": 98}
    real = by_subset.pop("realworld")
    assert {item.level for items in by_subset.values() for item in items} == {"L1", "L2"}
    assert {(item.task, item.level) for item in real} == {(task, "real") for task in TASKS}
    assert {item.task for item in by_subset["physics"]} == {"trajectory"}

    (fault,) = found.faults
    assert fault.startswith("compatibility/train-00000.parquet, row 7: ")
    told = {note.partition(":")[0]: re.findall(r"\d+", note) for note in found.notes}
    assert told["physics"][0] == str(SHARED_ID)
    assert told["occlusion"] == [str(NO_ABSTAIN)]


def test_the_option_that_abstains_is_found_by_its_text_and_answers_get_their_letter(found: Collected) -> None:
    items = {item.id: item for item in found.items}
    without = [item for item in items.values() if item.abstain is None and item.id.startswith("occlusion")]
    assert (len(without), sum(item.answer == "C" for item in without)) == (NO_ABSTAIN, NO_ABSTAIN_C_RIGHT)
    first = items["collision/0/0"]
    assert (first.abstain, first.answer, question_text(first)) == ("C", "A", ASKED)
    real = {item.source_id: item for item in items.values() if item.id.startswith("realworld")}
    assert question_text(real["1"]) == "What will it hit?\n\n(A) Yes\n(B) No"
    assert (real["1"].answer, real["1"].abstain) == ("B", None)
    assert (real["2"].answer, real["2"].abstain) == ("C", "C")


def test_subsets_are_chosen_and_unknown_ones_and_cut_shards_refused(tmp_path: Path, pictures: Pictures) -> None:
    """Rows of the published layout with other faults are left out: of a shard it is unknown how many are missing."""
    for subset in ("collision", "occlusion"):
        write_parquet(tmp_path / subset / "train.parquet", row_of(subset, 60, 1))
    assert [item.task for item in load(str(tmp_path), pictures, subsets=["occlusion"]).items] == ["occlusion"]
    for subsets in (["fysics"], ["occlusion", "physics"]):
        with refused("invalid-request") as caught:
            load(str(tmp_path), pictures, subsets=subsets)
        assert subsets[-1] in str(caught.value)
    shard = tmp_path / "collision" / "train.parquet"
    shard.write_bytes(shard.read_bytes()[:-20])
    for skip_faulty in (False, True):
        with refused("invalid-request") as caught:
            load(str(tmp_path), pictures, skip_faulty=skip_faulty)
        assert "collision/train.parquet" in str(caught.value)


def test_made_scenes_have_their_truth_and_both_levels(pictures: Pictures) -> None:
    items = load(str(SAMPLE), pictures).items
    others = load(str(ROOT / "cow-scenes" / "sample_other"), pictures).items  # of the second family
    assert (len(items), len(others)) == (12, 10)
    for item in items:
        assert item.truth is not None
        assert [moment for moment, _ in item.truth.pictures] == [0.4, 1.2]
        assert (len(item.truth.track), len(item.truth.scale), item.truth.scale[0]) == (61, 61, 1.0)
        assert item.truth.object in item.truth.boxes
    assert {item.level for item in items} == {"L1", "L2"}
    assert all(item.truth is not None and item.truth.is_shown for item in others)
    assert {item.task for item in items} == {item.task for item in others} == TASKS


def test_scenes_with_truth_are_read(pictures: Pictures) -> None:
    items = {item.scene: item for item in load(str(EXAMPLES), pictures).items}
    assert len(items) == len(list(EXAMPLES.glob("*/meta.json")))
    mug = items["ball-and-mug"]
    assert (mug.id, mug.task, mug.level, mug.answer, mug.abstain) == ("collision_108", "collision", "L1", "A", "C")
    assert pictures.read(mug.image) == (EXAMPLES / "ball-and-mug" / "image.jpg").read_bytes()


ROW: dict[str, Any] = {"id": "q1", "question": ASKED, "answer": "B", "task": "collision", "level": "L2"}


def written(folder: Path, form: str) -> Path:
    """The same question in a file of each form."""
    image = picture(1)
    (folder / "1.png").write_bytes(image)
    path = folder / f"questions.{form}"
    coded = base64.b64encode(image).decode()
    if form == "jsonl":
        path.write_text(json.dumps({**ROW, "image": "1.png"}) + "\n\n")
    elif form == "batch.jsonl":  # as `cow batch` has them: the answer is copied to its result
        row = {name: value for name, value in ROW.items() if name != "answer"}
        path.write_text(json.dumps({**row, "image": "1.png", "meta": {"answer": ROW["answer"]}}))
    elif form == "csv":
        path.write_text('id,image,question,answer,task,level\nq1,1.png,"' + ASKED + '",B,collision,L2\n')
    elif form == "tsv":  # as VLMEvalKit has them
        question = ASKED.partition(" Answer by")[0]
        head = "index\timage\tquestion\tA\tB\tC\tanswer\tcategory\tl2-category"
        path.write_text(f"{head}\nq1\t{coded}\t{question}\tYes\tNo\tNot sure\tB\tcollision\tx\n")
    else:
        write_parquet(path, {**ROW, "image": {"bytes": image, "path": None}})
    return path


@pytest.mark.parametrize("form", ["jsonl", "batch.jsonl", "csv", "tsv", "parquet"])
def test_tables_of_every_form_hold_the_same_question(form: str, tmp_path: Path, pictures: Pictures) -> None:
    (item,) = load(str(written(tmp_path, form)), pictures).items
    assert (item.id, item.task, item.answer, item.abstain) == ("q1", "collision", "B", "C")
    assert pictures.read(item.image) == picture(1)
    assert [option.text for option in item.options] == ["Yes", "No", "Not sure"]
    assert question_text(item).startswith("If it moves forward, will it hit the vase?")


# What is wrong with a second line, and what the refusal names besides the line.
FAULTS: dict[str, str | dict[str, Any]] = {
    "2.png": {"image": "2.png"},
    "`image`": {"image": None},
    "an address": {"image": "http://x/1.png"},
    "cannot be used": {"image": base64.b64encode(b"no").decode()},
    "`anwser`: did you mean `answer`": {"anwser": "A"},
    "'D'": {"answer": "D"},
    "'(A) No'": {"answer": "(A) No"},
    "'q1'": {"question": "Other? (A) a (B) b"},
    "questions.jsonl, line 1": {"id": "q2"},
    "(B)": {"id": "q2", "answer": "A"},
    "options": {"id": "q2", "question": "What?"},
    "JSON": json.dumps({**ROW, "image": "1.png"})[:30],
    "list": "[1]",
}


@pytest.mark.parametrize("named", FAULTS)
def test_what_cannot_be_asked_is_named_by_its_row_or_left_out(named: str, tmp_path: Path, pictures: Pictures) -> None:
    fault = FAULTS[named]
    line = fault if isinstance(fault, str) else json.dumps({**ROW, "image": "1.png", **fault})
    path = written(tmp_path, "jsonl")
    path.write_text(path.read_text().strip() + "\n" + line)
    with refused("invalid-request") as caught:
        load(str(path), pictures)
    assert named in str(caught.value)
    assert "line 2: " in str(caught.value) or "anwser" in named, "a column is of no line"
    found = load(str(path), pictures, skip_faulty=True)
    assert found.items[0].id == "q1"
    assert "anwser" in named or len(found.faults) == 1


def test_files_that_were_not_written_to_their_end_are_named(tmp_path: Path, pictures: Pictures) -> None:
    csv, tsv, parquet = (written(tmp_path, form) for form in ("csv", "tsv", "parquet"))
    csv.write_text("id,image,question,answer,task,level\nq1,1.png,What")
    tsv.write_text(tsv.read_text().replace("\tNo\t", "\t\t"))
    parquet.write_bytes(parquet.read_bytes()[: parquet.stat().st_size // 3])
    scene = tmp_path / "scenes" / "one" / "meta.json"
    scene.parent.mkdir(parents=True)
    scene.write_text('{"question": "Wil')
    named = {csv: "row 2: not as many cells as columns", tsv: "row 2: the options A, C", parquet: "Parquet"}
    for path, words in {**named, scene.parents[1]: "one/meta.json", ROOT / "README.md": "", tmp_path / "x": ""}.items():
        with refused("invalid-request") as caught:
            load(str(path), pictures)
        assert words in str(caught.value)


def test_a_data_set_of_the_hub_is_downloaded_and_read(tmp_path: Path) -> None:
    write_parquet(tmp_path / "occlusion" / "train.parquet", row_of("occlusion", 60, 1))
    shard = (tmp_path / "occlusion" / "train.parquet").read_bytes()
    program = (
        "import sys; from pathlib import Path; from cow_service.evals.loaders import load;"
        "from cow_service.evals.items import Pictures;"
        "print([item.id for item in load(sys.argv[1], Pictures(Path('pictures'))).items])"
    )
    with running() as one:
        one.commit("someone/questions", {"occlusion/train.parquet": Blob(shard), "weights.bin": Blob(b"large")})
        known = {**os.environ, "HF_ENDPOINT": one.address, "HF_HOME": str(tmp_path / "home"), "HF_HUB_DISABLE_XET": "1"}
        command = [sys.executable, "-c", program]
        done, unknown = (
            subprocess.run([*command, name], cwd=tmp_path, env=known, capture_output=True, text=True, check=False)
            for name in ("someone/questions", "someone/nothing")
        )
        assert done.stdout == "['occlusion/0/0']\n", done.stderr
        assert one.downloads() == ["occlusion/train.parquet"], "only what is read"
    assert "InvalidRequest" in unknown.stderr
    assert "'someone/nothing'" in unknown.stderr


WORDS = st.text(st.characters(categories=("L",)), min_size=2, max_size=8)


@given(st.lists(WORDS, min_size=2, max_size=5, unique_by=str.lower), st.randoms(use_true_random=False))
def test_options_are_shown_in_any_order_and_read_back(texts: list[str], draws: Any) -> None:
    letters = "ABCDE"[: len(texts)]
    listed = ", ".join(f"({letter}) {text}" for letter, text in zip(letters, texts, strict=True))
    wording = listed_wording(f"Which of them does it hit? Choose {listed}.")
    assert wording is not None
    for parts, options in (wording, appended_wording("Which of them does it hit?", texts)):
        assert [option.text for option in options] == texts
        order = list(range(len(texts)))
        draws.shuffle(order)
        shown = parts[0] + "".join(texts[place] + part for place, part in zip(order, parts[1:], strict=True))
        assert [text for _, text in split_options(shown).options] == [texts[place] for place in order]


def test_the_order_of_options_is_fixed_by_seed_item_and_repeat(pictures: Pictures) -> None:
    from cow_service.evals.asking import order_of

    items = load(str(EXAMPLES), pictures).items
    orders = [order_of(item, "shuffled", 0, repeat) for item in items for repeat in range(1, 13)]
    assert len(set(orders)) == 6
    assert all(len(set(orders[12 * place : 12 * place + 6])) == 6 for place in range(len(items))), "all, then again"
    assert orders == [order_of(item, "shuffled", 0, repeat) for item in items for repeat in range(1, 13)]
    assert orders != [order_of(item, "shuffled", 1, repeat) for item in items for repeat in range(1, 13)]
    assert {order_of(item, "data", 0, repeat) for item in items for repeat in (1, 2)} == {(0, 1, 2)}
