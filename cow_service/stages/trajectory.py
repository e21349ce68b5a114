"""Stage 3: what the mover and everything it meets do over the clip, and how sure that is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.physics.anchors import spread_anchors
from cow_service.physics.ballistic import FreePath, ballistic_path, given_path, latest, sampled
from cow_service.physics.bodies import SeenBody, supports_of
from cow_service.physics.camera import Camera
from cow_service.physics.events import encounters
from cow_service.physics.floor_camera import FloorCamera
from cow_service.physics.outcome import Query
from cow_service.physics.placing import flies
from cow_service.physics.sweeping import swept
from cow_service.physics.world import Led, WorldInput, Worlds
from cow_service.readers.question.relations import read_asked
from cow_service.readers.question.sentences import parse
from cow_service.records import Asked, Grounding, Motion, Path, Trajectory
from cow_service.requests import SimulateRequest, TrajectoryRequest
from cow_service.stages.bodies import obstacles_of, query_of, seen_bodies
from cow_service.stages.camera import camera_of
from cow_service.stages.imagining import Imagined, imagine
from cow_service.stages.outcomes import can_tell, with_outcomes
from cow_service.stages.paths import (
    body_records,
    camera_record,
    contact_records,
    moving_until,
    pairs,
    path_records,
    start_of,
    tracks,
    with_times,
)
from cow_service.stages.placing import (
    placed_before,
    placed_mover,
    placed_records,
    placement_of,
    put_before,
    put_of,
    tapered,
)
from cow_service.stages.results import StageResult
from cow_service.stages.run import Run
from cow_service.stages.shown import shown_bodies, was_put
from cow_service.stages.warnings import warnings_of
from cow_service.vision.obstacles import Obstacle
from cow_service.vision.scene import Scene
from cow_service.vision.types import Floats

_OWN = ("kind", "direction", "depth", "speed", "speed_deviation")  # of each mover


def compute_trajectory(run: Run[SimulateRequest], grounding: Grounding, motion: Motion) -> StageResult[Trajectory]:
    """The world over the whole clip; a path from the request is followed through everything."""
    with run.cpu():
        obstacles, taken = obstacles_of(run.scene, grounding)
        trajectory = trajectory_of(run.scene, grounding, motion, obstacles, run.request, taken)
        return StageResult(value=trajectory, warnings=warnings_of(run.scene, run.request, grounding, trajectory))


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
    asked = read_asked(parse(request.question))
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
