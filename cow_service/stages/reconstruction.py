"""What stage 3 simulates: the bodies that the image shows, the camera that sees them, and what is put where first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cow_service.errors import CannotGround
from cow_service.narration.story import OF_ITSELF, OF_TARGET
from cow_service.narration.words import place_words, same_name
from cow_service.physics.ballistic import Camera, FreePath, ballistic_path, given_path
from cow_service.physics.bodies import SeenBody, supports_of
from cow_service.physics.camera import SIDE_VIEW, Standing, camera_of, given_camera, no_segments
from cow_service.physics.ensemble import BY_EVENTS, OF_EACH, SURE, SURE_OF_FIT, SURE_OF_MISS, Query
from cow_service.physics.geometry import DepthMap, measure_scene, rise_above
from cow_service.physics.placement import PlacementGoal
from cow_service.physics.world import PrescribedMotion, WorldInput
from cow_service.records import Asked, BBox, Estimate, Grounding, Intervention, LocatedObject, Motion, ObjectPrior
from cow_service.requests import SimulateRequest
from cow_service.stages.grounding import others_of, placed_mover, removed_of
from cow_service.stages.run import Run
from cow_service.vision.edges import divide
from cow_service.vision.forms import shape_seen
from cow_service.vision.masks import iou, is_same_object
from cow_service.vision.openings import measure_opening
from cow_service.vision.scene import CLEAR_CUT, Obstacle, Scene
from cow_service.vision.shadows import find_shadow
from cow_service.vision.side_view import SideView

PART = 0.5  # of a region's area: with more of it inside a thing that is removed, it is a part of that
BELOW = 4  # px below the outline of a body in which another one that hides it begins
HIDDEN = 0.25  # of the columns of a body: with so many ending at another one, its foot is hidden


@dataclass(frozen=True)
class Situation:
    """What stage 3 starts from: the image and its objects, how one of them moves, and what the request wants."""

    scene: Scene
    grounding: Grounding
    motion: Motion
    request: SimulateRequest
    obstacles: Sequence[Obstacle]
    removed: Sequence[Obstacle] = ()
    unlisted: tuple[BBox, ...] = ()  # of what is seen beside a list that says that it is complete
    depth: DepthMap | None = None
    focal: Estimate | None = None  # px, by what else than the request tells it

    @staticmethod
    def of(run: Run[SimulateRequest], scene: Scene, grounding: Grounding, motion: Motion) -> Situation:
        """With the obstacles that the scene shows."""
        obstacles, removed = obstacles_of(scene, grounding)
        said = run.request
        is_estimate = not said.objects_complete or any(each.source != "request" for each in said.objects)
        unlisted = unlisted_of(scene, grounding) if grounding.objects_complete and is_estimate else ()
        return Situation(scene, grounding, motion, run.request, obstacles, removed, unlisted, run.depth, run.focal)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image, px."""
        return self.scene.width, self.scene.height

    @property
    def is_separated(self) -> bool:
        """Whether the surroundings could be told apart into objects."""
        return bool(self.scene.regions or self.obstacles or self.removed)

    @property
    def follows_path(self) -> bool:
        """Whether the mover follows a path that no contact changes: one that is given, or has the ballistic law."""
        return self.request.trajectory is not None or (self.motion.law == "ballistic" and self.motion.kind != "place")

    @property
    def side_view(self) -> SideView | None:
        """The drawing without depth that the image is, unless its mover follows a path through space."""
        return None if self.follows_path else self.scene.side_view

    @cached_property
    def located(self) -> tuple[LocatedObject, ...]:
        """What was located beside the mover, what is removed last."""
        return (*others_of(self.grounding), *removed_of(self.grounding))

    @cached_property
    def carried(self) -> Intervention | None:
        """What puts the mover somewhere, where that is seen as its motion."""
        return placed_mover(self.grounding) if self.motion.kind == "place" else None

    @cached_property
    def placed_before(self) -> tuple[Intervention, ...]:
        """What puts something somewhere before the motion."""
        return tuple(each for each in self.grounding.interventions if each.kind == "place" and each is not self.carried)


def obstacles_of(scene: Scene, grounding: Grounding) -> tuple[tuple[Obstacle, ...], tuple[Obstacle, ...]]:
    """What stands beside the mover, and what of it is removed before the motion; no more than is listed where a list
    says that it is complete."""
    removed, others = removed_of(grounding), others_of(grounding)
    found = scene.obstacles(grounding.bbox, (*others, *removed))
    gone, named = {each.bbox for each in removed}, {other.bbox for other in others}
    if grounding.objects_complete:
        found = tuple(each for each in found if each.bbox in gone | named)
    taken = tuple(each for each in found if each.bbox in gone)
    masks = [each.mask.full() for each in taken]
    # A part of what is removed, such as its lit top, may have been found as a region of its own.
    parts = {each.bbox for each in found if any(each.mask.shared_with(m) > PART * each.mask.area for m in masks)}
    kept = (each for each in found if each.bbox not in gone and (each.bbox in named or each.bbox not in parts))
    return tuple(kept), taken


