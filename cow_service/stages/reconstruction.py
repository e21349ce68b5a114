"""What stage 3 simulates: the bodies that the image shows, the camera that sees them, and what is put where first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cow_service.errors import CannotGround
from cow_service.narration import place_words
from cow_service.physics.ballistic import FreePath, ballistic_path, given_path
from cow_service.physics.bodies import SeenBody
from cow_service.physics.camera import Camera, CameraFit, fit_shadow, prior
from cow_service.physics.layout import flies
from cow_service.physics.outcome import Query
from cow_service.physics.placement import PlacementGoal
from cow_service.physics.world import PrescribedMotion, WorldInput
from cow_service.readers.options import plain
from cow_service.records import BBox, Grounding, Intervention, LocatedObject, Motion, Shape
from cow_service.requests import CameraRequest, SimulateRequest
from cow_service.stages.grounding import is_same, others_of, placed_mover
from cow_service.vision.masks import CroppedMask, iou
from cow_service.vision.openings import SeenOpening, measure_opening
from cow_service.vision.regions import SAME_OBJECT_IOU
from cow_service.vision.scene import Obstacle, Scene
from cow_service.vision.shadows import find_shadow

PART = 0.5  # of a region's area: with more of it inside a thing that is removed, it is a part of that
BELOW = 4  # px below the outline of a body in which another one that hides it begins
HIDDEN = 0.25  # of the columns of a body: with so many ending at another one, its foot is hidden
GIVEN_PITCH_SIGMA, GIVEN_ROLL_SIGMA = math.radians(1.0), math.radians(0.5)
GIVEN_FOCAL_SIGMA = 0.02  # of the logarithm
FIXED = 1e-6  # deviation of a focal length that must not vary
_OF_EACH_MOVER = ("kind", "direction", "depth", "speed", "speed_deviation")


@dataclass(frozen=True)
class Situation:
    """What stage 3 starts from: the image and its objects, how one of them moves, and what the request wants."""

    scene: Scene
    grounding: Grounding
    motion: Motion
    request: SimulateRequest
    obstacles: Sequence[Obstacle]
    removed: Sequence[Obstacle] = ()

    @staticmethod
    def of(scene: Scene, grounding: Grounding, motion: Motion, request: SimulateRequest) -> Situation:
        """With the obstacles that the scene shows."""
        return Situation(scene, grounding, motion, request, *obstacles_of(scene, grounding))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, px."""
        return self.scene.width, self.scene.height

    @property
    def is_separated(self) -> bool:
        """Whether the surroundings could be told apart into objects."""
        return bool(self.scene.regions or self.obstacles or self.removed)


def obstacles_of(scene: Scene, grounding: Grounding) -> tuple[tuple[Obstacle, ...], tuple[Obstacle, ...]]:
    """What stands beside the mover, and what of it is removed before the motion."""
    removed, others = _removed(grounding), others_of(grounding)
    found = scene.obstacles(grounding.bbox, (*others, *removed))
    gone, named = {each.bbox for each in removed}, {other.bbox for other in others}
    taken = tuple(each for each in found if each.bbox in gone)
    masks = [each.mask.full() for each in taken]
    # A part of what is removed, such as its lit top, may have been found as a region of its own.
    parts = {each.bbox for each in found if any(each.mask.shared_with(m) > PART * each.mask.area for m in masks)}
    kept = (each for each in found if each.bbox not in gone and (each.bbox in named or each.bbox not in parts))
    return tuple(kept), taken


def reconstruct(situation: Situation, path: FreePath | None) -> tuple[WorldInput, Query | None]:
    """The world, and what is asked of its bodies: None where one that the question names was not found.

    Raises `CannotGround` for what cannot be put where the question or the request puts it.
    """
    motion, request = situation.motion, situation.request
    bodies = seen_bodies(situation)
    present = bodies[: 1 + len(situation.obstacles)]
    query = query_of(situation.grounding, bodies)
    goal = placement_goal(situation, present)
    goals = placement_goals(situation, present, follows_path=path is not None)
    in_air = flies(bodies[0], motion) and bodies[0].shape == "sphere"
    target = None if query is None else query.target
    prescribed = None
    if path is not None:
        to_foot = np.array(bodies[0].foot) - np.array(situation.grounding.point)
        prescribed = PrescribedMotion(path.states[:, :3], path.points + to_foot)
    world = WorldInput(
        bodies=_with_openings(present, goals if goal is None else (*goals, goal)),
        motion=motion,
        fit=camera_of(situation.scene, motion, request.camera, bodies[0].bbox if in_air else None, path is not None),
        size=situation.size,
        num_frames=request.num_frames,
        fps=request.fps,
        # People aim at what they ask about; where that is put elsewhere, not at its place in the image.
        asked=None if target in [each.body for each in goals] else target,
        prescribed=prescribed,
        others={} if path is not None else _motions_of_others(bodies, motion),
        removed=bodies[len(present) :],
        turns_wanted=query is not None and query.asked.relation == "tips",
        placement=goal,
        placed_before=goals,
    )
    return world, query


