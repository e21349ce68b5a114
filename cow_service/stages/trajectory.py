"""Stage 3: where the object is in every frame of the clip, and what it meets on the way."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cow_service.physics.anchors import points_inside, spread_anchors
from cow_service.physics.camera import Camera
from cow_service.physics.dynamics import roll_out
from cow_service.physics.encounters import Sweep, find_encounters, swept_mask
from cow_service.records import FALLING_KINDS, Grounding, Motion, Trajectory
from cow_service.requests import SimulateRequest, TrajectoryRequest
from cow_service.stages.results import StageResult
from cow_service.stages.run import Run
from cow_service.stages.warnings import warnings_of
from cow_service.vision.obstacles import Obstacle
from cow_service.vision.scene import Scene

Floats = NDArray[np.float64]


def compute_trajectory(run: Run[SimulateRequest], grounding: Grounding, motion: Motion) -> StageResult[Trajectory]:
    """The path over the whole clip, rolled out from the motion or taken from the request, and what it meets."""
    request = run.request
    with run.cpu():
        obstacles = run.scene.obstacles(grounding.bbox, grounding.others)
        trajectory = trajectory_of(
            run.scene, grounding, motion, obstacles, request.trajectory, request.num_frames, request.fps
        )
        return StageResult(value=trajectory, warnings=warnings_of(run.scene, request, grounding, trajectory))


def trajectory_of(
    scene: Scene,
    grounding: Grounding,
    motion: Motion,
    obstacles: Sequence[Obstacle],
    given: TrajectoryRequest | None,
    num_frames: int,
    fps: float,
) -> Trajectory:
    """The path over `num_frames` frames at `fps`, rolled out from the motion or taken from the request."""
    camera = Camera(scene.width, scene.height, motion.metres_per_pixel.value)
    times = np.arange(num_frames) / fps
    states = _states(camera, grounding, motion, times) if given is None else _states_along(camera, given, times)
    points, scale = camera.project(states[:, :3])
    visible = (
        (points[:, 0] >= 0)
        & (points[:, 0] < scene.width)
        & (points[:, 1] >= 0)
        & (points[:, 1] < scene.height)
        & ~camera.has_passed(states[:, :3])
    )
    if given is not None and given.visible is not None:
        visible &= np.array(given.visible)[_latest(given, times)]
    mask = scene.silhouette(grounding.bbox)
    airborne = motion.kind in FALLING_KINDS
    sweep = Sweep(mask, grounding.bbox, np.array(grounding.point), points, scale, visible, airborne)
    movable = swept_mask(sweep)
    for obstacle in obstacles:
        obstacle.mask.add_to(movable)
    if given is not None and given.tracks is not None:
        tracks = [_sampled(np.array(track), given.fps, times) for track in given.tracks]
    else:
        offsets = [np.array(start) - grounding.point for start in points_inside(mask, grounding.point)]
        tracks = [points + scale[:, None] * offset for offset in offsets]
    anchors = spread_anchors(movable) if given is None or given.anchors is None else given.anchors
    return Trajectory(
        fps=fps,
        states=tuple(tuple(float(v) for v in state) for state in states),  # pyright: ignore[reportArgumentType]
        points=_pairs(points),
        visible=tuple(bool(v) for v in visible),
        scale=tuple(float(v) for v in scale),
        tracks=tuple(_pairs(track) for track in tracks),
        tracks_visible=_seen(given, times),
        anchors=anchors,
        encounters=find_encounters(sweep, obstacles),
        encounters_known=bool(scene.regions or obstacles),
    )


def _states(camera: Camera, grounding: Grounding, motion: Motion, times: Floats) -> Floats:
    """States [F, 6] of the motion from the grounded point."""
    metres = motion.metres_per_pixel.value
    dx, dy = motion.direction or (0.0, 0.0)
    across = float(np.sqrt(1 - motion.depth**2))
    velocity = motion.speed * metres * np.array([across * dx, across * dy, motion.depth])
    acceleration = metres * np.array([*motion.gravity, 0.0])
    return roll_out(camera.lift(grounding.point), velocity, acceleration, times)


def _states_along(camera: Camera, given: TrajectoryRequest, times: Floats) -> Floats:
    """States [F, 6] at the object's first depth along given points, linear between them, at rest after the last."""
    stamps = np.arange(len(given.points)) / given.fps
    path = np.array([camera.lift(point) for point in given.points])
    position = _sampled(path, given.fps, times)
    step = np.minimum(np.searchsorted(stamps, times, side="right"), len(stamps) - 1)
    velocity = (path[step] - path[step - 1]) * given.fps
    velocity[times >= stamps[-1]] = 0.0
    return np.hstack([position, velocity])


def _sampled(path: Floats, fps: float, times: Floats) -> Floats:
    """A path [P, D] given at `fps`, at other times: linear between its points, at rest after the last."""
    stamps = np.arange(len(path)) / fps
    return np.stack([np.interp(times, stamps, path[:, axis]) for axis in range(path.shape[1])], axis=1)


def _seen(given: TrajectoryRequest | None, times: Floats) -> tuple[tuple[bool, ...], ...] | None:
    """Per track and frame, as given."""
    if given is None or given.tracks_visible is None:
        return None
    frames = _latest(given, times)
    return tuple(tuple(track[frame] for frame in frames) for track in given.tracks_visible)


def _latest(given: TrajectoryRequest, times: Floats) -> NDArray[np.int64]:
    """The number of the given point that was reached last at each time."""
    # The small term keeps a frame that falls on a point from landing before it.
    return np.minimum((times * given.fps + 1e-6).astype(np.int64), len(given.points) - 1)


def _pairs(points: Floats) -> tuple[tuple[float, float], ...]:
    return tuple((float(x), float(y)) for x, y in points)
