"""What the worlds say to the question, as records: of the world asked about and, where something is changed first, of
the scene as it is."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.physics.bodies import SeenBody
from cow_service.physics.outcome import KIND_OF, Decided, Query
from cow_service.readers.question.both_worlds import facts_of_both
from cow_service.readers.question.facts import facts_of
from cow_service.records import Asked, Grounding, Intervention, Outcome, Trajectory
from cow_service.stages.imagining import Imagined

BY_ENCOUNTERS = (*KIND_OF, "tips", "moves", "leaves", "lands")  # relations that encounters and paths decide


def can_tell(query: Query, present: int, placed: bool, on_floor: bool) -> bool:
    """Whether worlds can decide what is asked; what is taken away does nothing. `present` bodies are left; `placed`
    says whether something is put somewhere, `on_floor` whether what acts stands on the floor: it cannot land there."""
    by_paths = query.asked.relation in BY_ENCOUNTERS or (placed and query.asked.relation == "inside")
    return by_paths and query.subject < present and not (on_floor and query.asked.relation == "lands")


def with_outcomes(
    trajectories: Sequence[Trajectory],
    imagined: Sequence[Imagined],
    asked: Asked | None,
    query: Query | None,
    grounding: Grounding,
    changes: Sequence[Intervention],
) -> list[Trajectory]:
    """The trajectories with their outcomes and, in the first, the facts of them all in a sentence."""
    if asked is None:
        return list(trajectories)
    told: list[Trajectory] = []
    for trajectory, each in zip(trajectories, imagined, strict=True):
        bodies = (*each.given.bodies, *each.given.taken)
        asked_here = asked if each.query is None else each.query.asked
        outcome = _outcome(asked_here, query, bodies, each.decided)
        told.append(_with_facts(trajectory.model_copy(update={"outcome": outcome}), grounding))
    if len(told) > 1:
        told[0] = _with(told[0], facts_of_both(changes, grounding.object, *told))
    return told


def _outcome(asked: Asked, query: Query | None, bodies: Sequence[SeenBody], decided: Decided | None) -> Outcome:
    """Without a probability where the worlds cannot tell."""
    name = None if query is None or query.target is None else bodies[query.target].name
    subject = None if query is None or not query.subject else bodies[query.subject].name
    if decided is None:
        return Outcome(asked=asked, subject=subject, object=name, sure=False, robust=False)
    return Outcome(
        asked=asked,
        subject=subject,
        object=name,
        probability=decided.probability,
        first=None if decided.first is None else bodies[decided.first].name,
        count=decided.count,
        time=decided.time,
        time_band=decided.time_band,
        sure=decided.sure,
        robust=decided.robust,
        depends_on=decided.depends_on,
    )


def _with_facts(trajectory: Trajectory, grounding: Grounding) -> Trajectory:
    return _with(trajectory, facts_of(grounding.object, trajectory))


def _with(trajectory: Trajectory, facts: str) -> Trajectory:
    assert trajectory.outcome is not None
    return trajectory.model_copy(update={"outcome": trajectory.outcome.model_copy(update={"facts": facts})})
