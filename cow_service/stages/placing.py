"""What is put somewhere: its targets among the bodies, the opening that it is to go through, and what became of it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.errors import CannotGround
from cow_service.physics.bodies import SeenBody
from cow_service.physics.carrying import Put
from cow_service.physics.placement import Placements
from cow_service.readers.question.hollow import container_form
from cow_service.readers.question.wording import bare_name
from cow_service.records import BBox, Grounding, Intervention, LocatedObject, Motion, Placement
from cow_service.vision.masks import iou
from cow_service.vision.openings import SeenOpening, measure_opening
from cow_service.vision.regions import SAME_OBJECT_IOU
from cow_service.vision.scene import Scene

BELOW = 4  # px below the outline of a body in which another one that hides it begins
HIDDEN = 0.25  # of the columns of a body: with so many ending at another one, its foot is hidden
PREPOSITIONS = {
    "into": "into", "onto": "onto", "between": "between", "in-front-of": "in front of", "behind": "behind",
    "next-to": "next to", "left-of": "to the left of", "right-of": "to the right of",
}  # fmt: skip


def placed_mover(grounding: Grounding) -> Intervention | None:
    """The intervention that puts the grounded object somewhere; None where it stays or moves by itself."""
    for each in grounding.interventions:
        if each.kind == "place" and iou(each.object.bbox, grounding.bbox) >= SAME_OBJECT_IOU:
            return each
    return None


def placing_sentence(grounding: Grounding, placed: Intervention) -> str:
    """In one line, for a video generator."""
    to = " and ".join(f"the {bare_name(target.object)}" for target in placed.targets)
    where = f"{PREPOSITIONS[placed.relation or 'into']} {to}"
    return f"The {bare_name(grounding.object)} is lifted, carried over and put {where}"


def put_of(scene: Scene, grounding: Grounding, motion: Motion, bodies: Sequence[SeenBody]) -> Put | None:
    """Where the mover is put; None where it is put nowhere.

    Raises `CannotGround` where nothing says where to, a target was not found or is the mover, or has no opening.
    """
    if motion.kind != "place":
        return None
    placed = placed_mover(grounding)
    if placed is None or placed.relation is None or not placed.targets:
        raise CannotGround(
            f"Nothing says where '{grounding.object}' is put: give an intervention of kind `place` with its `relation` "
            "and `targets`."
        )
    targets = tuple(_body(target, bodies) for target in placed.targets)
    if len(set(targets)) < len(targets):
        raise CannotGround(f"'{placed.targets[0].object}' and '{placed.targets[1].object}' were found at one place.")
    opening = _opening(scene, bodies[targets[0]]) if placed.relation == "into" else None
    if opening is not None and _foot_hidden(bodies, targets[0]):
        opening = replace(opening, foot_hidden=True)
    return Put(placed.relation, targets, opening, _free_side(scene, bodies, targets[0]))


def placement_of(name: str, shown: Placements | None, around: Placements | None) -> Placement | None:
    """The record of what becomes of what is put somewhere, by the world that is shown and the ensemble around it."""
    if shown is None:
        return None
    counted = Counter(()) if around is None else Counter(around.results)
    return Placement(
        object=name,
        result=shown.results[0],
        probabilities={result: count / counted.total() for result, count in sorted(counted.items())},
        fits=None if around is None else float(np.mean(around.fits)),
        clearance=_finite(float(shown.clearance[0])),
        above_rim=_finite(float(shown.above_rim[0])),
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _body(target: LocatedObject, bodies: Sequence[SeenBody]) -> int:
    """Which body a target is."""
    shared = [iou(target.bbox, body.bbox) for body in bodies]
    best = int(np.argmax(shared))
    if shared[best] < SAME_OBJECT_IOU:
        raise CannotGround(f"'{target.object}' was not found as an object of its own.")
    if best == 0:
        raise CannotGround(f"'{bodies[0].name}' cannot be put into, onto or beside itself.")
    return best


def _opening(scene: Scene, target: SeenBody) -> SeenOpening:
    """The opening of a container, by its noun and by its rim in the image."""
    form = container_form(target.name)
    if form == "none":
        raise CannotGround(
            f"'{target.name}' is no open container: nothing goes into it. Name a bowl, cup or box, or put it `onto` it."
        )
    seen = measure_opening(scene.clean, target.mask, square=form == "square")
    if form == "unknown" and not seen.has_edge:
        raise CannotGround(
            f"No opening is seen in '{target.name}': call it what it is, such as a bowl, a cup or a box."
        )
    return seen


def _foot_hidden(bodies: Sequence[SeenBody], target: int) -> bool:
    """Whether another thing begins right below a good part of the lower outline of a body."""
    mask = bodies[target].mask
    below = np.zeros(mask.shape, bool)
    for i, body in enumerate(bodies):
        if i not in (0, target) and body.bbox[3] > bodies[target].bbox[3]:
            body.mask.add_to(below)
    columns = np.nonzero(mask.patch.any(axis=0))[0]
    lowest = mask.rows.start + mask.patch.shape[0] - 1 - mask.patch[::-1].argmax(axis=0)
    met = [below[lowest[x] + 1 : lowest[x] + 1 + BELOW, mask.columns.start + x].any() for x in columns]
    return float(np.mean(met)) > HIDDEN


def _free_side(scene: Scene, bodies: Sequence[SeenBody], target: int) -> int:
    """On which side of a target there is room for the first body: 1 right, -1 left; that on which it is, if both."""
    mover, box = bodies[0].bbox, bodies[target].bbox
    wide = mover[2] - mover[0]
    near = 1 if mover[0] + mover[2] > box[0] + box[2] else -1

    def blocked(side: int) -> float:
        middle = (box[0] + box[2]) / 2 + side * ((box[2] - box[0]) / 2 + 0.75 * wide)
        there: BBox = (middle - wide / 2, box[3] - (mover[3] - mover[1]), middle + wide / 2, box[3])
        outside = max(0.0, -there[0], there[2] - scene.width) / wide
        return outside + sum(iou(there, body.bbox) for i, body in enumerate(bodies) if i not in (0, target))

    return near if blocked(near) <= blocked(-near) else -near
