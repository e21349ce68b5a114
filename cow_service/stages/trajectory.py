"""Stage 3: what the mover and everything it meets do over the clip, and how sure that is."""

import base64
import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cow_service.media.images import encode_png, fit_within
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
from cow_service.stages.keys import StageResult
from cow_service.stages.reconstruction import Situation, reconstruct
from cow_service.stages.run import Run
from cow_service.vision.scene import Scene
from cow_service.vision.types import Floats

SPRITE_SIDE = 256  # px, at most: sprites are seen while somebody drags


def compute_trajectory(run: Run[SimulateRequest], grounding: Grounding, motion: Motion) -> StageResult[Trajectory]:
    """The world over the whole clip; a path from the request is followed through everything."""
    with run.cpu():
        scene = run.scene_of(grounding, motion.cue)
        situation = Situation.of(run, scene, grounding, motion)
        reconstructed = reconstruct(situation)
        trajectory = simulate_world(situation, *reconstructed)
        live = live_worlds(*reconstructed[:2], run.request.ensemble) if run.request.live else None
        for body, told in zip(reconstructed[0].bodies, [] if live is None else live["bodies"], strict=False):
            told["sprite"] = _sprite(scene, body)
    warnings = warnings_of(run.request, grounding, trajectory)
    if live is None:
        return StageResult(value=trajectory, warnings=warnings)
    with run.backends.artifacts.batch(run.retry_policy) as put:
        kept = put(json.dumps(live, separators=(",", ":")).encode(), "application/json")
    trajectory = trajectory.model_copy(update={"live": kept})
    return StageResult(value=trajectory, warnings=warnings, artifacts=(kept.sha256,))


def _sprite(scene: Scene, body: SeenBody) -> dict[str, Any]:
    """A body cut out of the image without what is drawn over it: a PNG as data URL, and its box (px)."""
    mask = body.mask
    cut = np.dstack([scene.undrawn[mask.rows, mask.columns], mask.patch.astype(np.uint8) * np.uint8(255)])
    png = base64.b64encode(encode_png(fit_within(cut, SPRITE_SIDE))).decode()
    return {"href": f"data:image/png;base64,{png}", "box": list(mask.bbox)}


def simulate_world(situation: Situation, world: WorldInput, query: Query | None, path: FreePath | None) -> Trajectory:
    """What happens over the frames of the clip, and beside it what happens in the scene as it is.

    Simulates what the mover and everything it meets do, many times, within what the picture leaves open.
    """
    given, known = situation.request.trajectory, situation.is_separated
    judged = [judge(situation, each) for each in run_ensemble(world, query, situation.request.ensemble)]
    first, *as_it_is = [record_trajectory(*each, path, given, known) for each in judged]
    factual = as_it_is[0].model_copy(update={"anchors": ()}) if as_it_is else None
    return first.model_copy(update={"factual": factual})


def judge(situation: Situation, result: EnsembleResult) -> tuple[EnsembleResult, Outcome | None]:
    """The result, its bodies as sure as their outlines are; and what the worlds say to what is asked, if anything is.

    However the worlds agree, nothing is sure of a thing that may be another one than the question means, nor where a
    thing that matters was not seen clearly: doubtful outlines of those are cut out a second time.
    """
    asked, world, query = situation.grounding.asked, result.world, result.query
    touches = None if result.ensemble is None else result.ensemble.events.of[0].times["touches"]
    candidates = () if result.decided is None or query is None else result.decided.candidates
    bodies = list(world.bodies)
    are_named = query is not None and bool(query.asked.among)
    of_each = [
        bodies_that_matter(query and query.of(each.body), each.told.touches, len(bodies), each.body if are_named else 0)
        for each in candidates
    ]
    matter = bodies_that_matter(query, touches, len(bodies)).union(*of_each)
    for body in matter:
        bodies[body] = replace(bodies[body], confidence=situation.scene.confidence_of(bodies[body].bbox))
    result = replace(result, world=replace(world, bodies=tuple(bodies)))
    if asked is None:
        return result, None
    names = [body.name for body in (*bodies, *world.removed)]
    outcome = Outcome(
        asked=asked if query is None else query.asked,
        subject=None if query is None or not query.subject else names[query.subject],
        object=None if query is None or query.target is None else names[query.target],
        sure=False,
        robust=False,
    )
    if world.depth is not None and not world.depth.is_of_scene:
        return result, outcome.model_copy(update={"depends_on": ("depth",)})
    if result.decided is None:
        return result, outcome
    is_misread = situation.motion.other_direction is not None or situation.grounding.question_is_doubtful
    of_reading: list[Doubt] = ["reading"] if is_misread else []
    if any(thing.is_doubtful for thing in (situation.grounding, *situation.located)):
        of_reading.append("identity")
    path = seen_paths(result.shown.worlds.within_horizon, 0)
    way = path.points[0] - path.seen[0]

    def doubts_of(matter: set[int], ways: Sequence[Floats]) -> list[Doubt]:
        doubts = list(of_reading)
        if any(bodies[body].confidence < CLEAR for body in matter):
            doubts.append("outline")
        if world.measured is not None and not all(world.measured.footprints[body] for body in matter):
            doubts.append("depth")
        if world.placement is None and any(moves_over(bodies[0].bbox, each, world.faint) for each in ways):
            doubts.append("faint")
        return doubts

    ways = [way if each.told.way is None else each.told.way for each in candidates]
    chosen = [
        CandidateOutcome(
            object=names[each.body], probability=each.probability, sure=each.sure and not doubts_of(own, [its_way])
        )
        for each, own, its_way in zip(candidates, of_each, ways, strict=True)
    ]
    first = None if result.decided.first is None else names[result.decided.first]
    decided = vars(result.decided) | {"first": first, "candidates": tuple(chosen)}
    if doubts := doubts_of(matter, [way, *ways]):
        decided |= {"sure": False, "robust": False, "depends_on": (*doubts, *result.decided.depends_on)}
    return result, outcome.model_copy(update=decided)


def moves_over(mover: BBox, way: Floats, boxes: Sequence[BBox]) -> bool:
    """Whether what is in a box meets what is in one of some boxes (px) on its way [F, 2]: their lower halves do."""
    (x0, y0, x1, y1), lower = mover, [(left, (top + bottom) / 2, right, bottom) for left, top, right, bottom in boxes]
    swept = np.array([x0, (y0 + y1) / 2, x1, y1]) + np.hstack([way, way])
    return any(bool(((swept[:, :2] < box[2:]) & (swept[:, 2:] > box[:2])).all(axis=1).any()) for box in lower)


def bodies_that_matter(query: Query | None, touches: Floats | None, count: int, candidate: int = 0) -> set[int]:
    """Of so many bodies the mover, what is asked about, and what the mover touches [K, B] before that in more than a
    few worlds. What was removed, numbered after the bodies, is never met."""
    meant = {0, candidate} if query is None else {0, candidate, query.subject, query.target}
    if touches is None:
        return {i for i in range(count) if i in meant}
    # Of what is struck by something else in turn, what comes first is not told here.
    target = None if query is None or query.subject or query.asked.relation != "touches" else query.target
    before = touches[:, target] if target is not None and target < count else np.full(len(touches), np.inf)
    return {i for i in range(count) if i in meant or float(np.mean(touches[:, i] < before)) > FEW_WORLDS}
