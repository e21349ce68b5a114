"""Warnings about a simulation as a whole: what was understood in one way and could be meant in another."""

from __future__ import annotations

import math

from cow_service.narration import doubts_of
from cow_service.records import Grounding, Trajectory
from cow_service.requests import SimulateRequest

OFF_CENTRE = 0.25  # of the object's size: a given path that begins further from its centre is remarked on


def warnings_of(request: SimulateRequest, grounding: Grounding, trajectory: Trajectory) -> tuple[str, ...]:
    """Warnings, in whole sentences; empty where there is nothing to say."""
    found = (
        _no_surroundings(trajectory),
        _motion_beside_path(request),
        _path_off_object(request, grounding),
        _path_of_another_length(request),
    )
    doubts = [doubt for placed in trajectory.placed for doubt in doubts_of(placed)]
    return (*(told for told in found if told is not None), *doubts, *_by_heading(trajectory), *_made_room(trajectory))


def _by_heading(trajectory: Trajectory) -> tuple[str, ...]:
    """Where things are in front of or behind the mover, by the way that it goes."""
    return tuple(
        f"'{each.object}', put {each.place}, was put there by the way in which that moves, not as the camera sees it."
        for each in trajectory.placed
        if each.by_heading
    )


def _made_room(trajectory: Trajectory) -> tuple[str, ...]:
    """What is not put anywhere, and does not begin where the image shows it."""
    if trajectory.factual is None or not trajectory.placed:
        return ()
    put = {each.body for each in trajectory.placed}
    pairs = enumerate(zip(trajectory.bodies, trajectory.factual.bodies, strict=False))
    return tuple(
        f"'{body.object}' makes room for what is put there: it does not begin where the image shows it."
        for index, (body, seen) in pairs
        if index not in put and body.bbox != seen.bbox
    )


def _no_surroundings(trajectory: Trajectory) -> str | None:
    if trajectory.encounters_known:
        return None
    return (
        "The surroundings could not be separated into objects, so encounters were not computed: "
        "an empty list does not mean that nothing is hit."
    )


def _motion_beside_path(request: SimulateRequest) -> str | None:
    if request.stated_motion is None or request.trajectory is None:
        return None
    return "Both `motion` and `trajectory` were given: the object follows the trajectory, the motion only words it."


def _path_off_object(request: SimulateRequest, grounding: Grounding) -> str | None:
    if request.trajectory is None or request.grounding is None:
        return None
    x0, y0, x1, y1 = grounding.bbox
    gap = math.dist(request.trajectory.points[0], grounding.point)
    if gap <= OFF_CENTRE * max(x1 - x0, y1 - y0):
        return None
    return f"The given trajectory begins {gap:.0f} px from the object's centre: in the first frame it is drawn there."


def _path_of_another_length(request: SimulateRequest) -> str | None:
    """A path that ends where the clip does, or a frame beside it, is of its length."""
    if request.trajectory is None:
        return None
    path = (len(request.trajectory.points) - 1) / request.trajectory.fps
    clip = (request.num_frames - 1) / request.fps
    if abs(path - clip) * request.fps <= 1.5:
        return None
    happens = "its rest is not shown" if path > clip else "from its end on the object stays where it is"
    return f"The given trajectory lasts {path:.2f} s and the clip {clip:.2f} s: {happens}."
