"""What is set in motion besides the mover: when, and whether it tips over or leaves the image."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cow_service.physics.engine import WorldRun
from cow_service.physics.projection import SeenPaths, turned
from cow_service.physics.rigid import RigidShape
from cow_service.physics.world import Worlds
from cow_service.vision.types import Floats, Mask

NEVER = math.inf
DISPLACED = 0.1  # of a body's half width: what is displaced less was not set in motion
TIPPED = math.radians(45)  # an upright axis that leans more has tipped over


def set_off(shapes: Sequence[RigidShape], run: WorldRun) -> dict[int, float]:
    """When each body of one world that moves was set in motion (s), in that order: 0 for what starts by itself."""
    moving = {i: 0.0 for i, shape in enumerate(shapes) if shape.starts or shape.follows is not None}
    moving.setdefault(0, 0.0)
    for meeting in sorted(run.meetings, key=lambda meeting: meeting.time):
        if meeting.b is None:
            continue
        for one, other in ((meeting.a, meeting.b), (meeting.b, meeting.a)):
            if one in moving and other not in moving and other in run.moved:
                moving[other] = meeting.time
    for late in sorted(run.moved - moving.keys()):  # what stood on something that was pushed away
        moving[late] = max(moving.values())
    return moving


def times_moved(worlds: Worlds) -> Floats:
    """[K, B]: when each body has been displaced (s), never for what stays where it is."""
    positions = np.stack([run.positions for run in worlds.runs])
    half = np.array([[shape.half_width for shape in shapes] for shapes in worlds.shapes])
    away = np.linalg.norm(positions - positions[:, :, :1], axis=3)
    return _first(away > DISPLACED * half[..., None], worlds)


def times_tipped(worlds: Worlds) -> Floats:
    """[K, B]: when the upright axis of each body first leans by more than 45 degrees (s); never for spheres.

    Of worlds whose turns were recorded.
    """
    count, frames = len(worlds.shapes[0]), worlds.runs[0].positions.shape[1]
    leans = np.zeros((len(worlds.runs), count, frames), bool)
    draws = zip(worlds.shapes, worlds.runs, strict=True)
    which = [(k, i) for k, (shapes, run) in enumerate(draws) for i in run.moved if shapes[i].shape != "sphere"]
    if which:
        turns = np.concatenate([worlds.runs[k].turns[i] for k, i in which])
        upright = turned(turns, np.array([0.0, 1.0, 0.0]))[:, 1].reshape(len(which), frames)
        leans[tuple(np.array(which).T)] = upright < math.cos(TIPPED)
    return _first(leans, worlds)


def times_landed(worlds: Worlds) -> Floats:
    """[K, B]: when each body first meets the floor (s)."""
    times = np.full((len(worlds.runs), len(worlds.shapes[0])), NEVER)
    for k, run in enumerate(worlds.runs):
        for meeting in run.meetings:
            if meeting.b is None:
                times[k, meeting.a] = min(times[k, meeting.a], meeting.time)
    return times


def times_gone(paths: Sequence[SeenPaths], size: tuple[int, int], worlds: Worlds) -> Floats:
    """[K, B]: when the middle of each body leaves an image of a size (width, height; px), or passes the camera (s)."""
    outside: list[Mask] = []
    for path in paths:
        inside = np.all((path.points >= 0) & (path.points < np.array(size)), axis=2)
        outside.append(~inside | path.passed)
    return _first(np.stack(outside, axis=1), worlds)


def _first(happens: Mask, worlds: Worlds) -> Floats:
    """[K, B]: the time (s) of the first recorded frame in which something is so [K, B, F]."""
    clock = np.arange(happens.shape[2]) * (worlds.every / worlds.fps)
    return np.where(happens, clock, NEVER).min(axis=2)
