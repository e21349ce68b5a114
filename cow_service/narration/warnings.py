"""Warnings of a trajectory, in English: what a caller should know beyond what it says."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from cow_service import records

if TYPE_CHECKING:
    from cow_service.records import Grounding, PlacedBefore, Trajectory
    from cow_service.requests import SimulateRequest

SURE = 0.9  # share of the worlds: where something is as it was meant in fewer, a warning says so
HARDLY_SEEN = 0.25  # share of a thing that is seen
_DOES_NOT_STAY: dict[records.PlacementResult, str] = {
    "overlaps": "there is no room for it",
    "falls-off": "it falls off",
    "tips": "it tips over, or knocks something over",
}
_NOT_AS_MEANT: dict[records.PlacementResult, str] = {
    "sticks-out": "goes in but sticks out",
    "on-the-rim": "does not go in: it stays on the rim",
}


def cannot_stay(placed: PlacedBefore) -> str:
    """Why something cannot be put somewhere, in a sentence."""
    faults: list[records.PlacementResult] = [result for result in _DOES_NOT_STAY if result in placed.probabilities]
    result = placed.result
    if result not in _DOES_NOT_STAY:
        result = max(faults, key=lambda fault: placed.probabilities[fault])
    share = placed.probabilities.get(result)
    sure = "" if share is None else f" ({share:.0%} of the computed worlds)"
    return f"'{placed.object}' cannot be put {placed.place}: {_DOES_NOT_STAY[result]}{sure}."


def doubts_of(placed: PlacedBefore) -> tuple[str, ...]:
    """What is in doubt of something that is put somewhere, in sentences: whether it stays there, and is seen."""
    told, where = list[str](), f"'{placed.object}', put {placed.place},"
    if placed.result in _NOT_AS_MEANT:
        told.append(f"{where} {_NOT_AS_MEANT[placed.result]}.")
    elif placed.fits is not None and placed.fits < SURE:
        told.append(f"{where} ends up as intended in {placed.fits:.0%} of the simulated versions.")
    if placed.visible < HARDLY_SEEN:
        told.append(f"{where} is hardly visible in the frames: something hides it, or it is outside the image.")
    return tuple(told)


APART = 3.0  # degrees between two pitches of one camera
OFF_CENTRE = 0.25  # of the object's size: a given path that begins further from its centre is remarked on


def warnings_of(request: SimulateRequest, grounding: Grounding, trajectory: Trajectory) -> tuple[str, ...]:
    """What a caller should know of a trajectory beside what it says, in sentences."""
    found = list[str]()
    if not trajectory.encounters_known:
        found.append(
            "The surroundings could not be separated into objects, so encounters were not computed: "
            "an empty list does not mean that nothing is hit."
        )
    found += warnings_of_path(request, grounding)
    found += _of_depth(request, grounding, trajectory)
    found += [
        f"Something else may stand at ({(left + right) / 2:.0f}, {bottom:.0f}); it is not simulated."
        for left, _, right, bottom in trajectory.faint
    ]
    found += warnings_of_outlines(trajectory)
    found += [doubt for placed in trajectory.placed for doubt in doubts_of(placed)]
    found += [
        f"'{each.object}', put {each.place}, was placed relative to the direction of motion, not as the camera sees it."
        for each in trajectory.placed
        if each.by_heading
    ]
    if trajectory.factual is not None and trajectory.placed:
        put = {each.body for each in trajectory.placed}
        found += [
            f"'{body.object}' makes room for what is put there, so it does not start where the image shows it."
            for index, (body, seen) in enumerate(zip(trajectory.bodies, trajectory.factual.bodies, strict=False))
            if index not in put and body.bbox != seen.bbox
        ]
    return tuple(found)


def warnings_of_path(request: SimulateRequest, grounding: Grounding) -> list[str]:
    """Where a given path goes beside the motion, the object or the clip that were given with it, in sentences."""
    given, found = request.trajectory, list[str]()
    if given is None:
        return []
    if request.whole_motion is not None:
        found.append(
            "Both `motion` and `trajectory` were given: the object follows the trajectory; the motion only words it."
        )
    x0, y0, x1, y1 = grounding.bbox
    gap = math.dist(given.points[0], grounding.point)
    if request.grounding is not None and gap > OFF_CENTRE * max(x1 - x0, y1 - y0):
        found.append(
            f"The given trajectory starts {gap:.0f} px from the object's centre; the first frame shows it there."
        )
    # A path that ends where the clip does, or a frame beside it, is of its length.
    clip, path = (request.num_frames - 1) / request.fps, (len(given.points) - 1) / given.fps
    if abs(path - clip) * request.fps > 1.5:
        happens = (
            "the end of the path is not shown" if path > clip else "after the path ends, the object stays where it is"
        )
        found.append(f"The given trajectory lasts {path:.2f} s and the clip {clip:.2f} s: {happens}.")
    return found


def warnings_of_outlines(trajectory: Trajectory) -> list[str]:
    """What was not seen clearly and matters to the outcome, in sentences."""
    outcome = trajectory.outcome
    if outcome is None or "outline" not in outcome.depends_on:
        return []
    met = {each.object for each in trajectory.encounters}
    matter = {trajectory.bodies[0].object, outcome.subject, outcome.object, *outcome.asked.among} | met
    return [
        f"'{body.object}' was not seen clearly: give its box in `objects` to get an answer that may rely on it."
        for body in trajectory.bodies
        if not body.is_clear and body.object in matter
    ]


def _of_depth(request: SimulateRequest, grounding: Grounding, trajectory: Trajectory) -> list[str]:
    """What a caller should know of how the depth map was used, in sentences."""
    camera, depth = trajectory.camera, trajectory.depth
    if camera is None or (depth is None and request.depth is None):
        return []
    if depth is None:
        return ["The depth map was not used: the path was given, or the law is `ballistic`."]
    if not depth.is_of_scene:
        if depth.floor is not None:
            why = f"does not show '{grounding.object}' as something standing above the floor where the image shows it"
        elif camera.source == "side-view":
            why = "was given for a drawing seen from the side"
        else:
            why = "shows no floor for things to stand on"
        given = depth.source == "request"
        remedy = "Leave `depth` out, or give another map" if given else "Give a map as `depth`, or another picture"
        return [f"The depth map {why}, so there is no answer from it. {remedy}."]
    told = [
        f"The depth map does not show '{body.object}' as something standing above the floor where the image shows it."
        for body in trajectory.bodies
        if body.footprint is not None and body.footprint.seen == 0
    ]
    pitch = None if request.camera is None else request.camera.pitch
    if pitch is not None and abs(camera.pitch - pitch) > APART:
        seen = f"the floor of the depth map says {camera.pitch:.0f}; the depth map is used"
        told.append(f"`camera.pitch` is {pitch:g} degrees, but {seen}.")
    return told
