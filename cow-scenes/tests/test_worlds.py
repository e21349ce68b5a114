import json
from collections import Counter
from pathlib import Path

import numpy as np

from cow_scenes.accept import CLEAR, COVERED
from cow_scenes.arrows import draw_style
from cow_scenes.check import expected_answer
from cow_scenes.forms import FORM_OF
from cow_scenes.maps import maps_of
from cow_scenes.meta import meta_of

EXAMPLES = Path(__file__).parents[2] / "examples"


def records(worlds):
    return [meta_of(w, draw_style(w.key.random("arrow"), w.draft.along) if w.draft.arrow else None) for w in worlds]


def test_every_form_occurs_and_answers_are_balanced(worlds):
    assert {w.draft.form for w in worlds} == set(FORM_OF)
    for task in {w.key.task for w in worlds}:
        answers = Counter(w.answer for w in worlds if w.key.task == task and len(w.draft.options) == 3)
        assert abs(answers[0] - answers[1]) <= 2


def test_the_answer_follows_from_the_record(worlds):
    for item, meta in zip(worlds, records(worlds), strict=True):
        assert meta["options"][ord(meta["answer"]) - ord("A")] == expected_answer(meta), item.key.id


def test_records_have_the_keys_of_the_existing_scenes(worlds):
    known = {key for path in EXAMPLES.glob("*/meta.json") for key in json.loads(path.read_text())}
    for meta in records(worlds):
        assert known <= meta.keys(), known - meta.keys()
        assert json.loads(json.dumps(meta)) == meta
        assert all(np.shape(boxes) == (61, 4) for boxes in meta["boxes"].values())
        assert all(np.shape(centres) == (61, 3) for centres in meta["world"].values())
        assert np.shape(meta["track"]) == (61, 2)
        assert abs(np.linalg.norm(meta["direction"]) - 1) < 1e-3
        assert meta["question"].endswith(f"or ({meta['not_sure']}) Not sure.")


def test_levels_differ_by_the_number_of_objects(worlds):
    for item in worlds:
        draft = item.draft
        needed = 2 + bool(draft.via) + bool(draft.world.removed)
        count = len(draft.world.things)
        assert count == needed if item.key.level == "L1" else count >= needed + 1, item.key.id


def test_everything_is_in_view_and_named_once(worlds):
    for item, meta in zip(worlds, records(worlds), strict=True):
        names = [t.name for t in item.draft.world.things]
        assert len(set(names)) == len(names)
        assert len({t.colour for t in item.draft.world.things}) == len(names)
        for boxes in meta["boxes"].values():
            left, top, right, bottom = boxes[0]
            assert left >= 0
            assert top >= 0
            assert right <= 832
            assert bottom <= 480


def test_ids_lie_in_their_boxes(worlds):
    for item, meta in list(zip(worlds, records(worlds), strict=True))[:12]:
        ids, _ = maps_of(item)
        assert list(meta["id_of"]) == [*meta["boxes"], *(["table"] if meta["table"] else [])]
        for name in meta["boxes"]:
            y, x = np.nonzero(ids == meta["id_of"][name])
            left, top, right, bottom = meta["boxes"][name][0]
            assert x.min() >= left - 1
            assert x.max() <= right + 1
            assert y.min() >= top - 1
            assert y.max() <= bottom + 1


def test_truth_has_margins(worlds):
    for item in worlds:
        if item.hidden is not None:
            assert item.hidden >= COVERED if item.answer == 0 else item.hidden <= CLEAR
        elif item.draft.form in {"slide", "car", "remove", "throw", "table", "trail"} and item.answer == 1:
            assert item.run.gaps[item.draft.target] >= 0.12
        if item.factual:
            assert item.factual.first(item.draft.world.mover, item.draft.world.removed) is not None
