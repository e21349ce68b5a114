"""What can be said of a what-if question without a model: by encounters, by where a throw comes down, or by an axis."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cow_service.physics.dynamics import DEFAULT_SPEED
from cow_service.physics.encounters import Sweep, find_encounters
from cow_service.physics.landing import rolls_into
from cow_service.readers.base import GroundingReading
from cow_service.readers.encounter_answers import Asked, decided_by, located, read_asked
from cow_service.readers.sentences import Question
from cow_service.records import Simulation, Vector
from cow_service.vision.obstacles import Obstacle, obstacles_of
from cow_service.vision.scene import Scene

VEHICLES = frozenset(
    {"car", "truck", "bus", "train", "van", "lorry", "jeep", "taxi", "tram", "tractor", "wagon", "locomotive", "boat"}
)
ELONGATED = 1.3  # length of a silhouette over its breadth, from which its axis is that of the vehicle
DOUBT = 12.0  # degrees that the axis may be off, either way
STEP = 4.0  # degrees between the headings that are tried
CLIP, RATE = 5.0, 16.0  # s and per s: as far as a clip of the default length looks


def judge(
    scene: Scene, question: Question, grounded: GroundingReading | None, simulation: Simulation | None
) -> bool | None:
    """Whether what the question asks happens; None where nothing tells.

    `grounded` is what was read of the image before, where the reader grounded it itself.
    """
    asked = read_asked(question)
    if asked is None:
        return None
    if simulation is None:
        return None if grounded is None else _whichever_end_is_front(scene, question, asked, grounded)
    motion = simulation.motion
    if motion.kind == "projectile" and motion.source != "request":  # its speed is assumed, and there is no floor
        return _after_landing(scene, asked, simulation)
    return decided_by(simulation, asked)


def _after_landing(scene: Scene, asked: Asked, simulation: Simulation) -> bool | None:
    """What is thrown comes down and rolls on: what it then runs into does not depend on its speed."""
    grounding, direction = simulation.grounding, simulation.motion.direction
    target = located(asked, grounding.others)
    if asked.relation != "touches" or target is None or direction is None:
        return None
    obstacles = obstacles_of(scene, grounding.bbox, grounding.others)
    return rolls_into(scene, grounding.bbox, direction, target.bbox, obstacles)


def _whichever_end_is_front(scene: Scene, question: Question, asked: Asked, grounded: GroundingReading) -> bool | None:
    """A vehicle moves along its own axis: what it meets neither forward nor backward it does not meet.

    Which end is its front is not known, so that this never says yes.
    """
    mover, target = question.mover, located(asked, grounded.others)
    if mover is None or mover.head not in VEHICLES or question.motion.forward is None or target is None:
        return None
    axis = _axis(scene, grounded)
    if axis is None:
        return None
    obstacles = [o for o in obstacles_of(scene, grounded.bbox, grounded.others) if o.name == target.object]
    offsets = np.arange(-DOUBT, DOUBT + STEP / 2, STEP)
    headings = [axis + offset + turn for turn in (0.0, 180.0) for offset in offsets]
    met = any(_meets(scene, grounded, _unit(heading), obstacles, asked) for heading in headings)
    return None if met or not obstacles else False


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
