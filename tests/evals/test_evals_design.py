"""Arms as points of factors, which of them are compared, and plans that are fixed before a run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import pytest
from asked_runs import info, item
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from refusals import refused

from cow_service.evals.design import MOMENTS, NAMED, PRESETS, Arm, arm_of, check_arms, primary, references
from cow_service.readers.mllm.contents import PLACEBOS, Content

if TYPE_CHECKING:
    from cow_service.evals.plan import RunInfo

DIGEST = "0" * 64


@st.composite
def arms(draw: st.DrawFn) -> Arm:
    content: Content = draw(st.sampled_from(get_args(Content)))
    fields: dict[str, Any] = {"content": content, "votes": draw(st.integers(1, 16)), "gate": draw(st.booleans())}
    if content not in ("none", "text"):
        fields |= {"frames": draw(st.sampled_from(MOMENTS)), "count": draw(st.integers(1, 64))}
        fields |= {"size": draw(st.integers(16, 8192)), "image": draw(st.booleans())}
    return Arm.model_validate(fields)


@given(arms())
def test_an_arm_is_read_from_its_name(arm: Arm) -> None:
    assert arm_of(arm.name) == arm


def test_names_are_short() -> None:
    assert {name: arm.name for name, arm in NAMED.items()} == {name: name for name in NAMED}
    assert arm_of("always:vote-3:initial").name == "always:initial:vote-3"
    assert arm_of("placebo-still:no-image").with_content("simulated").name == "frames-only"
    for wrong in (
        "sometimes",
        "always:initial:events",
        "content=still",
        "never:no-image",
        "always:vote-17",
    ):
        with refused("invalid-request"):
            arm_of(wrong)
    with pytest.raises(ValidationError):
        Arm(content="none", count=5)


def test_every_preset_can_be_asked_where_there_is_what_it_shows() -> None:
    items = [item(number, DIGEST, "collision", "L1") for number in (0, 3)]
    for preset in PRESETS.values():
        assert [arm.name for arm in check_arms(preset.arms, "prompt", items)] == list(preset.arms)
    for arms, among in ((["oracle"], items), (["placebo-item"], items[:1])):
        with refused("invalid-request"):  # without a true path; without another scene
            check_arms(arms, "prompt", among)


def test_arms_are_compared_with_what_differs_in_the_content_alone() -> None:
    asked = [arm_of(name) for name in PRESETS["controls"].arms]
    against = {arm.name: [each.name for each in references(arm, asked)] for arm in asked}
    assert against["always"] == ["never", "placebo-still", "placebo-direction", "placebo-item"]
    assert against["always:initial"] == ["never", "placebo-still:initial"], "the same frames"
    assert against["auto"] == ["never", "gate"], "as many calls"
    assert against["always:vote-3"] == ["never", "never:vote-3"]
    assert (against["placebo-still"], against["never"]) == (["never"], [])
    question = primary(asked)
    assert question is not None
    assert (question[0].name, {each.content for each in question[1]}) == ("always", set(PLACEBOS))
    assert primary([arm_of("never"), arm_of("always"), arm_of("placebo-still:initial")]) is None


def asked_of(*names: str, **changes: Any) -> RunInfo:
    items = [item(number, DIGEST, "collision", "L1") for number in range(6)]
    return info(names, 2, items).model_copy(update={"scenes": 2, **changes})


def test_a_plan_fixes_the_analysis_and_the_run_says_where_it_departs(tmp_path: Path) -> None:
    from cow_service.evals.plan import departures, describe, planned, read_plan

    before = asked_of("never", "always", "placebo-still")
    plan = planned(before, 0.024)
    assert (plan.primary, plan.placebos, plan.scenes_needed) == ("always", ("placebo-still",), 2726)
    told = describe(plan, {})
    assert "2,726 scenes show a gain of 2.4 points over each" in told
    assert "6 questions in 3 arms, asked 2 times: at most 36 calls with 108 pictures, and 6 simulations." in told
    (file := tmp_path / "plan.json").write_text(plan.model_dump_json())
    assert read_plan(file) == plan
    assert departures(before.model_copy(update={"plan": plan}), 0, 0) == []
    changes: dict[str, Any] = {"repeats": 1, "options": {"data": "x", "seed": 3}, "versions": {"cow-service": "0.2"}}
    other = asked_of("never", "always", "oracle", plan=plan, data_digest="1" * 64, **changes)
    assert departures(other, 4, 7) == [
        "--generator cutout, not None",
        "--seed None, not 3",
        "the questions, pictures or truths of 'questions.jsonl' (6 of them, not 6)",
        "arms that were planned and not asked: placebo-still",
        "--repeats 2, not 1",
        "4 questions failed",
        "7 questions were not asked yet",
        "cow-service 0.1, not 0.2",
    ]
    with refused("invalid-request"):  # it has no primary question
        planned(asked_of("never", "always"), 0.024)
    file.write_text("{}")
    with refused("invalid-request"):
        read_plan(file)


def test_the_digest_of_a_design_is_that_of_what_decides_replies() -> None:
    one = asked_of("never", "always")
    assert one.design_digest == one.model_copy(update={"created_at": "later", "versions": {"numpy": "9"}}).design_digest
    changes: list[dict[str, Any]] = [{"seed": 8}, {"repeats": 3}, {"order": "data"}, {"versions": {"prompts/x": "2"}}]
    digests = {one.model_copy(update=change).design_digest for change in changes}
    assert len(digests | {one.design_digest}) == 5
