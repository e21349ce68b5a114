"""Stage 3: what the mover and everything it meets do over the clip, and how sure that is."""

import base64
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from cow_service.media.images import encode_png, fit_within
from cow_service.media.types import Floats, Image
from cow_service.narration.warnings import warnings_of
from cow_service.physics.ballistic import FreePath
from cow_service.physics.bodies import SeenBody
from cow_service.physics.ensemble import FEW_WORLDS, EnsembleResult, Query, run_ensemble
from cow_service.physics.events import seen_paths
from cow_service.physics.live import live_worlds
from cow_service.physics.recording import record_trajectory
from cow_service.physics.world import WorldInput
from cow_service.records import CLEAR, BBox, CandidateOutcome, Doubt, Grounding, Motion, Outcome, Trajectory
from cow_service.requests import SimulateRequest
from cow_service.stages.grounding import look_again
from cow_service.stages.keys import EstimatedDepth, StageResult
from cow_service.stages.reconstruction import reconstruct
from cow_service.stages.run import Run
from cow_service.stages.seeing import Situation, see

SPRITE_SIDE = 256  # px, at most: sprites are seen while somebody drags


def compute_trajectory(
    run: Run[SimulateRequest], grounding: Grounding, motion: Motion, depth: EstimatedDepth | None = None
) -> StageResult[Trajectory]:
    """The world over the whole clip; a path from the request is followed through everything."""
    with run.cpu():
        observation = look_again(run, grounding, motion.cue)
        situation = see(run, observation, grounding, motion, depth)
        world, query, path = reconstruct(situation)
        trajectory = simulate_world(situation, world, query, path)
        live = live_worlds(world, query, run.request.ensemble) if run.request.live else None
        for body, told in zip(world.bodies, [] if live is None else live["bodies"], strict=False):
            told["sprite"] = cut_out(observation.undrawn, body)
    warnings = warnings_of(run.request, grounding, trajectory)
    if live is None:
        return StageResult(value=trajectory, warnings=warnings)
    with run.backends.artifacts.batch(run.retry_policy) as put:
        kept = put(json.dumps(live, separators=(",", ":")).encode(), "application/json")
    trajectory = trajectory.model_copy(update={"live": kept})
    return StageResult(value=trajectory, warnings=warnings, artifacts=(kept.sha256,))


def cut_out(image: Image, body: SeenBody) -> dict[str, Any]:
    """A body cut out of the image without what is drawn over it: a PNG as data URL, and its box (px)."""
    mask = body.mask
    cut = np.dstack([image[mask.rows, mask.columns], mask.patch.astype(np.uint8) * np.uint8(255)])
    png = base64.b64encode(encode_png(fit_within(cut, SPRITE_SIDE))).decode()
    return {"href": f"data:image/png;base64,{png}", "box": list(mask.bbox)}


def simulate_world(situation: Situation, world: WorldInput, query: Query | None, path: FreePath | None) -> Trajectory:
    """What happens over the frames of the clip, and beside it what happens in the scene as it is.

    Simulates what the mover and everything it meets do, many times, within what the picture leaves open.
    """
    given, known = situation.request.trajectory, situation.is_separated
    results = run_ensemble(world, query, situation.request.ensemble)
    first, *as_it_is = [record_trajectory(each, judge(situation, each), path, given, known) for each in results]
    factual = as_it_is[0].model_copy(update={"anchors": ()}) if as_it_is else None
    return first.model_copy(update={"factual": factual})


def judge(situation: Situation, result: EnsembleResult) -> Outcome | None:
    """What the worlds say to what is asked, if anything is.

    However the worlds agree, nothing is sure of a thing that may be another one than the question means, nor where a
    thing that matters was not seen clearly.
    """
    asked, world, query = situation.grounding.asked, result.world, result.query
    if asked is None:
        return None
    names = [body.name for body in (*world.bodies, *world.removed)]
    outcome = Outcome(
        asked=asked if query is None else query.asked,
        subject=None if query is None or not query.subject else names[query.subject],
        object=None if query is None or query.target is None else names[query.target],
        sure=False,
        robust=False,
    )
    if world.depth is not None and not world.depth.is_of_scene:
        return outcome.model_copy(update={"depends_on": ("depth",)})
    return (
        outcome
        if result.decided is None or query is None
        else decided_outcome(situation, result, query, outcome, names)
    )