def unlisted_of(scene: Scene, grounding: Grounding) -> tuple[BBox, ...]:
    """Boxes of what is clearly seen as one thing, and is no part of what a complete list has."""
    listed = (*others_of(grounding), *removed_of(grounding))
    known = np.zeros((scene.height, scene.width), bool)
    for x0, y0, x1, y1 in (grounding.bbox, *(each.bbox for each in listed)):
        known[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1] = True
    seen = scene.obstacles(grounding.bbox, listed)
    clear = (each for each in seen if each.confidence >= CLEAR_CUT)
    return tuple(each.bbox for each in clear if each.mask.shared_with(known) < PART * each.mask.area)


def reconstruct(situation: Situation) -> tuple[WorldInput, Query | None, FreePath | None]:
    """The world, what is asked of its bodies, and the path that no contact changes, where the mover follows one.

    Raises `CannotGround` for what cannot be put where the question or the request puts it.
    """
    motion, request = situation.motion, situation.request
    bodies = seen_bodies(situation)
    present = bodies[: 1 + len(situation.obstacles)]
    level = None if situation.side_view is None else situation.side_view.level
    in_air = [body.is_flying if index else body.flies(motion) for index, body in enumerate(bodies)]
    supports = supports_of(bodies, level)
    on_floor = [on is None and not flies for on, flies in zip(supports, in_air, strict=True)]
    query = query_of(situation, bodies, on_floor)
    carried, before = placement_goals(situation, present)
    if query is None and situation.grounding.asked is None and carried is not None:
        # Nothing is asked but whether it gets there: shown is what it does in most worlds.
        query = Query(Asked(relation="inside"), carried.targets[0])
    if query is not None and query.is_decidable and query.asked.form == "which" and query.asked.relation == "inside":
        query = replace(query, goals=_goals_of_each(situation, query, present))
    faint = situation.unlisted
    depth = None if level is not None or situation.follows_path else situation.depth
    is_ball_in_air = bodies[0].shape == "sphere" and in_air[0]
    shadow = find_shadow(situation.scene, bodies[0].bbox) if depth is None and is_ball_in_air else None
    own, lines = (
        divide(situation.scene.segments, [body.mask for body in bodies]) if depth is None else ([], no_segments())
    )
    fit = given_camera(situation.size, motion.down, request.camera, situation.focal, situation.follows_path)
    measured = None
    if depth is None:
        parts = zip(bodies, own, on_floor, strict=True)
        standing = [Standing.of(body, segments) for body, segments, stands in parts if stands]
        flying = bodies[0] if in_air[0] else None
        fit = camera_of(fit, situation.size, standing, lines, flying, motion.metres_per_pixel.value, shadow)
    else:
        fit, measured = measure_scene(depth, fit, bodies, supports, in_air)
        faint = faint if measured is None else rise_above(depth, measured, faint)
    # What something is put into is as wide at its lower end as its opening was measured.
    goals = (*before, *([] if carried is None else [carried]), *(() if query is None else query.goals))
    openings = ((each.targets[0], each.opening) for each in goals)
    bottoms = {body: opening.bottom for body, opening in openings if opening is not None and not opening.foot_hidden}
    # What else moves has a way and a speed of its own, and no end but what it meets.
    fields = ("kind", "direction", "direction_deviation", "depth", "towards", "speed", "speed_deviation")
    alone = {"distance": None, "duration": None, "until": None, "steps": (), "others": (), "trail": (), "rises": False,
             "other_direction": None}  # fmt: skip
    others = {
        index: motion.model_copy(update=alone | {name: getattr(each, name) for name in fields})
        for each in motion.others
        for index, body in enumerate(bodies)
        if index and not situation.follows_path and body.bbox == each.object.bbox
    }
    given = request.trajectory
    world = WorldInput(
        bodies=tuple(replace(body, taper=bottoms.get(index, body.taper)) for index, body in enumerate(present)),
        motion=motion,
        fit=fit if level is None else SIDE_VIEW,
        size=situation.size,
        num_frames=request.num_frames,
        fps=request.fps,
        lasts=0.0 if given is None else (len(given.points) - 1) / given.fps,
        others=others,
        removed=bodies[len(present) :],
        turns_wanted=query is not None and query.asked.relation == "tips",
        placement=carried,
        placed_before=before,
        level=level,
        measured=measured,
        depth=None if situation.depth is None or situation.follows_path else situation.depth.estimate(fit, measured),
        faint=faint,
    )
    if not situation.follows_path:
        return world, query, None
    camera = Camera(*situation.size, motion.metres_per_pixel.value)
    times = np.arange(world.frames) / request.fps
    if given is not None:
        path = given_path(camera, given, times)
    else:
        path = ballistic_path(camera, situation.grounding, motion, times)
    to_foot = np.array(bodies[0].foot) - np.array(situation.grounding.point)
    prescribed = PrescribedMotion(path.states[:, :3], path.points + to_foot)
    return replace(world, prescribed=prescribed), query, path.cut(request.num_frames)


