"""Stage 3: what the mover and everything it meets do over the clip, and how sure that is."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.narration import facts_of, facts_of_both, warnings_of
from cow_service.physics.ensemble import EnsembleResult, run_ensemble
from cow_service.records import CLEAR, BBox, Doubt, Grounding, Motion, Outcome, Trajectory
from cow_service.requests import SimulateRequest
from cow_service.stages.grounding import others_of, removed_of
from cow_service.stages.keys import StageResult
from cow_service.stages.paths import record_trajectory
from cow_service.stages.reconstruction import Situation, reconstruct
from cow_service.stages.run import Run
from cow_service.vision.masks import iou

FEW_WORLDS = 0.2  # share of the worlds: what is touched in no more of them turns no answer that is clear


def compute_trajectory(run: Run[SimulateRequest], grounding: Grounding, motion: Motion) -> StageResult[Trajectory]:
    """The world over the whole clip; a path from the request is followed through everything."""
    with run.cpu():
        scene = run.scene_of(grounding, motion.cue)
        trajectory = simulate_world(Situation.of(scene, grounding, motion, run.request))
    return StageResult(value=trajectory, warnings=warnings_of(run.request, grounding, trajectory))


def simulate_world(situation: Situation) -> Trajectory:
    """What happens over the frames of the clip, and beside it what happens in the scene as it is.

    Simulates what the mover and everything it meets do, many times, within what the picture leaves open.
    """
    world, query, path = reconstruct(situation)
    results = [check_outlines(situation, each) for each in run_ensemble(world, query, situation.request.ensemble)]
    outcomes = [judge(situation.grounding, each) for each in results]
    trajectories = [
        record_trajectory(situation, result, outcome, path) for result, outcome in zip(results, outcomes, strict=True)
    ]
    # What was located, by whomever, is there: it may be pale, but it is no doubt.
    known = [body.bbox for body in (*results[0].world.bodies, *results[0].world.removed)]
    faint = [box for box in situation.scene.faint if not any(is_inside(box, each) for each in known)]
    trajectories = [add_faint(faint, each) for each in trajectories]
    first, *as_it_is = add_facts(situation, trajectories)
    factual = as_it_is[0].model_copy(update={"anchors": ()}) if as_it_is else None
    return first.model_copy(update={"factual": factual})


def is_inside(box: BBox, other: BBox) -> bool:
    """Whether the middle of a box lies in another one."""
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    return other[0] < x < other[2] and other[1] < y < other[3]


def add_faint(faint: Sequence[BBox], trajectory: Trajectory) -> Trajectory:
    """The trajectory with what may be things, and with an outcome that is not sure where it moves over one."""
    outcome = trajectory.outcome
    (x0, y0, x1, y1), (x, y) = trajectory.bodies[0].bbox, trajectory.path.points[0]
    swept = [(x0 + px - x, y0 + py - y, x1 + px - x, y1 + py - y) for px, py in trajectory.path.points]
    if outcome is not None and any(iou(box, each) > 0 for box in swept for each in faint):
        outcome = outcome.model_copy(
            update={"sure": False, "robust": False, "depends_on": ("faint", *outcome.depends_on)}
        )
    return trajectory.model_copy(update={"faint": tuple(faint), "outcome": outcome})


def add_facts(situation: Situation, trajectories: Sequence[Trajectory]) -> list[Trajectory]:
    """The trajectories with their outcomes in words; of two, the first one's words compare both."""
    grounding = situation.grounding
    if grounding.asked is None:
        return list(trajectories)
    facts = [facts_of(grounding.object, each) for each in trajectories]
    if len(trajectories) > 1:
        changes = tuple(each for each in grounding.interventions if each is not situation.carried)
        facts[0] = facts_of_both(changes, grounding.object, *trajectories)
    outcomes = [
        each.outcome and each.outcome.model_copy(update={"facts": said})
        for each, said in zip(trajectories, facts, strict=True)
    ]
    return [each.model_copy(update={"outcome": outcome}) for each, outcome in zip(trajectories, outcomes, strict=True)]


def judge(grounding: Grounding, result: EnsembleResult) -> Outcome | None:
    """What the worlds say to what is asked, if anything is; without a probability where they cannot tell.

    However the worlds agree, nothing is sure of a thing that may be another one than the question means, nor where a
    thing that matters was not seen clearly.
    """
    asked = grounding.asked
    if asked is None:
        return None
    query, names = result.query, [body.name for body in (*result.world.bodies, *result.world.removed)]
    outcome = Outcome(
        asked=asked if query is None else query.asked,
        subject=None if query is None or not query.subject else names[query.subject],
        object=None if query is None or query.target is None else names[query.target],
        sure=False,
        robust=False,
    )
    if result.decided is None:
        return outcome
    first = None if result.decided.first is None else names[result.decided.first]
    decided = vars(result.decided) | {"first": first}
    doubts: list[Doubt] = []
    if any(thing.is_doubtful for thing in (grounding, *others_of(grounding), *removed_of(grounding))):
        doubts.append("identity")
    if any(result.world.bodies[body].confidence < CLEAR for body in bodies_that_matter(result)):
        doubts.append("outline")
    if doubts:
        decided |= {"sure": False, "robust": False, "depends_on": (*doubts, *result.decided.depends_on)}
    return outcome.model_copy(update=decided)


def check_outlines(situation: Situation, result: EnsembleResult) -> EnsembleResult:
    """The result with the bodies that matter as sure as their outlines are: doubtful ones are cut out a second time."""
    bodies = list(result.world.bodies)
    for body in bodies_that_matter(result):
        bodies[body] = replace(bodies[body], confidence=situation.scene.confidence_of(bodies[body].bbox))
    return replace(result, world=replace(result.world, bodies=tuple(bodies)))


def bodies_that_matter(result: EnsembleResult) -> list[int]:
    """The mover, what is asked about, and what the mover touches before that in more than a few worlds."""
    query, count = result.query, len(result.world.bodies)
    meant = {0} if query is None else {0, query.subject, query.target}
    if result.ensemble is None:
        return [i for i in range(count) if i in meant]
    touches = result.ensemble.events.of[0].times["touches"]
    # Of what is struck by something else in turn, what comes first is not told here.
    target = None if query is None or query.subject or query.asked.relation != "touches" else query.target
    # What was removed, numbered after the bodies, is never met.
    before = touches[:, target] if target is not None and target < count else np.full(len(touches), np.inf)
    return [i for i in range(count) if i in meant or float(np.mean(touches[:, i] < before)) > FEW_WORLDS]
