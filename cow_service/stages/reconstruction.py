"""What stage 3 simulates: the camera, the bodies, what is asked of them, and what is put where first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cow_service.errors import CannotGround
from cow_service.media.masks import iou, is_same_object
from cow_service.narration.story import OF_ITSELF, OF_TARGET
from cow_service.narration.words import place_words
from cow_service.physics.ballistic import Camera, FreePath, ballistic_path, given_path
from cow_service.physics.bodies import SeenBody, SeenOpening, supports_of
from cow_service.physics.camera import SIDE_VIEW, CameraFit, Standing, camera_of, given_camera
from cow_service.physics.ensemble import BY_EVENTS, OF_EACH, SURE, SURE_OF_FIT, SURE_OF_MISS, Query
from cow_service.physics.geometry import Measurement, measure_scene, rise_above
from cow_service.physics.placement import PlacementGoal
from cow_service.physics.world import PrescribedMotion, WorldInput
from cow_service.records import Asked, BBox, Intervention, LocatedObject, Motion
from cow_service.stages.seeing import Situation

BELOW = 4  # px below the outline of a body in which another one that hides it begins
HIDDEN = 0.25  # of the columns of a body: with so many ending at another one, its foot is hidden


@dataclass(frozen=True)
class Stance:
    """What each body stands on at the first frame."""

    supports: tuple[int | None, ...]  # the body beneath, as the picture alone shows it; None: the floor, or nothing
    in_air: tuple[bool, ...]

    @staticmethod
    def of(situation: Situation) -> Stance:
        """As stated, or by the places of feet."""
        mover, *others = situation.bodies
        in_air = (mover.flies(situation.motion), *(body.is_flying for body in others))
        return Stance(tuple(supports_of(situation.bodies, situation.level)), in_air)

    @property
    def on_floor(self) -> tuple[bool, ...]:
        """Whether each stands on the floor itself."""
        return tuple(on is None and not flies for on, flies in zip(self.supports, self.in_air, strict=True))


@dataclass(frozen=True)
class Goals:
    """What is put where."""

    carried: PlacementGoal | None = None  # of the mover, where that is seen as its motion
    before: tuple[PlacementGoal, ...] = ()  # before the motion, in this order
    instead: tuple[PlacementGoal, ...] = ()  # of the mover, into each of the things that are asked about

    @property
    def bottoms(self) -> dict[int, float]:
        """Of what something is put into: its width at its lower end, as its opening was measured."""
        goals = (*self.before, *([] if self.carried is None else [self.carried]), *self.instead)
        openings = ((goal.targets[0], goal.opening) for goal in goals)
        return {body: opening.bottom for body, opening in openings if opening is not None and not opening.foot_hidden}


def reconstruct(situation: Situation) -> tuple[WorldInput, Query | None, FreePath | None]:
    """The world, what is asked of its bodies, and the path that no contact changes, where the mover follows one.

    Raises `CannotGround` for what cannot be put where the question or the request puts it.
    """
    stance = Stance.of(situation)
    query = query_of(situation, stance)
    goals = goals_of(situation, query)
    if query is not None:
        query = replace(query, goals=goals.instead)
    elif situation.asked is None and goals.carried is not None:
        # Nothing is asked but whether it gets there: shown is what it does in most worlds.
        query = Query(Asked(relation="inside"), goals.carried.targets[0])
    fit, measured = measure_camera(situation, stance)
    world = world_of(situation, query, goals, fit, measured)
    if not situation.follows_path:
        return world, query, None
    path = path_of(situation, world)
    to_foot = np.array(world.bodies[0].foot) - np.array(situation.grounding.point)
    prescribed = PrescribedMotion(path.states[:, :3], path.points + to_foot)
    return replace(world, prescribed=prescribed), query, path.cut(world.num_frames)


def measure_camera(situation: Situation, stance: Stance) -> tuple[CameraFit, Measurement | None]:
    """The camera, and what a depth map says of the scene: by the map, or else by the picture."""
    if situation.level is not None:
        return SIDE_VIEW, None
    motion, bodies, given = situation.motion, situation.bodies, situation.request.camera
    fit = given_camera(situation.size, motion.down, given, situation.focal, situation.follows_path)
    if situation.depth is not None:
        return measure_scene(situation.depth, fit, bodies, stance.supports, stance.in_air)
    standing = [Standing.of(body) for body, stands in zip(bodies, stance.on_floor, strict=True) if stands]
    flying = bodies[0] if stance.in_air[0] else None
    scale, lines, shadow = motion.metres_per_pixel.value, situation.lines, situation.shadow
    return camera_of(fit, situation.size, standing, lines, flying, scale, shadow), None


def world_of(
    situation: Situation, query: Query | None, goals: Goals, fit: CameraFit, measured: Measurement | None
) -> WorldInput:
    """The world, without a path that is followed."""
    request, depth, faint, bottoms = situation.request, situation.depth, situation.faint, goals.bottoms
    if depth is not None and measured is not None:
        faint = rise_above(depth, measured, faint)
    given = request.trajectory
    return WorldInput(
        bodies=tuple(replace(body, taper=bottoms.get(i, body.taper)) for i, body in enumerate(situation.present)),
        motion=situation.motion,
        fit=fit,
        size=situation.size,
        num_frames=request.num_frames,
        fps=request.fps,
        lasts=0.0 if given is None else (len(given.points) - 1) / given.fps,
        others=motions_of_others(situation),
        removed=situation.bodies[situation.count :],
        turns_wanted=query is not None and query.asked.relation == "tips",
        placement=goals.carried,
        placed_before=goals.before,
        level=situation.level,
        measured=measured,
        depth=None if depth is None else depth.estimate(fit, measured),
        faint=faint,
    )


def motions_of_others(situation: Situation) -> dict[int, Motion]:
    """What else moves, by its body: it has a way and a speed of its own, and no end but what it meets."""
    if situation.follows_path:
        return {}
    motion, index_of = situation.motion, {body.bbox: i for i, body in enumerate(situation.bodies) if i}
    fields = ("kind", "direction", "direction_deviation", "depth", "towards", "speed", "speed_deviation")
    alone = {"distance": None, "duration": None, "until": None, "steps": (), "others": (), "trail": (), "rises": False,
             "other_direction": None}  # fmt: skip
    return {
        index_of[each.object.bbox]: motion.model_copy(update=alone | {name: getattr(each, name) for name in fields})
        for each in motion.others
        if each.object.bbox in index_of
    }


def path_of(situation: Situation, world: WorldInput) -> FreePath:
    """The path that no contact changes: the given one, else the one of the ballistic law."""
    given, times = situation.request.trajectory, np.arange(world.frames) / world.fps
    camera = Camera(*situation.size, situation.motion.metres_per_pixel.value)
    if given is not None:
        return given_path(camera, given, times)
    return ballistic_path(camera, situation.grounding, situation.motion, times)


# --- what is asked


def query_of(situation: Situation, stance: Stance) -> Query | None:
    """What is asked of bodies; None where nothing is, or one that is named was not found under that name."""
    asked = situation.asked
    if asked is None:
        return None
    subjects = (0,) if asked.subject is None else situation.named(asked.subject)
    targets = (None,) if asked.target is None else situation.named(asked.target)
    among = [situation.named(name) for name in asked.among]
    is_of_itself = targets[:1] == subjects[:1] and asked.relation not in (*OF_TARGET, *OF_ITSELF)
    if not subjects or not targets or not all(among) or is_of_itself:
        return None
    known = tuple(dict.fromkeys(body for meant in among for body in meant))
    asked = asked.model_copy(update={"among": tuple(situation.bodies[body].name for body in known)})
    sure, sure_of_miss = shares_of_sure(situation, asked)
    query = Query(asked, targets[0], subjects[0], known, sure=sure, sure_of_miss=sure_of_miss)
    query = replace(query, is_decidable=is_decidable(situation, stance, query))
    return query if known or asked.form not in OF_EACH else with_candidates(situation, query)


def shares_of_sure(situation: Situation, asked: Asked) -> tuple[float, float]:
    """The shares of the worlds from which it is answered that something happens, and that it does not."""
    motion = situation.motion
    if situation.carried is not None and asked.relation == "inside":
        return SURE_OF_FIT, SURE_OF_FIT
    is_guess = motion.kind == "projectile" and motion.cue != "trail" and motion.towards is None
    return SURE, SURE_OF_MISS if is_guess and motion.depth_deviation > 0 else SURE


def is_decidable(situation: Situation, stance: Stance, query: Query) -> bool:
    """Whether worlds decide it: not of what is removed, nor that something lands that stands on the floor."""
    asked = query.asked
    if situation.carried is not None and asked.relation == "inside":
        is_of_each = asked.form in OF_EACH
        return not is_of_each or (bool(query.among) and not query.is_of_removal and not query.subject)
    if not situation.is_separated or query.subject >= situation.count or asked.relation not in BY_EVENTS:
        return False
    if asked.relation == "lands" and stance.on_floor[query.subject]:
        return False
    return asked.form != "which" or asked.relation not in OF_ITSELF


def with_candidates(situation: Situation, query: Query) -> Query:
    """With the candidates of a question that names none: what it names besides, and what is met."""
    others = [index for index in range(1, situation.count) if index != query.subject]
    if query.is_of_removal:
        said = {each.bbox for each in situation.located if each.role == "target"}
        others = [index for index in others if situation.bodies[index].bbox in said]
    return replace(query, among=tuple(others), meets_more=query.is_of_removal)


# --- what is put somewhere


def goals_of(situation: Situation, query: Query | None) -> Goals:
    """Where things are put.

    Raises `CannotGround` where nothing says where to, for what is put to the mover while that is put somewhere itself,
    for a mover that is put elsewhere and follows a path, and as `_goal`.
    """
    motion, carried = situation.motion, situation.carried
    if motion.kind == "place" and carried is None:
        raise _says_no_place(situation.grounding.object)
    own = None if carried is None else replace(_goal(situation, carried), place=place_words(carried))
    before: list[PlacementGoal] = []
    for each in situation.grounding.interventions:
        if each.kind != "place" or each is carried:
            continue
        name, where, goal = each.object.object, place_words(each), _goal(situation, each)
        if motion.kind == "place" and 0 in goal.targets:
            raise CannotGround(
                f"'{name}' is put {where}, which is put somewhere itself, and seen going there last. Ask "
                "of one change at a time."
            )
        if situation.follows_path and goal.body == 0:
            raise CannotGround(
                f"'{name}' cannot be put {where} before it moves: its path, which is given or follows the "
                "ballistic law, begins where the image shows it. Leave the path out, or ask for the law `contact`."
            )
        by_heading = 0 in goal.targets and motion.kind == "linear" and goal.relation in ("in-front-of", "behind")
        before.append(replace(goal, place=where, by_heading=by_heading))
    return Goals(own, tuple(before), goals_instead(situation, query))


def goals_instead(situation: Situation, query: Query | None) -> tuple[PlacementGoal, ...]:
    """Where the mover is put to each of several things instead. Raises `CannotGround` as `_goal`."""
    if query is None or not query.is_decidable or (query.asked.form, query.asked.relation) != ("which", "inside"):
        return ()
    carried = situation.carried
    assert carried is not None  # else it is not asked what the mover fits into
    targets = (LocatedObject(object=body.name, bbox=body.bbox) for body in (situation.bodies[i] for i in query.among))
    return tuple(_goal(situation, carried.model_copy(update={"targets": (each,)})) for each in targets)


def _goal(situation: Situation, placed: Intervention) -> PlacementGoal:
    """Where a thing is put.

    Raises `CannotGround` where it, or what it is put to, was not found; where both are one; where there is no opening.
    """
    if placed.relation is None or not placed.targets:
        raise _says_no_place(placed.object.object)
    bodies = situation.present
    body, *targets = (_found(bodies, thing) for thing in (placed.object, *placed.targets))
    if body in targets:
        raise CannotGround(f"'{bodies[body].name}' cannot be put into, onto or next to itself.")
    if len(set(targets)) < len(targets):
        raise CannotGround(f"'{placed.targets[0].object}' and '{placed.targets[1].object}' were found at one place.")
    target = bodies[targets[0]]
    beside = [each for index, each in enumerate(bodies) if index not in (body, targets[0])]
    opening = opening_of(situation, target, beside) if placed.relation == "into" else None
    side = _free_side(bodies[body].bbox, target.bbox, beside, situation.size[0])
    return PlacementGoal(placed.relation, tuple(targets), opening, side, body)


def _found(bodies: Sequence[SeenBody], thing: LocatedObject) -> int:
    best = max(range(len(bodies)), key=lambda index: iou(thing.bbox, bodies[index].bbox))
    if not is_same_object(thing.bbox, bodies[best].bbox):
        raise CannotGround(f"'{thing.object}' was not found as an object of its own.")
    return best


def opening_of(situation: Situation, target: SeenBody, beside: Sequence[SeenBody]) -> SeenOpening:
    """The opening of a container. Raises `CannotGround` for what is closed, or may be."""
    said, opening = target.prior.opening, situation.openings[target.bbox]
    if said == "none":
        raise CannotGround(
            f"'{target.name}' is not an open container: nothing can go into it. Name a bowl, cup or box, or put it "
            "`onto` it."
        )
    if said is None:
        raise CannotGround(f"Whether '{target.name}' is open is not known: call it a bowl, a cup or a box.")
    return replace(opening, foot_hidden=_has_hidden_foot(target, beside))


def _says_no_place(name: str) -> CannotGround:
    return CannotGround(
        f"Nothing says where '{name}' goes: give an intervention of kind `place` with its `relation` and `targets`."
    )


def _has_hidden_foot(target: SeenBody, others: Sequence[SeenBody]) -> bool:
    """Whether another thing begins right below a good part of the lower outline of a body."""
    mask = target.mask
    below = np.zeros(mask.shape, bool)
    for body in others:
        if body.bbox[3] > target.bbox[3]:
            body.mask.add_to(below)
    columns = np.nonzero(mask.patch.any(axis=0))[0]
    lowest = mask.rows.start + mask.patch.shape[0] - 1 - mask.patch[::-1].argmax(axis=0)
    met = [below[lowest[x] + 1 : lowest[x] + 1 + BELOW, mask.columns.start + x].any() for x in columns]
    return float(np.mean(met)) > HIDDEN


def _free_side(put: BBox, box: BBox, others: Sequence[SeenBody], image_width: int) -> int:
    """On which side of a target in a box there is room for what is put: 1 right, -1 left; its own side, if both."""
    wide = put[2] - put[0]
    near = 1 if put[0] + put[2] > box[0] + box[2] else -1

    def blocked(side: int) -> float:
        middle = (box[0] + box[2]) / 2 + side * ((box[2] - box[0]) / 2 + 0.75 * wide)
        there: BBox = (middle - wide / 2, box[3] - (put[3] - put[1]), middle + wide / 2, box[3])
        outside = max(0.0, -there[0], there[2] - image_width) / wide
        return outside + sum(iou(there, body.bbox) for body in others)

    return near if blocked(near) <= blocked(-near) else -near