# --- bodies


def seen_bodies(situation: Situation) -> tuple[SeenBody, ...]:
    """The mover, then the obstacles, then what is removed."""
    scene, grounding, bodies = situation.scene, situation.grounding, list[SeenBody]()
    located = {each.bbox: each for each in situation.located}
    mover = LocatedObject(object=grounding.object, bbox=grounding.bbox, prior=grounding.prior, source=grounding.source)
    first = Obstacle(mover.object, mover.bbox, scene.cropped(mover.bbox))
    # What is asked to fall off a thing stands on it.
    asked, carrier, carried = grounding.asked, None, ""
    if asked is not None and asked.relation == "lands" and situation.motion.kind == "linear":
        carrier = next((each.object for each in situation.located if same_name(each.object, asked.target or "")), None)
        carried = asked.subject or grounding.object
    for seen in (first, *situation.obstacles, *situation.removed):
        thing = located.get(seen.bbox) if bodies else mover
        said, region = None if thing is None else thing.prior, scene.region_of(seen.bbox)
        if carrier and same_name(seen.name, carried) and (said is None or said.stands_on is None):
            said = (said or ObjectPrior()).model_copy(update={"stands_on": carrier})
        shape = None if said is None else said.shape
        if shape is None:
            shape = None if region is None else shape_seen(region)
            shape = "box" if situation.side_view is not None and shape != "sphere" else shape
        body = SeenBody(
            name=seen.name,
            bbox=seen.bbox,
            mask=seen.mask,
            shape=shape or "cylinder",  # it stands upright
            is_form_known=shape is not None,
            source=(None if thing is None else thing.source) or "embedded",
            confidence=seen.confidence,
            prior=said,
            bbox_deviation=grounding.bbox_deviation if not bodies else 0.0 if thing is None else thing.bbox_deviation,
            point=None if bodies else grounding.point,
            stands_out=region is not None or situation.side_view is not None,
        )
        if said is not None and not bodies:
            body = replace(body, elongated=said.elongated, equal_sided=said.equal_sided)
        bodies.append(body)
    return tuple(bodies)


def query_of(situation: Situation, bodies: Sequence[SeenBody], on_floor: Sequence[bool]) -> Query | None:
    """What is asked of bodies; None where nothing is, or one that is named was not found under that name."""
    asked, motion = situation.grounding.asked, situation.motion
    if asked is None:
        return None
    if situation.carried is not None and asked.relation == "moves":  # whether it stays where it is put
        asked = asked.model_copy(update={"relation": "inside", "negated": not asked.negated, "target": None})

    def named(words: str) -> tuple[int, ...]:
        if same_name(words, situation.grounding.object):
            return (0,)
        boxes = {each.bbox for each in situation.located if same_name(each.object, words)}
        return tuple(index for index, body in enumerate(bodies) if index and body.bbox in boxes)

    subjects = (0,) if asked.subject is None else named(asked.subject)
    targets = (None,) if asked.target is None else named(asked.target)
    among = [named(name) for name in asked.among]
    is_of_itself = targets[:1] == subjects[:1] and asked.relation not in (*OF_TARGET, *OF_ITSELF)
    if not subjects or not targets or not all(among) or is_of_itself:
        return None
    known, present = tuple(dict.fromkeys(body for meant in among for body in meant)), 1 + len(situation.obstacles)
    asked = asked.model_copy(update={"among": tuple(bodies[body].name for body in known)})
    is_guess = motion.kind == "projectile" and motion.cue != "trail" and motion.towards is None
    sure_of_miss = SURE_OF_MISS if is_guess and motion.depth_deviation > 0 else SURE
    query = Query(asked, targets[0], subjects[0], known, sure_of_miss=sure_of_miss)
    is_of_each = asked.form in OF_EACH
    if is_of_each and not known:  # to be taken away: what the question names, and what is met
        others = [i for i in range(1, present) if i != query.subject]
        said = {each.bbox for each in situation.located if each.role == "target"}
        chosen = [i for i in others if bodies[i].bbox in said] if query.is_of_removal else others
        query = replace(query, among=tuple(chosen), meets_more=query.is_of_removal)
    if situation.carried is not None and asked.relation == "inside":
        can_tell = not is_of_each or (bool(known) and not query.is_of_removal and not query.subject)
        return replace(query, sure=SURE_OF_FIT, sure_of_miss=SURE_OF_FIT, is_decidable=can_tell)
    # Worlds decide nothing of what is removed, and not that something lands that stands on the floor.
    is_present = situation.is_separated and query.subject < present
    is_seen = asked.relation in BY_EVENTS and not (on_floor[query.subject] and asked.relation == "lands")
    is_seen &= asked.form != "which" or asked.relation not in OF_ITSELF
    return replace(query, is_decidable=is_present and is_seen)


