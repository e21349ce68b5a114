"""Data sets as they are found: the published layout with its flaws, scenes, tables, and what is wrong with files."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import EXAMPLES, ROOT
from drawn import png_bytes
from hub import Blob, running
from hypothesis import given
from hypothesis import strategies as st

from cow_service.errors import InvalidRequest
from cow_service.evals.asking import order_of
from cow_service.evals.items import Pictures, appended_wording, listed_wording, question_text
from cow_service.evals.loaders import load
from cow_service.evals.loaders.rows import Collected
from cow_service.readers.options import split_options

pytestmark = pytest.mark.slow

SAMPLE = ROOT / "cow-scenes" / "sample"
ASKED = "If it moves forward, will it hit the vase? Answer by (A) Yes, (B) No or (C) Not sure."
WITHOUT_ABSTAIN = "What will be hidden when it has passed? (A) The red cup, (B) the mug or (C) the ball."
# Rows of the published subsets, and their flaws: see the docstring of `causalspatial`.
ROWS = {"collision": 826, "physics": 311, "compatibility": 99, "occlusion": 189, "realworld": 116}
SHARED_ID, NO_ABSTAIN, NO_ABSTAIN_C_RIGHT = 192, 54, 11


def picture(number: int) -> bytes:
    """A picture of its own for every number."""
    pixels = np.zeros((16, 16, 3), np.uint8)
    pixels[0, :, 0] = [255 * (number >> bit & 1) for bit in range(16)]
    return png_bytes(pixels)


@pytest.fixture
def pictures(tmp_path: Path) -> Pictures:
    return Pictures(tmp_path / "pictures")


def published(folder: Path) -> Path:
    """A folder in the published layout: as many rows, with the same flaws, in shards of 300."""
    number = 0
    for subset, count in ROWS.items():
        rows: list[dict[str, Any]] = []
        for place in range(count):
            number += 1
            rows.append(row_of(subset, place, number))
        for shard, begin in enumerate(range(0, count, 300)):
            path = folder / subset / f"train-{shard:05}.parquet"
            path.parent.mkdir(parents=True, exist_ok=True)
            pq.write_table(pa.Table.from_pylist(rows[begin : begin + 300]), path)
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


def test_of_the_published_data_no_row_is_lost_and_no_id_collides(found: Collected) -> None:
    assert len(found.items) == sum(ROWS.values()) - 1
    assert len({item.id for item in found.items}) == len(found.items)
    by_subset = Counter(item.id.partition("/")[0] for item in found.items)
    assert by_subset == {**ROWS, "compatibility": ROWS["compatibility"] - 1}
    assert {item.level for item in found.items if not item.id.startswith("realworld")} == {"L1", "L2"}
    assert {(item.task, item.level) for item in found.items if item.id.startswith("realworld")} == {
        (task, "real") for task in ("collision", "occlusion", "compatibility", "trajectory")
    }
    assert {item.task for item in found.items if item.id.startswith("physics")} == {"trajectory"}


def test_the_flaws_of_the_published_data_are_counted_and_named(found: Collected) -> None:
    (fault,) = found.faults
    assert fault.startswith("compatibility/train-00000.parquet, row 7: the image cannot be used")
    told = " ".join(found.notes)
    assert f"physics: {SHARED_ID} rows share their id" in told
    assert f"occlusion: {NO_ABSTAIN} rows have no option that abstains" in told
    assert f"in {NO_ABSTAIN_C_RIGHT} of them that option is the right answer" in told


def test_the_option_that_abstains_is_found_by_its_text(found: Collected) -> None:
    without = [item for item in found.items if item.abstain is None]
    assert sum(item.id.startswith("occlusion") for item in without) == NO_ABSTAIN
    right = [item for item in without if item.id.startswith("occlusion") and item.answer == "C"]
    assert len(right) == NO_ABSTAIN_C_RIGHT
    (first,) = (item for item in found.items if item.id == "collision/0/0")
    assert (first.abstain, first.answer, question_text(first)) == ("C", "A", ASKED)


def test_answers_given_as_text_get_their_letter(found: Collected) -> None:
    real = {item.source_id: item for item in found.items if item.id.startswith("realworld")}
    assert question_text(real["1"]) == "What will it hit?\n\n(A) Yes\n(B) No"
    assert (real["1"].answer, real["1"].abstain) == ("B", None)
    assert (real["2"].answer, real["2"].abstain) == ("C", "C")


def test_subsets_are_chosen_and_unknown_ones_refused(tmp_path: Path, pictures: Pictures) -> None:
    pq.write_table(pa.Table.from_pylist([row_of("occlusion", 60, 1)]), file_in(tmp_path / "occlusion"))
    pq.write_table(pa.Table.from_pylist([row_of("collision", 1, 2)]), file_in(tmp_path / "collision"))
    assert [item.task for item in load(str(tmp_path), pictures, subsets=["occlusion"]).items] == ["occlusion"]
    with pytest.raises(InvalidRequest, match="no subset 'fysics'"):
        load(str(tmp_path), pictures, subsets=["fysics"])


def file_in(folder: Path) -> Path:
    folder.mkdir()
    return folder / "train.parquet"


def test_made_scenes_have_their_truth_and_both_levels(pictures: Pictures) -> None:
    items = load(str(SAMPLE), pictures).items
    assert len(items) == 12
    for item in items:
        assert item.truth is not None
        assert [moment for moment, _ in item.truth.pictures] == [0.4, 1.2]
        assert (len(item.truth.track), len(item.truth.scale), item.truth.scale[0]) == (61, 61, 1.0)
        assert item.truth.object in item.truth.boxes
    assert {item.level for item in items} == {"L1", "L2"}
    assert {item.task for item in items} == {"collision", "trajectory", "compatibility", "occlusion"}


def test_scenes_of_the_second_family_are_read_alike(pictures: Pictures) -> None:
    items = load(str(ROOT / "cow-scenes" / "sample_other"), pictures).items
    assert len(items) == 10
    assert all(item.truth is not None and item.truth.shows(drawn=True) for item in items)
    assert {item.task for item in items} == {"collision", "trajectory", "compatibility", "occlusion"}


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
        pq.write_table(pa.Table.from_pylist([{**ROW, "image": {"bytes": image, "path": None}}]), path)
    return path


@pytest.mark.parametrize("form", ["jsonl", "batch.jsonl", "csv", "tsv", "parquet"])
def test_tables_of_every_form_hold_the_same_question(form: str, tmp_path: Path, pictures: Pictures) -> None:
    (item,) = load(str(written(tmp_path, form)), pictures).items
    assert (item.id, item.task, item.answer, item.abstain) == ("q1", "collision", "B", "C")
    assert pictures.read(item.image) == picture(1)
    assert [option.text for option in item.options] == ["Yes", "No", "Not sure"]
    assert question_text(item).startswith("If it moves forward, will it hit the vase?")


FAULTS: dict[str, tuple[str, str]] = {
    "missing image": (
        json.dumps({**ROW, "image": "2.png"}),
        r"line 2: the image '2.png' is not there: a path starts at the folder",
    ),
    "no image": (json.dumps(ROW), "line 2: has no `image`"),
    "an address": (json.dumps({**ROW, "image": "http://x/1.png"}), "line 2: `image` must not be an address"),
    "no picture": (json.dumps({**ROW, "image": base64.b64encode(b"no").decode()}), "line 2: the image cannot be used"),
    "unknown column": (json.dumps({**ROW, "image": "1.png", "anwser": "A"}), "column `anwser`: did you mean `answer`"),
    "no such option": (json.dumps({**ROW, "image": "1.png", "answer": "D"}), "not one of the options: 'D'"),
    "other text": (json.dumps({**ROW, "image": "1.png", "answer": "(A) No"}), r"not one of the options: '\(A\) No'"),
    "the same id": (json.dumps({**ROW, "image": "1.png", "question": "Other? (A) a (B) b"}), "the id 'q1' stands in"),
    "the same row": (
        json.dumps({**ROW, "id": "q2", "image": "1.png"}),
        "line 2: asks the same as questions.jsonl, line 1",
    ),
    "another answer": (
        json.dumps({**ROW, "id": "q2", "image": "1.png", "answer": "A"}),
        r"asks the same as questions.jsonl, line 1 with another answer, \(B\)",
    ),
    "no options": (json.dumps({**ROW, "id": "q2", "image": "1.png", "question": "What?"}), "lists no options"),
    "half a line": (json.dumps({**ROW, "image": "1.png"})[:30], "line 2: not complete JSON .* was the file written"),
    "no object": ("[1]", "line 2: must be an object, got list"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_cannot_be_asked_is_named_by_its_row_or_left_out(fault: str, tmp_path: Path, pictures: Pictures) -> None:
    line, message = FAULTS[fault]
    path = written(tmp_path, "jsonl")
    path.write_text(path.read_text().strip() + "\n" + line)
    with pytest.raises(InvalidRequest, match=message):
        load(str(path), pictures)
    found = load(str(path), pictures, skip_faulty=True)
    assert [item.id for item in found.items][:1] == ["q1"]
    assert fault == "unknown column" or len(found.faults) == 1


def test_files_that_were_not_written_to_their_end_are_named(tmp_path: Path, pictures: Pictures) -> None:
    for form, message in (("csv", "row 2: has 3 cells for 6 columns"), ("parquet", "not a complete Parquet file")):
        path = written(tmp_path, form)
        path.write_bytes(path.read_bytes()[: path.stat().st_size // (2 if form == "csv" else 3)])
        if form == "csv":
            path.write_text("id,image,question,answer,task,level\nq1,1.png,What")
        with pytest.raises(InvalidRequest, match=message):
            load(str(path), pictures)
    scene = tmp_path / "scenes" / "one"
    scene.mkdir(parents=True)
    (scene / "meta.json").write_text('{"question": "Wil')
    with pytest.raises(InvalidRequest, match=r"one/meta.json: not complete JSON"):
        load(str(scene.parent), pictures)


def test_a_data_set_of_the_hub_is_downloaded_and_read(tmp_path: Path) -> None:
    pq.write_table(pa.Table.from_pylist([row_of("occlusion", 60, 1)]), file_in(tmp_path / "occlusion"))
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
    assert "The data set 'someone/nothing' is not a folder, and could not be downloaded" in unknown.stderr


def test_a_shard_that_was_cut_off_is_refused_always(tmp_path: Path, pictures: Pictures) -> None:
    """Rows of the published layout with other faults are left out: here it is unknown how many are missing."""
    for subset in ("collision", "occlusion"):
        pq.write_table(pa.Table.from_pylist([row_of(subset, 60, 1)]), file_in(tmp_path / subset))
    shard = tmp_path / "collision" / "train.parquet"
    shard.write_bytes(shard.read_bytes()[:-20])
    for skip_faulty in (False, True):
        with pytest.raises(InvalidRequest, match=r"collision/train.parquet: not a complete Parquet file"):
            load(str(tmp_path), pictures, skip_faulty=skip_faulty)
    with pytest.raises(InvalidRequest, match="has no subset 'physics'"):
        load(str(tmp_path), pictures, subsets=["occlusion", "physics"])


def test_columns_of_options_leave_no_letter_out(tmp_path: Path, pictures: Pictures) -> None:
    path = written(tmp_path, "tsv")
    path.write_text(path.read_text().replace("\tNo\t", "\t\t"))
    with pytest.raises(InvalidRequest, match="row 2: the options A, C leave a letter out"):
        load(str(path), pictures)


@pytest.mark.parametrize("data", ["nothing/here/at-all", "README.md"])
def test_what_is_no_data_set_is_refused_with_what_is_one(data: str, pictures: Pictures) -> None:
    with pytest.raises(InvalidRequest, match="CausalSpatial's layout"):
        load(str(ROOT / data), pictures)


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
    items = load(str(EXAMPLES), pictures).items
    orders = [order_of(item, "shuffled", 0, repeat) for item in items for repeat in range(1, 13)]
    assert len(set(orders)) == 6
    assert all(len(set(orders[12 * place : 12 * place + 6])) == 6 for place in range(len(items))), "all, then again"
    assert orders == [order_of(item, "shuffled", 0, repeat) for item in items for repeat in range(1, 13)]
    assert orders != [order_of(item, "shuffled", 1, repeat) for item in items for repeat in range(1, 13)]
    assert {order_of(item, "data", 0, repeat) for item in items for repeat in (1, 2)} == {(0, 1, 2)}
