"""Stage 3: what the mover and everything it meets do over the clip, and how sure that is."""

import math
from collections.abc import Sequence

from cow_service.narration import doubts_of, facts_of, facts_of_both
from cow_service.physics.bodies import supports_of
from cow_service.physics.ensemble import KIND_OF, EnsembleResult, Query, run_ensemble
from cow_service.physics.layout import flies
from cow_service.physics.world import WorldInput
from cow_service.records import Asked, Grounding, Motion, Outcome, Trajectory
from cow_service.requests import SimulateRequest
from cow_service.stages.keys import StageResult
from cow_service.stages.paths import record_trajectory
from cow_service.stages.reconstruction import Situation, reconstruct
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
    world, query, path = reconstruct(situation)
    results = run_ensemble(world, decidable(situation, world, query), situation.request.ensemble)
    outcomes = [judge(situation.grounding.asked, query, each) for each in results]
    trajectories = [
        record_trajectory(situation, result, outcome, path) for result, outcome in zip(results, outcomes, strict=True)
    ]
    first, *as_it_is = add_facts(situation, trajectories)
    factual = as_it_is[0].model_copy(update={"anchors": ()}) if as_it_is else None
    return first.model_copy(update={"factual": factual})


def decidable(situation: Situation, world: WorldInput, query: Query | None) -> Query | None:
    """What worlds can decide: nothing of what is removed, and not that something lands that stands on the floor.

    Where the mover is put somewhere and nothing is asked, whether it gets there: shown is what it does in most worlds.
    """
    if world.placement is not None and situation.grounding.asked is None:
        return Query(Asked(relation="inside"), world.placement.targets[0])
    if query is None or not situation.is_separated or query.subject >= len(world.bodies):
        return None
    subject, relation = world.bodies[query.subject], query.asked.relation
    in_air = subject.is_flying if query.subject else flies(subject, situation.motion)
    on_floor = not in_air and supports_of((*world.bodies, *world.removed))[query.subject] is None
    is_decided = relation in BY_ENCOUNTERS or (world.placement is not None and relation == "inside")
    return query if is_decided and not (on_floor and relation == "lands") else None


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


def judge(asked: Asked | None, query: Query | None, result: EnsembleResult) -> Outcome | None:
    """What the worlds say to what is asked, if anything is; without a probability where they cannot tell."""
    if asked is None:
        return None
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


def _warnings(request: SimulateRequest, grounding: Grounding, trajectory: Trajectory) -> tuple[str, ...]:
    given, found = request.trajectory, list[str]()
    if not trajectory.encounters_known:
        found.append(
            "The surroundings could not be separated into objects, so encounters were not computed: "
            "an empty list does not mean that nothing is hit."
        )
    # Where a given path goes beside the motion, the object or the clip that were given with it.
    if given is not None and request.stated_motion is not None:
        found.append(
            "Both `motion` and `trajectory` were given: the object follows the trajectory, the motion only words it."
        )
    x0, y0, x1, y1 = grounding.bbox
    gap = 0.0 if given is None else math.dist(given.points[0], grounding.point)
    if request.grounding is not None and gap > OFF_CENTRE * max(x1 - x0, y1 - y0):
        found.append(
            f"The given trajectory begins {gap:.0f} px from the object's centre: in the first frame it is drawn there."
        )
    # A path that ends where the clip does, or a frame beside it, is of its length.
    clip = (request.num_frames - 1) / request.fps
    path = clip if given is None else (len(given.points) - 1) / given.fps
    if abs(path - clip) * request.fps > 1.5:
        happens = "its rest is not shown" if path > clip else "from its end on the object stays where it is"
        found.append(f"The given trajectory lasts {path:.2f} s and the clip {clip:.2f} s: {happens}.")
    found += [doubt for placed in trajectory.placed for doubt in doubts_of(placed)]
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
