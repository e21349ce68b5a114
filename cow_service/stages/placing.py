"""What is put somewhere: its targets among the bodies, the opening that it is to go through, and what became of it."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.errors import CannotGround
from cow_service.narration import bare_name, cannot_stay, place_words
from cow_service.physics.bodies import SeenBody
from cow_service.physics.placement import Placements, Put
from cow_service.physics.world import WorldInput, Worlds
from cow_service.records import BBox, Grounding, Intervention, LocatedObject, Motion, PlacedBefore, Placement
from cow_service.stages.grounding import is_same, placed_mover
from cow_service.stages.paths import visible_share
from cow_service.vision.masks import iou
from cow_service.vision.openings import SeenOpening, measure_opening
from cow_service.vision.regions import SAME_OBJECT_IOU
from cow_service.vision.scene import Scene

BELOW = 4  # px below the outline of a body in which another one that hides it begins
LEAST_STAYING = 0.5  # of the worlds: what stays in fewer where it is put is refused
HIDDEN = 0.25  # of the columns of a body: with so many ending at another one, its foot is hidden


def placing_sentence(grounding: Grounding, placed: Intervention) -> str:
    """In one line, for a video generator."""
    return f"The {bare_name(grounding.object)} is lifted, carried over and put {place_words(placed)}"


def put_of(scene: Scene, grounding: Grounding, motion: Motion, bodies: Sequence[SeenBody]) -> Put | None:
    """Where the mover is seen going; None where it is put nowhere, or before it moves.

    Raises `CannotGround` where nothing says where to, a target was not found or is the mover, or has no opening.
    """
    if motion.kind != "place":
        return None
    placed = placed_mover(grounding)
    if placed is None:
        raise _nowhere(grounding.object)
    return _put(scene, placed, 0, bodies)


def put_before(
    scene: Scene, grounding: Grounding, motion: Motion, bodies: Sequence[SeenBody], *, led: bool = False
) -> tuple[Put, ...]:
    """What is put somewhere before anything moves, in its order; `bodies[0]` is the mover, which may be `led` along a
    path that no contact changes.

    Raises `CannotGround` as `put_of`, and for what is put to the mover while that is put somewhere itself.
    """
    carried = motion.kind == "place"
    found: list[Put] = []
    for each in placed_before(grounding, motion):
        name = each.object.object
        body = 0 if is_same(each.object.bbox, grounding.bbox) else _body(each.object, bodies)
        put = _put(scene, each, body, bodies)
        if carried and 0 in put.targets:
            raise CannotGround(
                f"'{name}' is put {place_words(each)}, which is put somewhere itself, and seen going there last. Ask "
                "of one change at a time."
            )
        if led and body == 0:
            raise CannotGround(
                f"'{name}' cannot be put {place_words(each)} before it moves: its path, which is given or follows the "
                "ballistic law, begins where the image shows it. Leave the path out, or ask for the law `contact`."
            )
        sets_out = 0 in put.targets and motion.kind == "linear"
        if sets_out and put.relation in ("in-front-of", "behind"):
            put = replace(put, by_heading=True)
        found.append(put)
    return tuple(found)


def placed_before(grounding: Grounding, motion: Motion) -> tuple[Intervention, ...]:
    """The interventions that put something somewhere before the motion."""
    carried = placed_mover(grounding) if motion.kind == "place" else None
    return tuple(each for each in grounding.interventions if each.kind == "place" and each is not carried)


def tapered(bodies: Sequence[SeenBody], put: Put | None, before: Sequence[Put]) -> tuple[SeenBody, ...]:
    """The bodies; of those that something is put into, as wide at their lower end as their opening was measured."""
    bottoms = {
        each.targets[0]: each.opening.bottom
        for each in (*before, *([] if put is None else [put]))
        if each.opening is not None and not each.opening.foot_hidden
    }
    return tuple(replace(body, taper=bottoms.get(index, body.taper)) for index, body in enumerate(bodies))


def _put(scene: Scene, placed: Intervention, body: int, bodies: Sequence[SeenBody]) -> Put:
    if placed.relation is None or not placed.targets:
        raise _nowhere(placed.object.object)
    targets = tuple(_body(target, bodies) for target in placed.targets)
    if body in targets:
        raise CannotGround(f"'{bodies[body].name}' cannot be put into, onto or beside itself.")
    if len(set(targets)) < len(targets):
        raise CannotGround(f"'{placed.targets[0].object}' and '{placed.targets[1].object}' were found at one place.")
    opening = _opening(scene, bodies[targets[0]]) if placed.relation == "into" else None
    if opening is not None and _foot_hidden(bodies, targets[0], body):
        opening = replace(opening, foot_hidden=True)
    return Put(placed.relation, targets, opening, _free_side(scene, bodies, targets[0], body), body)


def _nowhere(name: str) -> CannotGround:
    return CannotGround(
        f"Nothing says where '{name}' is put: give an intervention of kind `place` with its `relation` and `targets`."
    )


def placement_of(name: str, shown: Placements | None, around: Placements | None) -> Placement | None:
    """The record of what becomes of what is put somewhere, by the world that is shown and the ensemble around it."""
    return None if shown is None else _told(name, shown, around)


def placed_records(
    interventions: Sequence[Intervention], world: WorldInput, shown: Worlds, around: Worlds | None
) -> tuple[PlacedBefore, ...]:
    """What becomes of each thing that is put somewhere before the motion, by the world that is shown and the ensemble;
    nothing of the world as it is.

    Raises `CannotGround` for what does not stay there, in the world that is shown or in most of the others.
    """
    found: list[PlacedBefore] = []
    for number, put in enumerate(world.put_before):
        each = interventions[number]
        others = None if around is None else around.before[number]
        told = _told(each.object.object, shown.before[number], others)
        visible = visible_share(world.bodies, put.body, shown, world.size)
        more = {"body": put.body, "place": place_words(each), "visible": visible, "by_heading": put.by_heading}
        record = PlacedBefore.model_validate(told.model_dump() | more)
        if not shown.before[number].stays[0] or (others is not None and np.mean(others.stays) < LEAST_STAYING):
            raise CannotGround(f"{cannot_stay(record)} Ask of another place, or of another thing.")
        found.append(record)
    return tuple(found)


def _told(name: str, shown: Placements, around: Placements | None) -> Placement:
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
    return best


def _opening(scene: Scene, target: SeenBody) -> SeenOpening:
    """The opening of a container, by its noun and by its rim in the image."""
    form = None if target.prior is None else target.prior.opening
    if form == "none":
        raise CannotGround(
            f"'{target.name}' is no open container: nothing goes into it. Name a bowl, cup or box, or put it `onto` it."
        )
    seen = measure_opening(scene.clean, target.mask, square=form == "square")
    if form is None and not seen.has_edge:
        raise CannotGround(
            f"No opening is seen in '{target.name}': call it what it is, such as a bowl, a cup or a box."
        )
    return seen


def _foot_hidden(bodies: Sequence[SeenBody], target: int, put: int) -> bool:
    """Whether another thing begins right below a good part of the lower outline of a body."""
    mask = bodies[target].mask
    below = np.zeros(mask.shape, bool)
    for i, body in enumerate(bodies):
        if i not in (put, target) and body.bbox[3] > bodies[target].bbox[3]:
            body.mask.add_to(below)
    columns = np.nonzero(mask.patch.any(axis=0))[0]
    lowest = mask.rows.start + mask.patch.shape[0] - 1 - mask.patch[::-1].argmax(axis=0)
    met = [below[lowest[x] + 1 : lowest[x] + 1 + BELOW, mask.columns.start + x].any() for x in columns]
    return float(np.mean(met)) > HIDDEN


def _free_side(scene: Scene, bodies: Sequence[SeenBody], target: int, put: int) -> int:
    """On which side of a target there is room for a body: 1 right, -1 left; that on which it is, if both."""
    mover, box = bodies[put].bbox, bodies[target].bbox
    wide = mover[2] - mover[0]
    near = 1 if mover[0] + mover[2] > box[0] + box[2] else -1

    def blocked(side: int) -> float:
        middle = (box[0] + box[2]) / 2 + side * ((box[2] - box[0]) / 2 + 0.75 * wide)
        there: BBox = (middle - wide / 2, box[3] - (mover[3] - mover[1]), middle + wide / 2, box[3])
        outside = max(0.0, -there[0], there[2] - scene.width) / wide
        return outside + sum(iou(there, body.bbox) for i, body in enumerate(bodies) if i not in (put, target))

    return near if blocked(near) <= blocked(-near) else -near
