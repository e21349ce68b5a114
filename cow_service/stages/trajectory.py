"""Stage 3: what the mover and everything it meets do over the clip, and how sure that is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from cow_service.narration import facts_of, facts_of_both
from cow_service.physics.ballistic import FreePath, ballistic_path, given_path, latest, sampled
from cow_service.physics.bodies import SeenBody, supports_of
from cow_service.physics.camera import Camera, FloorCamera
from cow_service.physics.draws import ensemble, likeliest
from cow_service.physics.events import WorldEvents, encounters, find_world_events
from cow_service.physics.outcome import KIND_OF, Decided, Query, answers_of, decide, decide_change
from cow_service.physics.placing import flies
from cow_service.physics.projection import spread_anchors, swept
from cow_service.physics.world import Led, WorldInput, Worlds, run_world
from cow_service.records import Asked, Grounding, Intervention, Motion, Outcome, Path, Trajectory
from cow_service.requests import SimulateRequest, TrajectoryRequest
from cow_service.stages.bodies import camera_of, obstacles_of, query_of, seen_bodies
from cow_service.stages.grounding import placed_mover
from cow_service.stages.keys import StageResult
from cow_service.stages.paths import (
    body_records,
    camera_record,
    contact_records,
    moving_until,
    pairs,
    path_records,
    shown_bodies,
    start_of,
    tracks,
    was_put,
    with_times,
)
from cow_service.stages.placing import (
    placed_before,
    placed_records,
    placement_of,
    put_before,
    put_of,
    tapered,
)
from cow_service.stages.run import Run
from cow_service.stages.warnings import warnings_of
from cow_service.vision.masks import Floats
from cow_service.vision.scene import Obstacle, Scene

EVERY = 2  # frames between those that are recorded of the ensemble
TRIES = 4  # worlds that are tried for one that shows what most of the ensemble does


@dataclass(frozen=True)
class Ran:
    """Worlds with what happens in them."""

    worlds: Worlds
    events: WorldEvents


@dataclass(frozen=True)
class Imagined:
    """The world that is shown, and what an ensemble around it says."""

    given: WorldInput
    shown: Worlds
    events: WorldEvents  # of the shown world
    around: Worlds | None  # the ensemble's
    around_events: WorldEvents | None
    query: Query | None
    decided: Decided | None  # null where nothing is asked, or there is no ensemble


def imagine(world: WorldInput, query: Query | None, size: int) -> tuple[Imagined, ...]:
    """Runs the likeliest world and an ensemble of `size` worlds around it; where something is changed first, also
    the world as it is, with the same draws, as the second.

    What is shown must not contradict what is answered: where an answer is sure and the likeliest world differs from
    it, the likeliest world of those that agree is shown.
    """
    given = (world, world.as_it_is()) if world.is_changed else (world,)
    queries = [query if len(given) == 1 else _as_it_is(query, place) for place in range(len(given))]
    if size == 0:
        shown = [_run(each, likeliest()) for each in given]
        return tuple(
            Imagined(each, ran.worlds, ran.events, None, None, asked, None)
            for each, ran, asked in zip(given, shown, queries, strict=True)
        )
    rows = ensemble(size)
    # Side by side: the engine's steps, half of the time, are not held up by the interpreter's lock.
    with ThreadPoolExecutor(1) as beside:
        likely = beside.submit(lambda: [_run(each, likeliest()) for each in given])
        around = [_run(each, rows, EVERY) for each in given]
        shown = likely.result()
    decided = _decided(queries, around, rows)
    if query is not None and any(each is not None and each.sure for each in decided):
        shown = _agreeing(given, query, decided, rows, around, shown)
    return tuple(
        Imagined(each, one.worlds, one.events, many.worlds, many.events, asked, said)
        for each, one, many, asked, said in zip(given, shown, around, queries, decided, strict=True)
    )


def _as_it_is(query: Query | None, place: int) -> Query | None:
    """What is asked of the world as it is, the second, where a change is asked about: what it is that would change."""
    if query is None or place == 0 or query.asked.form != "changes":
        return query
    form = "what-happens" if query.target is None else "whether"
    return replace(query, asked=query.asked.model_copy(update={"form": form, "negated": False}))


def _decided(queries: Sequence[Query | None], around: Sequence[Ran], rows: Floats) -> list[Decided | None]:
    found: list[Decided | None] = []
    for query, ran in zip(queries, around, strict=True):
        if query is None:
            found.append(None)
        elif query.asked.form != "changes":
            found.append(decide(query, ran.events, rows))
        else:
            found.append(decide_change(query, ran.events, around[1].events, rows) if len(around) > 1 else None)
    return found


def _agreeing(
    given: Sequence[WorldInput],
    query: Query,
    decided: Sequence[Decided | None],
    rows: Floats,
    around: Sequence[Ran],
    shown: list[Ran],
) -> list[Ran]:
    """The likeliest world, with its counterpart, that shows what most of the ensemble does."""
    sure = [each is not None and each.sure for each in decided]
    found = _verdicts(query, sure, around)
    wanted = tuple(Counter(column).most_common(1)[0][0] for column in zip(*found, strict=True))
    if _verdicts(query, sure, shown)[0] == wanted:
        return shown
    nearest = np.argsort(np.linalg.norm(rows, axis=1))
    for row in [int(k) for k in nearest if found[k] == wanted][:TRIES]:
        tried = [_run(each, rows[row : row + 1]) for each in given]
        if _verdicts(query, sure, tried)[0] == wanted:
            return tried
    return shown


def _verdicts(query: Query, sure: Sequence[bool], ran: Sequence[Ran]) -> list[tuple[int, ...]]:
    """Per draw, the answers that are sure: of each world, or whether they differ where that is asked. Then whether
    each thing stays where it is put before."""
    answers = [answers_of(query, each.events) for each in ran]
    if query.asked.form == "changes":
        told = [[int(one != other) for one, other in zip(*answers, strict=True)]]
    else:
        told = [each for each, is_sure in zip(answers, sure, strict=True) if is_sure]
    stays = [placements.stays.astype(int).tolist() for placements in ran[0].worlds.before]
    return list(zip(*told, *stays, strict=True))


def _run(world: WorldInput, draws: Floats, every: int = 1) -> Ran:
    worlds = run_world(world, draws, every)
    return Ran(worlds, find_world_events(worlds, world.bodies, world.fps, draws, world.size))


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


_OWN = ("kind", "direction", "depth", "speed", "speed_deviation")  # of each mover


def compute_trajectory(run: Run[SimulateRequest], grounding: Grounding, motion: Motion) -> StageResult[Trajectory]:
    """The world over the whole clip; a path from the request is followed through everything."""
    with run.cpu():
        scene = run.scene_of(grounding, motion.cue)
        obstacles, taken = obstacles_of(scene, grounding)
        trajectory = trajectory_of(scene, grounding, motion, obstacles, run.request, taken)
        return StageResult(value=trajectory, warnings=warnings_of(run.request, grounding, trajectory))


def trajectory_of(
    scene: Scene,
    grounding: Grounding,
    motion: Motion,
    obstacles: Sequence[Obstacle],
    request: SimulateRequest,
    taken: Sequence[Obstacle] = (),
) -> Trajectory:
    """What happens in the scene over the frames of a request's clip, without the obstacles that are taken away."""
    bodies = seen_bodies(scene, grounding, (*obstacles, *taken))
    free = _free_path(scene, grounding, motion, request)
    known = bool(scene.regions or obstacles or taken)
    asked = grounding.asked
    query = None if asked is None else query_of(asked, grounding, bodies)
    kept = len(bodies) - len(taken)
    world = _world(scene, (bodies[:kept], bodies[kept:]), motion, request, free, grounding, query)
    put = put_of(scene, grounding, motion, bodies[:kept])
    before = put_before(scene, grounding, motion, bodies[:kept], led=free is not None)
    # People aim at what they ask about; where that is put elsewhere, not at its place in the image.
    asked_about = None if world.asked in [each.body for each in before] else world.asked
    world = replace(world, bodies=tapered(world.bodies, put, before), put=put, put_before=before, asked=asked_about)
    on_floor = query is not None and _on_floor(bodies, query.subject, motion)
    tellable = query if known and query is not None and can_tell(query, kept, put is not None, on_floor) else None
    if put is not None and asked is None:  # what is shown is what most worlds do
        tellable = Query(Asked(relation="inside"), put.targets[0])
    imagined = imagine(world, tellable, request.ensemble)
    trajectories = [_record(scene, grounding, motion, request, each, free, known) for each in imagined]
    changes = tuple(each for each in grounding.interventions if put is None or each is not placed_mover(grounding))
    told = with_outcomes(trajectories, imagined, asked, query, grounding, changes)
    factual = told[1].model_copy(update={"anchors": ()}) if len(told) > 1 else None
    return told[0].model_copy(update={"factual": factual})


