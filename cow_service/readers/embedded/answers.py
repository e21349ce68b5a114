"""What can be said of a what-if question without a model: by encounters, by where a throw comes down, or by an axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.physics.dynamics import DEFAULT_SPEED
from cow_service.physics.encounters import Sweep, find_encounters
from cow_service.physics.landing import rolls_into
from cow_service.readers.base import AnswerReading
from cow_service.readers.question.choices import not_sure_option, plain, says_not_sure
from cow_service.readers.question.relations import AskedRelation, Relation, read_relation
from cow_service.readers.question.sentences import Question
from cow_service.records import AnswerOption, EncounterKind, Grounding, LocatedObject, Simulation, Vector
from cow_service.vision.obstacles import Obstacle
from cow_service.vision.scene import Scene

# Encounters that make the answer yes. What touches a thing in the picture stands before a part of it.
YES_BY: dict[Relation, frozenset[EncounterKind]] = {
    "touches": frozenset(("touches",)),
    "covers": frozenset(("occludes", "touches")),
    "covered": frozenset(("occluded-by",)),
}
VEHICLES = frozenset(
    {"car", "truck", "bus", "train", "van", "lorry", "jeep", "taxi", "tram", "tractor", "wagon", "locomotive", "boat"}
)
MIN_ELONGATION = 1.3  # length of a silhouette over its breadth, from which its axis is that of the vehicle
AXIS_ERROR = 12.0  # degrees that the axis may be off, either way
HEADING_STEP = 4.0  # degrees between the headings that are tried
CLIP_SECONDS, CLIP_FPS = 5.0, 16.0  # of a clip of the default length
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


@dataclass(frozen=True)
class Decision:
    """Whether what the question asks happens, null where nothing tells; and why, where that is not plain to see."""

    happens: bool | None
    why: str = ""


def decide(
    scene: Scene, question: Question, own_grounding: Grounding | None, simulation: Simulation | None
) -> Decision:
    """What can be said of the question. `own_grounding` is null where another reader grounded the mover."""
    asked = read_relation(question)
    if asked is None:
        return Decision(None, NOT_ASKED)
    if simulation is None:
        stays_clear = own_grounding is not None and _stays_clear(scene, question, asked, own_grounding)
        return Decision(False, AXIS) if stays_clear else Decision(None, NO_SIMULATION)
    motion = simulation.motion
    if motion.kind == "projectile" and motion.source != "request":  # its speed is assumed, and there is no floor
        return _by_landing(scene, asked, simulation)
    happens = _by_encounters(simulation, asked)
    return Decision(happens, NOT_FOUND if happens is None else "")


def choose_option(options: Sequence[AnswerOption], happens: bool | None) -> AnswerReading:
    """Yes or no as the options word it; not sure where nothing was decided, or the options are not yes and no."""
    if happens is not None and not options:
        return AnswerReading("Yes" if happens else "No", False)
    unsure = not_sure_option(options)
    notes: tuple[str, ...] = ()
    if happens is not None:
        sure = [option for option in options if not says_not_sure(option.text)]
        yes, no = ([o for o in sure if plain(o.text).split()[:1] == [word]] for word in ("yes", "no"))
        if len(yes) == len(no) == 1:
            return AnswerReading((yes if happens else no)[0].letter, False)
        notes = (f"What is asked {'happens' if happens else 'does not happen'}, but the options are not yes and no.",)
    return AnswerReading(None if unsure is None else unsure.letter, True, notes=notes)


def _located(asked: AskedRelation, others: Sequence[LocatedObject]) -> LocatedObject | None:
    """The thing that is asked about, where it was found by that name."""
    name = None if asked.target is None else plain(asked.target.text)
    return next((other for other in others if plain(other.object) == name), None)


def _by_encounters(simulation: Simulation, asked: AskedRelation) -> bool | None:
    """Whether what is asked happens, by the encounters of a simulation; None where they cannot tell."""
    if not simulation.encounters_known:
        return None
    met = [encounter for encounter in simulation.trajectory.encounters if encounter.kind in YES_BY[asked.relation]]
    if asked.target is None:
        return True if met else None
    target = _located(asked, simulation.grounding.others)
    return None if target is None else any(encounter.object == target.object for encounter in met)


def _by_landing(scene: Scene, asked: AskedRelation, simulation: Simulation) -> Decision:
    """What is thrown comes down and rolls on: what it then runs into does not depend on its speed."""
    grounding, direction = simulation.grounding, simulation.motion.direction
    target = _located(asked, grounding.others)
    if asked.relation != "touches" or target is None or direction is None:
        return Decision(None, NOT_FOUND if target is None else NO_LANDING)
    obstacles = scene.obstacles(grounding.bbox, grounding.others)
    happens = rolls_into(scene, grounding.bbox, direction, target.bbox, obstacles)
    return Decision(happens, NO_LANDING if happens is None else LANDING)


def _stays_clear(scene: Scene, question: Question, asked: AskedRelation, grounding: Grounding) -> bool:
    """Whether a vehicle meets the target neither forward nor backward along its own axis.

    Which end is its front is not known, so that this never decides for yes.
    """
    target, mover = _located(asked, grounding.others), question.mover
    if target is None or mover is None or mover.head not in VEHICLES or question.motion.forward is None:
        return False
    axis = _axis(scene, grounding)
    obstacles = [o for o in scene.obstacles(grounding.bbox, grounding.others) if o.name == target.object]
    if axis is None or not obstacles:
        return False
    offsets = np.arange(-AXIS_ERROR, AXIS_ERROR + HEADING_STEP / 2, HEADING_STEP)
    headings = [math.radians(axis + offset + turn) for turn in (0.0, 180.0) for offset in offsets]
    directions = ((math.cos(heading), math.sin(heading)) for heading in headings)
    return not any(_meets(scene, grounding, direction, obstacles, asked) for direction in directions)


def _axis(scene: Scene, grounding: Grounding) -> float | None:
    """Degrees of the long axis of the mover's silhouette in the image; None where it has none to speak of."""
    ys, xs = np.nonzero(scene.silhouette(grounding.bbox))
    if len(xs) < 16:
        return None
    spread, axes = np.linalg.eigh(np.cov(np.stack([xs, ys])))
    if spread[1] < MIN_ELONGATION**2 * spread[0]:
        return None
    return math.degrees(math.atan2(axes[1, 1], axes[0, 1]))


def _meets(
    scene: Scene, grounding: Grounding, direction: Vector, obstacles: Sequence[Obstacle], asked: AskedRelation
) -> bool:
    x0, y0, x1, y1 = grounding.bbox
    start = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    times = np.arange(0, CLIP_SECONDS, 1 / CLIP_FPS)
    points = start + np.outer(times, DEFAULT_SPEED * scene.width * np.array(direction))
    inside = np.all((points >= 0) & (points < [scene.width, scene.height]), axis=1)
    mask = scene.silhouette(grounding.bbox)
    sweep = Sweep(mask, grounding.bbox, start, points, np.ones(len(times)), inside, airborne=False)
    return any(encounter.kind in YES_BY[asked.relation] for encounter in find_encounters(sweep, obstacles))