def free_path(situation: Situation) -> FreePath | None:
    """The path that no contact changes, where the request gives it or the law is ballistic."""
    request, motion = situation.request, situation.motion
    times = np.arange(request.num_frames) / request.fps
    camera = Camera(*situation.size, motion.metres_per_pixel.value)
    if request.trajectory is not None:
        return given_path(camera, request.trajectory, times)
    is_free = motion.law == "ballistic" and motion.kind != "place"
    return ballistic_path(camera, situation.grounding, motion, times) if is_free else None


def _motions_of_others(bodies: Sequence[SeenBody], motion: Motion) -> dict[int, Motion]:
    """The motions of other bodies that are set moving, by their places among the bodies."""
    alone = {"distance": None, "duration": None, "until": None, "steps": (), "others": (), "trail": ()}
    return {
        i: motion.model_copy(update=alone | {name: getattr(other, name) for name in _OF_EACH_MOVER})
        for other in motion.others
        for i, body in enumerate(bodies)
        if i and body.bbox == other.object.bbox
    }


# --- bodies


def seen_bodies(situation: Situation) -> tuple[SeenBody, ...]:
    """The mover, then the obstacles, then what is removed."""
    scene, grounding = situation.scene, situation.grounding
    located = {other.bbox: other for other in (*others_of(grounding), *_removed(grounding))}
    mover = LocatedObject(object=grounding.object, bbox=grounding.bbox, prior=grounding.prior, source=grounding.source)
    first = Obstacle(mover.object, mover.bbox, CroppedMask.of(scene.silhouette(mover.bbox)))
    bodies = [_seen_body(scene, first, mover)]
    if mover.prior is not None:
        bodies[0] = replace(bodies[0], elongated=mover.prior.elongated, equal_sided=mover.prior.equal_sided)
    bodies += [_seen_body(scene, each, located.get(each.bbox)) for each in (*situation.obstacles, *situation.removed)]
    return tuple(bodies)


def _seen_body(scene: Scene, seen: Obstacle, located: LocatedObject | None) -> SeenBody:
    prior, region = None if located is None else located.prior, scene.region_of(seen.bbox)
    # Where nothing is said of its shape, a disc is a sphere, and the rest stands upright.
    seen_shape: Shape = "sphere" if region is not None and region.is_disc else "cylinder"
    return SeenBody(
        name=seen.name,
        bbox=seen.bbox,
        mask=seen.mask,
        shape=seen_shape if prior is None or prior.shape is None else prior.shape,
        source=(None if located is None else located.source) or "embedded",
        confidence=seen.confidence,
        prior=prior,
    )


def query_of(grounding: Grounding, bodies: Sequence[SeenBody]) -> Query | None:
    """What is asked of bodies; None where nothing is, or one that is named was not found under that name."""
    asked = grounding.asked
    if asked is None:
        return None
    subjects = (0,) if asked.subject is None else _named(asked.subject, grounding, bodies)
    targets = (None,) if asked.target is None else _named(asked.target, grounding, bodies)
    among = [_named(name, grounding, bodies) for name in asked.among]
    if not subjects or not targets or not all(among):
        return None
    known = tuple(dict.fromkeys(body for meant in among for body in meant))
    named = asked.model_copy(update={"among": tuple(bodies[body].name for body in known)})
    return Query(named, targets[0], subjects[0], known)


def _named(words: str, grounding: Grounding, bodies: Sequence[SeenBody]) -> tuple[int, ...]:
    """The bodies that were found under a name."""
    name = plain(words)
    if name == plain(grounding.object):
        return (0,)
    located = (*others_of(grounding), *_removed(grounding))
    boxes = {other.bbox for other in located if plain(other.object) == name}
    return tuple(i for i, body in enumerate(bodies) if i and body.bbox in boxes)


def _removed(grounding: Grounding) -> tuple[LocatedObject, ...]:
    return tuple(each.object for each in grounding.interventions if each.kind == "remove")


# --- the camera


def camera_of(
    scene: Scene, motion: Motion, given: CameraRequest | None, flying: BBox | None, fixed_focal: bool
) -> CameraFit:
    """The camera, by the shadow of what flies in a box too; `fixed_focal` holds the focal length where it is."""
    x, y = motion.down
    fit = _with_given(prior(math.atan2(x, y)), given, scene.width, fixed_focal)
    shadow = None if flying is None else find_shadow(scene, flying)
    if flying is None or shadow is None:
        return fit
    return fit_shadow(fit, flying, shadow, (scene.width, scene.height)) or fit


