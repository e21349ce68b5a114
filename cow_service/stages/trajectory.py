"""Stage 3: what the mover and everything it meets do over the clip, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cow_service.narration import doubts_of, facts_of, facts_of_both
from cow_service.physics.bodies import supports_of
from cow_service.physics.ensemble import EnsembleResult, run_ensemble
from cow_service.physics.layout import flies
from cow_service.physics.outcome import KIND_OF, Query
from cow_service.physics.world import WorldInput
from cow_service.records import Asked, Grounding, Motion, Outcome, Trajectory
from cow_service.requests import SimulateRequest
from cow_service.stages.grounding import placed_mover
from cow_service.stages.keys import StageResult
from cow_service.stages.paths import record_trajectory
from cow_service.stages.reconstruction import Situation, free_path, reconstruct
from cow_service.stages.run import Run

BY_ENCOUNTERS = (*KIND_OF, "tips", "moves", "leaves", "lands")  # relations that encounters and paths decide
OFF_CENTRE = 0.25  # of the object's size: a given path that begins further from its centre is remarked on


def compute_trajectory(run: Run[SimulateRequest], grounding: Grounding, motion: Motion) -> StageResult[Trajectory]:
    """The world over the whole clip; a path from the request is followed through everything."""
    with run.cpu():
        scene = run.scene_of(grounding, motion.cue)
        trajectory = simulate_world(Situation.of(scene, grounding, motion, run.request))
    return StageResult(value=trajectory, warnings=_warnings(run.request, grounding, trajectory))


def simulate_world(situation: Situation) -> Trajectory:
    """What happens over the frames of the clip, and beside it what happens in the scene as it is.

    Simulates what the mover and everything it meets do, many times, within what the picture leaves open.
    """
    path = free_path(situation)
    world, query = reconstruct(situation, path)
    results = run_ensemble(world, _decidable(situation, world, query), situation.request.ensemble)
    trajectories = [record_trajectory(situation, each, path) for each in results]
    if situation.grounding.asked is not None:
        outcomes = [judge(situation.grounding.asked, query, each) for each in results]
        trajectories = _with_outcomes(situation, trajectories, outcomes)
    factual = trajectories[1].model_copy(update={"anchors": ()}) if len(trajectories) > 1 else None
    return trajectories[0].model_copy(update={"factual": factual})


def _decidable(situation: Situation, world: WorldInput, query: Query | None) -> Query | None:
    """What worlds can decide: nothing of what is removed, and not that something lands that stands on the floor.

    Where the mover is put somewhere and nothing is asked, whether it gets there: shown is what it does in most worlds.
    """
    if world.placement is not None and situation.grounding.asked is None:
        return Query(Asked(relation="inside"), world.placement.targets[0])
    if query is None or not situation.is_separated or query.subject >= len(world.bodies):
        return None
    subject = world.bodies[query.subject]
    in_air = flies(subject, situation.motion) if query.subject == 0 else subject.is_flying
    on_floor = not in_air and supports_of((*world.bodies, *world.removed))[query.subject] is None
    relation = query.asked.relation
    is_decided = relation in BY_ENCOUNTERS or (world.placement is not None and relation == "inside")
    return query if is_decided and not (on_floor and relation == "lands") else None


# --- outcomes


def judge(asked: Asked, query: Query | None, result: EnsembleResult) -> Outcome:
    """What the worlds say to what is asked; without a probability where they cannot tell."""
    names = [body.name for body in (*result.world.bodies, *result.world.removed)]
    outcome = Outcome(
        asked=asked if result.query is None else result.query.asked,
        subject=None if query is None or not query.subject else names[query.subject],
        object=None if query is None or query.target is None else names[query.target],
        sure=False,
        robust=False,
    )
    if result.decided is None:
        return outcome
    first = None if result.decided.first is None else names[result.decided.first]
    return outcome.model_copy(update=vars(result.decided) | {"first": first})


def _with_outcomes(
    situation: Situation, trajectories: Sequence[Trajectory], outcomes: Sequence[Outcome]
) -> list[Trajectory]:
    """The trajectories with their outcomes and, in the first, the facts of them all in a sentence."""
    grounding, told = situation.grounding, list[Trajectory]()
    for trajectory, outcome in zip(trajectories, outcomes, strict=True):
        with_outcome = trajectory.model_copy(update={"outcome": outcome})
        told.append(_with_facts(with_outcome, facts_of(grounding.object, with_outcome)))
    if len(told) > 1:
        carried = placed_mover(grounding) if situation.motion.kind == "place" else None
        changes = tuple(each for each in grounding.interventions if each is not carried)
        told[0] = _with_facts(told[0], facts_of_both(changes, grounding.object, *told))
    return told


def _with_facts(trajectory: Trajectory, facts: str) -> Trajectory:
    assert trajectory.outcome is not None
    return trajectory.model_copy(update={"outcome": trajectory.outcome.model_copy(update={"facts": facts})})


# --- warnings: what was understood in one way and could be meant in another


def _warnings(request: SimulateRequest, grounding: Grounding, trajectory: Trajectory) -> tuple[str, ...]:
    found: list[str] = []
    if not trajectory.encounters_known:
        found.append(
            "The surroundings could not be separated into objects, so encounters were not computed: "
            "an empty list does not mean that nothing is hit."
        )
    found += _path_warnings(request, grounding)
    for placed in trajectory.placed:
        found += doubts_of(placed)
    found += [
        f"'{each.object}', put {each.place}, was put there by the way in which that moves, not as the camera sees it."
        for each in trajectory.placed
        if each.by_heading
    ]
    if trajectory.factual is not None and trajectory.placed:
        put = {each.body for each in trajectory.placed}
        found += [
            f"'{body.object}' makes room for what is put there: it does not begin where the image shows it."
            for index, (body, seen) in enumerate(zip(trajectory.bodies, trajectory.factual.bodies, strict=False))
            if index not in put and body.bbox != seen.bbox
        ]
    return tuple(found)


def _path_warnings(request: SimulateRequest, grounding: Grounding) -> list[str]:
    """Where a given path goes beside the motion, the object or the clip that were given with it."""
    given, found = request.trajectory, list[str]()
    if given is None:
        return found
    if request.stated_motion is not None:
        found.append(
            "Both `motion` and `trajectory` were given: the object follows the trajectory, the motion only words it."
        )
    x0, y0, x1, y1 = grounding.bbox
    gap = math.dist(given.points[0], grounding.point)
    if request.grounding is not None and gap > OFF_CENTRE * max(x1 - x0, y1 - y0):
        found.append(
            f"The given trajectory begins {gap:.0f} px from the object's centre: in the first frame it is drawn there."
        )
    # A path that ends where the clip does, or a frame beside it, is of its length.
    path, clip = (len(given.points) - 1) / given.fps, (request.num_frames - 1) / request.fps
    if abs(path - clip) * request.fps > 1.5:
        happens = "its rest is not shown" if path > clip else "from its end on the object stays where it is"
        found.append(f"The given trajectory lasts {path:.2f} s and the clip {clip:.2f} s: {happens}.")
    return found