def _on_floor(bodies: Sequence[SeenBody], index: int, motion: Motion) -> bool:
    """Whether a body stands on the floor at first: not in the air, nor on another thing."""
    in_air = flies(bodies[index], motion) if index == 0 else bodies[index].is_flying
    return not in_air and supports_of(bodies)[index] is None


def _free_path(scene: Scene, grounding: Grounding, motion: Motion, request: SimulateRequest) -> FreePath | None:
    """The path that no contact changes, where the request gives it or the law is ballistic."""
    times = np.arange(request.num_frames) / request.fps
    camera = Camera(scene.width, scene.height, motion.metres_per_pixel.value)
    if request.trajectory is not None:
        return given_path(camera, request.trajectory, times)
    free = motion.law == "ballistic" and motion.kind != "place"
    return ballistic_path(camera, grounding, motion, times) if free else None


def _world(
    scene: Scene,
    present_and_taken: tuple[tuple[SeenBody, ...], tuple[SeenBody, ...]],
    motion: Motion,
    request: SimulateRequest,
    free: FreePath | None,
    grounding: Grounding,
    query: Query | None,
) -> WorldInput:
    (bodies, taken), led = present_and_taken, None
    if free is not None:
        x, y = grounding.point
        foot = np.array(bodies[0].foot) - np.array([x, y])
        led = Led(free.states[:, :3], free.points + foot)
    in_air = flies(bodies[0], motion) and bodies[0].shape == "sphere"
    fit = camera_of(scene, motion, request.camera, bodies[0].bbox if in_air else None, fixed_focal=led is not None)
    size = scene.width, scene.height
    return WorldInput(
        bodies=bodies,
        motion=motion,
        fit=fit,
        size=size,
        num_frames=request.num_frames,
        fps=request.fps,
        asked=None if query is None else query.target,
        led=led,
        others={} if led is not None else _others((*bodies, *taken), motion),
        taken=taken,
        turns_wanted=query is not None and query.asked.relation == "tips",
    )


