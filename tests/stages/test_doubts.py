"""No doubt stands beside a sure answer: whatever is in doubt of a situation, what it says is not sure."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any, get_args

import numpy as np
from drawn import block, floor
from hypothesis import given
from hypothesis import strategies as st
from runs import run_of

from cow_service.physics.ensemble import EnsembleResult, run_ensemble
from cow_service.records import Doubt, Grounding, LocatedObject, Motion, Outcome
from cow_service.stages.grounding import ground, look_again
from cow_service.stages.motion import settle_motion
from cow_service.stages.reconstruction import reconstruct
from cow_service.stages.seeing import Situation, see
from cow_service.stages.trajectory import judge

BALL, CUBE = (100.0, 240.0, 160.0, 300.0), (300.0, 220.0, 380.0, 300.0)


@cache
def situation() -> tuple[Situation, EnsembleResult]:
    """A block that moves to the right, and hits another one for sure."""
    image = block(block(floor(), (100, 240, 160, 300), (200, 40, 40)), (300, 220, 380, 300), (40, 60, 200))
    run = run_of(
        np.ascontiguousarray(image),
        grounding={"object": "red block", "bbox": BALL},
        objects=({"object": "blue block", "bbox": CUBE},),
        objects_complete=True,
        motion={"direction": (1.0, 0.0)},
        asked={"relation": "touches", "target": "blue block"},
    )
    grounding = ground(run).value
    found = see(run, look_again(run, grounding), grounding, settle_motion(run, grounding, None).value)
    world, query, _ = reconstruct(found)
    (result,) = run_ensemble(world, query, 15)
    return found, result


def judged(doubts: frozenset[str]) -> Outcome:
    found, result = situation()
    mover: dict[str, Any] = {"is_doubtful": "mover" in doubts, "question_is_doubtful": "question" in doubts}
    others = tuple(each.model_copy(update={"is_doubtful": "target" in doubts}) for each in found.grounding.others)
    rival = (0.0, 1.0) if "direction" in doubts else None
    doubted = replace(
        found,
        grounding=found.grounding.model_copy(update=mover | {"others": others}),
        motion=found.motion.model_copy(update={"other_direction": rival}),
    )
    confidence = 0.5 if "outline" in doubts else 1.0
    bodies = tuple(replace(body, confidence=confidence) for body in result.world.bodies)
    world = replace(result.world, bodies=bodies, faint=(CUBE,) if "unlisted" in doubts else ())
    outcome = judge(doubted, replace(result, world=world))
    assert outcome is not None
    return outcome


DOUBTS = {
    "mover": "identity", "target": "identity", "question": "reading", "direction": "reading", "outline": "outline",
    "unlisted": "faint",
}  # fmt: skip


@given(doubts=st.frozensets(st.sampled_from(sorted(DOUBTS))))
def test_nothing_is_sure_that_is_in_doubt(doubts: frozenset[str]) -> None:
    outcome = judged(doubts)
    assert outcome.sure is outcome.robust is (not doubts)
    assert {DOUBTS[each] for each in doubts} == set(outcome.depends_on) & set(DOUBTS.values())
    assert set(outcome.depends_on) <= set(get_args(Doubt))


def test_every_mark_of_a_doubt_is_one_of_those() -> None:
    """A new field that says that something is doubtful belongs into the table above."""
    marks = [name for kind in (Grounding, LocatedObject, Motion) for name in kind.model_fields if "doubtful" in name]
    assert sorted(marks) == ["is_doubtful", "is_doubtful", "question_is_doubtful"]
