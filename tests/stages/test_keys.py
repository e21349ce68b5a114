"""What decides the key under which a stage's result is kept, and what does not."""

from __future__ import annotations

from typing import Any

import pytest

from cow_service.requests import AnswerRequest
from cow_service.stages.keys import KEY_FIELDS, StageKey, key_of

READ = ("gating", "baseline", "grounding", "motion", "answering")
GIVEN = {"grounding": {"point": (200, 200)}, "motion": {"kind": "fall"}}
PATH = {"trajectory": {"points": [(200, 200), (300, 200)]}}
# A change of a request, and the stages that it decides where all is left to the reader, and where all is given.
DECIDE: dict[str, tuple[dict[str, Any], str, str]] = {
    "question": (
        {"question": "b"},
        "gating baseline grounding motion answering",
        "gating baseline grounding motion answering",
    ),
    "seed": (
        {"seed": 1},
        "gating baseline grounding motion generation answering",
        "gating baseline generation answering",
    ),
    "asked": ({"asked": {"relation": "touches", "target": "cube"}}, "grounding", "grounding"),
    "objects": ({"objects": [{"object": "mug", "bbox": [0, 0, 90, 90]}]}, "grounding", "grounding"),
    "objects_complete": ({"objects_complete": True}, "grounding trajectory", "grounding trajectory"),
    "interventions": ({"interventions": [{"kind": "remove", "object": "mug"}]}, "grounding", "grounding"),
    "law": ({"motion": {"kind": "fall", "law": "ballistic"}}, "grounding motion trajectory", "motion trajectory"),
    "path": (PATH, "grounding motion trajectory", "motion trajectory"),
    "camera": ({"camera": {"pitch": 20}}, "motion trajectory", "motion trajectory"),
    "ensemble": ({"ensemble": 0}, "trajectory", "trajectory"),
    "num_frames": ({"num_frames": 9}, "trajectory", "trajectory"),
    "live": ({"live": True}, "trajectory", "trajectory"),
    "frames": ({"frames": {"count": 2}}, "generation", "generation"),
    "votes": ({"votes": 3, "baseline": True}, "baseline answering", "baseline answering"),
    "options": ({"options": ["a", "b"], "language": "de"}, "gating baseline answering", "gating baseline answering"),
}


def key(
    stage: Any = "generation", inputs: Any = (), reader: str | None = "", repeats: bool = True, heeds_seed: bool = True,
    **request: Any,
) -> StageKey:  # fmt: skip
    def identity(role: str) -> dict[str, str] | None:
        return None if reader is None else {"name": role + reader}

    asked = AnswerRequest.model_validate({"image": {"artifact": "0" * 64}, "question": "?"} | request)
    return key_of(stage, "0" * 64, asked, inputs, identity, lambda votes: repeats, lambda: heeds_seed)


@pytest.mark.parametrize("name", DECIDE)
def test_a_change_of_the_request_decides_these_stages_and_no_others(name: str) -> None:
    change, *expected = DECIDE[name]
    for base, stages in zip(({}, GIVEN), expected, strict=True):
        decided = [stage for stage in KEY_FIELDS if key(stage, **base | change) != key(stage, **base)]
        assert decided == stages.split()


def test_what_came_before_and_the_reader_decide_where_the_request_does_not_say_it() -> None:
    assert key(inputs=(None,)) != key()
    for stage in KEY_FIELDS:
        is_read = stage in (*READ, "generation")
        assert (key(stage, reader="2") != key(stage)) == is_read
        assert (key(stage, reader="2", **GIVEN) != key(stage, **GIVEN)) == (is_read and stage not in GIVEN)
        assert (key(stage, reader=None).shareable, key(stage).shareable) == (not is_read, True)
        assert key(stage, repeats=False).shareable == (stage not in ("gating", "baseline", "answering")), (
            "sampled answers are not"
        )


def test_the_seed_decides_where_the_reader_heeds_it() -> None:
    for stage in READ:
        assert key(stage, seed=1) != key(stage, seed=2)
        rules, same = (key(stage, seed=seed, heeds_seed=False) for seed in (1, 2))
        assert rules == same != key(stage, heeds_seed=False, question="another")


def test_the_motion_that_a_request_gives_leaves_its_law_to_the_key() -> None:
    ballistic = {"motion": {"law": "ballistic"}}
    assert key("motion", **ballistic) != key("motion", question="b", **ballistic), "the reader is asked for the rest"
    assert key("motion", **ballistic, **PATH) != key("motion", **PATH)


def test_a_point_given_beside_a_path_is_not_a_path_alone() -> None:
    point = {"grounding": GIVEN["grounding"]}
    assert key("grounding", **point, **PATH) == key("grounding", **PATH)
    assert key("trajectory", **point, **PATH) != key("trajectory", **PATH)


def test_a_place_read_together_with_the_motion_is_one_read_alone() -> None:
    fall = {"motion": GIVEN["motion"]}
    both, alone = key("grounding"), key("grounding", **fall)
    assert both.digest != alone.digest
    assert (both.also, alone.also) == ((), (both.digest,))
    assert key("grounding", **fall, seed=1).also != alone.also
    assert key("grounding", **GIVEN).also == key("motion", grounding=GIVEN["grounding"]).also == ()