def _with_given(fit: CameraFit, given: CameraRequest | None, width: int, fixed_focal: bool) -> CameraFit:
    given = given or CameraRequest.model_construct()
    mean, sigma = fit.mean.copy(), np.sqrt(np.diag(fit.covariance))
    if given.pitch is not None:
        mean[0], sigma[0] = math.radians(given.pitch), GIVEN_PITCH_SIGMA
    if given.focal is not None and not fixed_focal:
        mean[1], sigma[1] = math.log(given.focal / width), GIVEN_FOCAL_SIGMA
    if given.roll is not None:
        fit = replace(fit, roll=math.radians(given.roll), roll_sigma=GIVEN_ROLL_SIGMA)
    if fixed_focal:
        sigma[1] = FIXED
    source = fit.source if not given.model_fields_set else "request"
    return replace(fit, mean=mean, covariance=np.diag(sigma**2), source=source)


# --- what is put somewhere


def placed_before(grounding: Grounding, motion: Motion) -> tuple[Intervention, ...]:
    """The interventions that put something somewhere before the motion."""
    carried = placed_mover(grounding) if motion.kind == "place" else None
    return tuple(each for each in grounding.interventions if each.kind == "place" and each is not carried)


def placement_goal(situation: Situation, bodies: Sequence[SeenBody]) -> PlacementGoal | None:
    """Where the mover is seen going; None where it is put nowhere, or before it moves.

    Raises `CannotGround` where nothing says where to, a target was not found or is the mover, or has no opening.
    """
    if situation.motion.kind != "place":
        return None
    placed = placed_mover(situation.grounding)
    if placed is None:
        raise _says_no_place(situation.grounding.object)
    return _goal(situation.scene, placed, 0, bodies)


def placement_goals(
    situation: Situation, bodies: Sequence[SeenBody], *, follows_path: bool
) -> tuple[PlacementGoal, ...]:
    """What is put somewhere before anything moves, in its order.

    Raises `CannotGround` as `placement_goal`, for what is put to the mover while that is put somewhere itself, and for
    a mover that is put elsewhere and `follows_path`.
    """
    grounding, motion = situation.grounding, situation.motion
    found: list[PlacementGoal] = []
    for each in placed_before(grounding, motion):
        name = each.object.object
        body = 0 if is_same(each.object.bbox, grounding.bbox) else _body(each.object, bodies)
        goal = _goal(situation.scene, each, body, bodies)
        if motion.kind == "place" and 0 in goal.targets:
            raise CannotGround(
                f"'{name}' is put {place_words(each)}, which is put somewhere itself, and seen going there last. Ask "
                "of one change at a time."
            )
        if follows_path and body == 0:
            raise CannotGround(
                f"'{name}' cannot be put {place_words(each)} before it moves: its path, which is given or follows the "
                "ballistic law, begins where the image shows it. Leave the path out, or ask for the law `contact`."
            )
        sets_out = 0 in goal.targets and motion.kind == "linear"
        found.append(replace(goal, by_heading=sets_out and goal.relation in ("in-front-of", "behind")))
    return tuple(found)


def _with_openings(bodies: Sequence[SeenBody], goals: Sequence[PlacementGoal]) -> tuple[SeenBody, ...]:
    """The bodies; of those that something is put into, as wide at their lower end as their opening was measured."""
    bottoms = {
        goal.targets[0]: goal.opening.bottom
        for goal in goals
        if goal.opening is not None and not goal.opening.foot_hidden
    }
    return tuple(replace(body, taper=bottoms.get(index, body.taper)) for index, body in enumerate(bodies))


def _goal(scene: Scene, placed: Intervention, body: int, bodies: Sequence[SeenBody]) -> PlacementGoal:
    if placed.relation is None or not placed.targets:
        raise _says_no_place(placed.object.object)
    targets = tuple(_body(target, bodies) for target in placed.targets)
    if body in targets:
        raise CannotGround(f"'{bodies[body].name}' cannot be put into, onto or beside itself.")
    if len(set(targets)) < len(targets):
        raise CannotGround(f"'{placed.targets[0].object}' and '{placed.targets[1].object}' were found at one place.")
    opening = _opening(scene, bodies[targets[0]]) if placed.relation == "into" else None
    if opening is not None and _has_hidden_foot(bodies, targets[0], body):
        opening = replace(opening, foot_hidden=True)
    return PlacementGoal(placed.relation, targets, opening, _free_side(scene, bodies, targets[0], body), body)


def _says_no_place(name: str) -> CannotGround:
    return CannotGround(
        f"Nothing says where '{name}' is put: give an intervention of kind `place` with its `relation` and `targets`."
    )


def _body(target: LocatedObject, bodies: Sequence[SeenBody]) -> int:
    """Which body a target is."""
    shared = [iou(target.bbox, body.bbox) for body in bodies]
    best = int(np.argmax(shared))
    if shared[best] < SAME_OBJECT_IOU:
        raise CannotGround(f"'{target.object}' was not found as an object of its own.")
    return best


def _opening(scene: Scene, target: SeenBody) -> SeenOpening:
    """The opening of a container, by what is said of it and by its rim in the image."""
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


def _has_hidden_foot(bodies: Sequence[SeenBody], target: int, put: int) -> bool:
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