# --- what is put somewhere


def placement_goals(
    situation: Situation, bodies: Sequence[SeenBody]
) -> tuple[PlacementGoal | None, tuple[PlacementGoal, ...]]:
    """Where the mover is seen going, if it is put somewhere, and what is put somewhere before, in its order.

    Raises `CannotGround` where nothing says where to, for what is put to the mover while that is put somewhere itself,
    for a mover that is put elsewhere and follows a path, and as `_goal`.
    """
    motion, carried = situation.motion, situation.carried
    if motion.kind == "place" and carried is None:
        raise _says_no_place(situation.grounding.object)
    goals: list[PlacementGoal] = []
    placed = (*([] if carried is None else [carried]), *situation.placed_before)
    for each, where in [(each, place_words(each)) for each in placed]:
        name = each.object.object
        goal = replace(_goal(situation.scene, each, bodies), place=where)
        if each is not carried and motion.kind == "place" and 0 in goal.targets:
            raise CannotGround(
                f"'{name}' is put {where}, which is put somewhere itself, and seen going there last. Ask "
                "of one change at a time."
            )
        if each is not carried and situation.follows_path and goal.body == 0:
            raise CannotGround(
                f"'{name}' cannot be put {where} before it moves: its path, which is given or follows the "
                "ballistic law, begins where the image shows it. Leave the path out, or ask for the law `contact`."
            )
        sets_out = 0 in goal.targets and motion.kind == "linear"
        goals.append(replace(goal, by_heading=sets_out and goal.relation in ("in-front-of", "behind")))
    return (None, tuple(goals)) if carried is None else (goals[0], tuple(goals[1:]))


def _goal(scene: Scene, placed: Intervention, bodies: Sequence[SeenBody]) -> PlacementGoal:
    """Where a thing is put.

    Raises `CannotGround` where it, or what it is put to, was not found; where both are one, or it may be closed.
    """
    if placed.relation is None or not placed.targets:
        raise _says_no_place(placed.object.object)
    found: list[int] = []
    for thing in (placed.object, *placed.targets):
        best = max(range(len(bodies)), key=lambda index: iou(thing.bbox, bodies[index].bbox))
        if not is_same_object(thing.bbox, bodies[best].bbox):
            raise CannotGround(f"'{thing.object}' was not found as an object of its own.")
        found.append(best)
    body, *targets = found
    if body in targets:
        raise CannotGround(f"'{bodies[body].name}' cannot be put into, onto or next to itself.")
    if len(set(targets)) < len(targets):
        raise CannotGround(f"'{placed.targets[0].object}' and '{placed.targets[1].object}' were found at one place.")
    target, opening = bodies[targets[0]], None
    beside = [each for index, each in enumerate(bodies) if index not in (body, targets[0])]
    is_hidden = placed.relation == "into" and _has_hidden_foot(target, beside)
    side = _free_side(bodies[body].bbox, target.bbox, beside, scene.width)
    if placed.relation == "into":
        # The opening of a container, by what is said of it and by its rim in the image.
        form = None if target.prior is None else target.prior.opening
        if form == "none":
            raise CannotGround(
                f"'{target.name}' is not an open container: nothing can go into it. Name a bowl, cup or box, or put it "
                "`onto` it."
            )
        if form is None:
            raise CannotGround(f"Whether '{target.name}' is open is not known: call it a bowl, a cup or a box.")
        opening = replace(measure_opening(target.mask, square=form == "square"), foot_hidden=is_hidden)
    return PlacementGoal(placed.relation, tuple(targets), opening, side, body)


def _goals_of_each(situation: Situation, query: Query, bodies: Sequence[SeenBody]) -> tuple[PlacementGoal, ...]:
    """Those of the mover, if it is put to each of several things instead. Raises `CannotGround` as `_goal`."""
    carried = situation.carried
    assert carried is not None  # else it is not asked what the mover fits into
    targets = (LocatedObject(object=body.name, bbox=body.bbox) for body in (bodies[each] for each in query.among))
    return tuple(_goal(situation.scene, carried.model_copy(update={"targets": (each,)}), bodies) for each in targets)


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