def _others(bodies: Sequence[SeenBody], motion: Motion) -> dict[int, Motion]:
    """The motions of other bodies that are set moving, by their places among the bodies."""
    alone = {"distance": None, "duration": None, "until": None, "steps": (), "others": (), "trail": ()}
    return {
        i: motion.model_copy(update=alone | {name: getattr(other, name) for name in _OWN})
        for other in motion.others
        for i, body in enumerate(bodies)
        if i and body.bbox == other.object.bbox
    }


def _record(
    scene: Scene,
    grounding: Grounding,
    motion: Motion,
    request: SimulateRequest,
    imagined: Imagined,
    free: FreePath | None,
    known: bool,
) -> Trajectory:
    world, shown, size = imagined.given, imagined.shown, (scene.width, scene.height)
    placed = placed_records(placed_before(grounding, motion), world, shown, imagined.around)
    camera, bodies = camera_record(world.fit, shown, imagined.around), shown_bodies(world.bodies, shown)
    if free is None:
        paths = path_records(world.bodies, grounding.point, shown, size, imagined.around)
    else:
        paths = (_free_record(world.bodies[0], grounding, request, free),)
    paths = with_times(paths, imagined.events)
    partly = imagined.query is not None and imagined.query.asked.partly
    given = request.trajectory
    anchors = _anchors(bodies, grounding, paths, shown) if given is None or given.anchors is None else given.anchors
    return Trajectory(
        law="ballistic" if free is not None else "contact",
        fps=request.fps,
        camera=camera,
        bodies=body_records(bodies, shown),
        paths=paths,
        contacts=contact_records(shown, FloorCamera.of(camera, *size)),
        light=_light(world, shown.scene.light),
        moving_until=moving_until(paths, request.fps),
        anchors=anchors,
        encounters=encounters(imagined.events, imagined.around_events, bodies, request.fps, request.num_frames, partly),
        encounters_known=known,
        placement=placement_of(grounding.object, shown.placements, imagined.around and imagined.around.placements),
        placed=placed,
        ensemble=request.ensemble,
    )


def _light(world: WorldInput, light: Floats) -> tuple[float, float] | None:
    """Where a shadow in the air told it."""
    return (float(light[0, 0]), float(light[0, 1])) if world.fit.source == "shadow" else None


def _free_record(mover: SeenBody, grounding: Grounding, request: SimulateRequest, free: FreePath) -> Path:
    """The mover's path as it was given, or as the ballistic law has it."""
    given, times = request.trajectory, np.arange(request.num_frames) / request.fps
    if given is not None and given.tracks is not None:
        found = [sampled(np.array(track), given.fps, times) for track in given.tracks]
    else:
        found = tracks(mover, np.array(grounding.point), free.points, free.scale, np.zeros(len(times)))
    return Path(
        states=tuple(tuple(state) for state in free.states.tolist()),
        points=pairs(free.points),
        visible=tuple(free.visible.tolist()),
        scale=tuple(free.scale.tolist()),
        tracks=tuple(pairs(track) for track in found),
        tracks_visible=_seen(given, times),
    )


def _seen(given: TrajectoryRequest | None, times: Floats) -> tuple[tuple[bool, ...], ...] | None:
    """Per track and frame, as given."""
    if given is None or given.tracks_visible is None:
        return None
    frames = latest(given, times)
    return tuple(tuple(track[frame] for frame in frames) for track in given.tracks_visible)


def _anchors(
    bodies: Sequence[SeenBody], grounding: Grounding, paths: Sequence[Path], worlds: Worlds
) -> tuple[tuple[float, float], ...]:
    """Points off every body and off the way of all that moves."""
    starts = [
        np.array(path.points[0] if was_put(path.body, worlds) else start_of(bodies, path.body, grounding.point))
        for path in paths
    ]
    movable = swept([bodies[path.body].mask for path in paths], starts, paths)
    for body in bodies:
        body.mask.add_to(movable)
    return spread_anchors(movable)