def decided_outcome(
    situation: Situation, result: EnsembleResult, query: Query, outcome: Outcome, names: Sequence[str]
) -> Outcome:
    """The outcome as worlds decide it, for the whole and for each candidate as sure as what it rests on."""
    decided, world = result.decided, result.world
    assert decided is not None
    assert result.ensemble is not None
    path, count = seen_paths(result.shown.worlds.within_horizon, 0), len(world.bodies)
    way = path.points[0] - path.seen[0]
    matter, ways = bodies_that_matter(query, result.ensemble.events.of[0].times["touches"], count), [way]
    chosen: list[CandidateOutcome] = []
    for each in decided.candidates:
        own_way = way if each.told.way is None else each.told.way
        own = bodies_that_matter(query.of(each.body), each.told.touches, count)
        own |= {each.body} & set(range(count)) if query.asked.among else set()
        is_sure = each.sure and not doubts_of(situation, world, own, [own_way])
        name = names[each.body]
        chosen.append(CandidateOutcome(object=name, probability=each.probability, sure=is_sure))
        matter, ways = matter | own, [*ways, own_way]
    first = None if decided.first is None else names[decided.first]
    update = vars(decided) | {"first": first, "candidates": tuple(chosen)}
    if doubts := doubts_of(situation, world, matter, ways):
        update |= {"sure": False, "robust": False, "depends_on": (*doubts, *decided.depends_on)}
    return outcome.model_copy(update=update)


def doubts_of(situation: Situation, world: WorldInput, matter: set[int], ways: Sequence[Floats]) -> tuple[Doubt, ...]:
    """Why nothing is sure that rests on some of the bodies, and on ways [F, 2] (px) that the mover takes."""
    grounding, measured, mover = situation.grounding, world.measured, world.bodies[0].bbox
    holds: dict[Doubt, bool] = {
        "reading": situation.motion.other_direction is not None or grounding.question_is_doubtful,
        "identity": any(thing.is_doubtful for thing in (grounding, *situation.located)),
        "outline": any(world.bodies[body].confidence < CLEAR for body in matter),
        "depth": measured is not None and not all(measured.footprints[body] for body in matter),
        "faint": world.placement is None and any(moves_over(mover, way, world.faint) for way in ways),
    }
    return tuple(doubt for doubt, is_so in holds.items() if is_so)


def moves_over(mover: BBox, way: Floats, boxes: Sequence[BBox]) -> bool:
    """Whether what is in a box meets what is in one of some boxes (px) on its way [F, 2]: their lower halves do."""
    (x0, y0, x1, y1), lower = mover, [(left, (top + bottom) / 2, right, bottom) for left, top, right, bottom in boxes]
    swept = np.array([x0, (y0 + y1) / 2, x1, y1]) + np.hstack([way, way])
    return any(bool(((swept[:, :2] < box[2:]) & (swept[:, 2:] > box[:2])).all(axis=1).any()) for box in lower)


def bodies_that_matter(query: Query, touches: Floats, count: int) -> set[int]:
    """Of so many bodies the mover, what is asked about, and what the mover touches [K, B] before that in more than a
    few worlds. What was removed, numbered after the bodies, is never met."""
    # Of what is struck by something else in turn, what comes first is not told here.
    target = None if query.subject or query.asked.relation != "touches" else query.target
    before = touches[:, target] if target is not None and target < count else np.full(len(touches), np.inf)
    meant = {0, query.subject, query.target}
    return {i for i in range(count) if i in meant or float(np.mean(touches[:, i] < before)) > FEW_WORLDS}
