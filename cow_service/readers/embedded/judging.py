"""What can be said of a what-if question without a model: by encounters, by where a throw comes down, or by an axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.physics.dynamics import DEFAULT_SPEED
from cow_service.physics.encounters import Sweep, find_encounters
from cow_service.physics.landing import rolls_into
from cow_service.readers.base import GroundingReading
from cow_service.readers.embedded.encounter_answers import Asked, decided_by, located, read_asked
from cow_service.readers.question.sentences import Question
from cow_service.records import Simulation, Vector
from cow_service.vision.obstacles import Obstacle, obstacles_of
from cow_service.vision.scene import Scene

VEHICLES = frozenset(
    {"car", "truck", "bus", "train", "van", "lorry", "jeep", "taxi", "tram", "tractor", "wagon", "locomotive", "boat"}
)
ELONGATED = 1.3  # length of a silhouette over its breadth, from which its axis is that of the vehicle
DOUBT = 12.0  # degrees that the axis may be off, either way
STEP = 4.0  # degrees between the headings that are tried
NOT_ASKED = (
    "Not sure, because the embedded reader decides only plain yes/no questions: whether the mover hits, lands on, "
    "hides or is hidden by one thing. Set COW_MLLM to ask a multimodal LLM."
)
NO_SIMULATION = "Not sure, because without a simulation there are no encounters for the embedded reader to judge by."
NOT_FOUND = "Not sure, because what the question asks about was not found in the image under that name."
LANDING = "Decided by where the mover's shadow shows that it comes down and rolls on: its trajectory here has no floor."
NO_LANDING = (
    "Not sure, because a throw is decided by where its shadow shows that it comes down, and none was found, or it is "
    "too close to call."
)
AXIS = "Decided by the mover's own axis: along it nothing of what is asked happens, whichever end is its front."
CLIP, RATE = 5.0, 16.0  # s and per s: as far as a clip of the default length looks


@dataclass(frozen=True)
class Judgement:
    """Whether what the question asks happens, null where nothing tells; and why, where that is not plain to see."""

    happens: bool | None
    why: str = ""


def judge(
    scene: Scene, question: Question, grounded: GroundingReading | None, simulation: Simulation | None
) -> Judgement:
    """What can be said of the question. `grounded` is what was read of the image, where this reader grounded it."""
    asked = read_asked(question)
    if asked is None:
        return Judgement(None, NOT_ASKED)
    if simulation is None:
        return _whichever_end_is_front(scene, question, asked, grounded)
    motion = simulation.motion
    if motion.kind == "projectile" and motion.source != "request":  # its speed is assumed, and there is no floor
        return _after_landing(scene, asked, simulation)
    happens = decided_by(simulation, asked)
    return Judgement(happens, NOT_FOUND if happens is None else "")


def _after_landing(scene: Scene, asked: Asked, simulation: Simulation) -> Judgement:
    """What is thrown comes down and rolls on: what it then runs into does not depend on its speed."""
    grounding, direction = simulation.grounding, simulation.motion.direction
    target = located(asked, grounding.others)
    if asked.relation != "touches" or target is None or direction is None:
        return Judgement(None, NOT_FOUND if target is None else NO_LANDING)
    obstacles = obstacles_of(scene, grounding.bbox, grounding.others)
    happens = rolls_into(scene, grounding.bbox, direction, target.bbox, obstacles)
    return Judgement(happens, NO_LANDING if happens is None else LANDING)


def _whichever_end_is_front(
    scene: Scene, question: Question, asked: Asked, grounded: GroundingReading | None
) -> Judgement:
    """A vehicle moves along its own axis: what it meets neither forward nor backward it does not meet.

    Which end is its front is not known, so that this never says yes.
    """
    target = None if grounded is None else located(asked, grounded.others)
    mover = question.mover
    if grounded is None or target is None or mover is None:
        return Judgement(None, NO_SIMULATION)
    axis = _axis(scene, grounded)
    if mover.head not in VEHICLES or question.motion.forward is None or axis is None:
        return Judgement(None, NO_SIMULATION)
    obstacles = [o for o in obstacles_of(scene, grounded.bbox, grounded.others) if o.name == target.object]
    offsets = np.arange(-DOUBT, DOUBT + STEP / 2, STEP)
    headings = [axis + offset + turn for turn in (0.0, 180.0) for offset in offsets]
    if not obstacles or any(_meets(scene, grounded, _unit(heading), obstacles, asked) for heading in headings):
        return Judgement(None, NO_SIMULATION)
    return Judgement(False, AXIS)


def _axis(scene: Scene, grounded: GroundingReading) -> float | None:
    """Degrees of the long axis of the mover's silhouette in the image; None where it has none to speak of."""
    ys, xs = np.nonzero(scene.silhouette(grounded.bbox))
    if len(xs) < 16:
        return None
    spread, axes = np.linalg.eigh(np.cov(np.stack([xs, ys])))
    if spread[1] < ELONGATED**2 * spread[0]:
        return None
    return math.degrees(math.atan2(axes[1, 1], axes[0, 1]))


def _meets(
    scene: Scene, grounded: GroundingReading, heading: Vector, obstacles: Sequence[Obstacle], asked: Asked
) -> bool:
    x0, y0, x1, y1 = grounded.bbox
    start = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    times = np.arange(0, CLIP, 1 / RATE)
    points = start + np.outer(times, DEFAULT_SPEED * scene.width * np.array(heading))
    inside = np.all((points >= 0) & (points < [scene.width, scene.height]), axis=1)
    mask = scene.silhouette(grounded.bbox)
    sweep = Sweep(mask, grounded.bbox, start, points, np.ones(len(times)), inside, airborne=False)
    return any(encounter.kind in asked.kinds for encounter in find_encounters(sweep, obstacles))


def _unit(degrees: float) -> Vector:
    return math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
