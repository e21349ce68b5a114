"""What stage 3 simulates: the bodies that the image shows, the camera that sees them, and what is put where first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from cow_service.errors import CannotGround
from cow_service.narration import place_words, same_name
from cow_service.physics.ballistic import Camera, FreePath, ballistic_path, given_path
from cow_service.physics.bodies import SeenBody, supports_in_side_view, supports_of
from cow_service.physics.camera import FOCAL_WIDTHS, SIDE_VIEW, CameraFit, Standing, fit_shadow, narrowed, prior
from cow_service.physics.ensemble import BY_EVENTS, Query
from cow_service.physics.layout import flies
from cow_service.physics.placement import PlacementGoal
from cow_service.physics.world import PrescribedMotion, WorldInput
from cow_service.records import Asked, BBox, Estimate, Grounding, Intervention, LocatedObject, Motion, Vector
from cow_service.requests import CameraRequest, SimulateRequest
from cow_service.stages.grounding import others_of, placed_mover, removed_of
from cow_service.vision.edges import divide
from cow_service.vision.masks import CroppedMask, iou, is_same_object
from cow_service.vision.openings import measure_opening
from cow_service.vision.scene import Obstacle, Scene
from cow_service.vision.shadows import Shadow, find_shadow
from cow_service.vision.side_view import SideView
from cow_service.vision.types import Floats

PART = 0.5  # of a region's area: with more of it inside a thing that is removed, it is a part of that
BELOW = 4  # px below the outline of a body in which another one that hides it begins
HIDDEN = 0.25  # of the columns of a body: with so many ending at another one, its foot is hidden
GIVEN_PITCH_SIGMA, GIVEN_ROLL_SIGMA = math.radians(1.0), math.radians(0.5)
GIVEN_FOCAL_SIGMA = 0.02  # of the logarithm
LEAST_HEIGHT_SIGMA = 0.05  # of the logarithm of a height that is said
FIXED = 1e-6  # deviation of a focal length that must not vary


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
    """What stands beside the mover, and what of it is removed before the motion."""
    removed, others = removed_of(grounding), others_of(grounding)
    found = scene.obstacles(grounding.bbox, (*others, *removed))
    gone, named = {each.bbox for each in removed}, {other.bbox for other in others}
    taken = tuple(each for each in found if each.bbox in gone)
    masks = [each.mask.full() for each in taken]
    # A part of what is removed, such as its lit top, may have been found as a region of its own.
    parts = {each.bbox for each in found if any(each.mask.shared_with(m) > PART * each.mask.area for m in masks)}
    kept = (each for each in found if each.bbox not in gone and (each.bbox in named or each.bbox not in parts))
    return tuple(kept), taken


def reconstruct(situation: Situation) -> tuple[WorldInput, Query | None, FreePath | None]:
    """The world, what is asked of its bodies, and the path that no contact changes, where the mover follows one.

    Raises `CannotGround` for what cannot be put where the question or the request puts it.
    """
    motion, request = situation.motion, situation.request
    bodies = seen_bodies(situation)
    present = bodies[: 1 + len(situation.obstacles)]
    carried, before = placement_goals(situation, present)
    query = query_of(situation, bodies, carried)
    is_ball_in_air = bodies[0].shape == "sphere" and flies(bodies[0], motion)
    standing, floor = standing_things(bodies, motion, situation.scene.segments)
    fit = camera_of(
        situation.size,
        motion.down,
        request.camera,
        find_shadow(situation.scene, bodies[0].bbox) if is_ball_in_air else None,
        bodies[0].bbox,
        fixed_focal=situation.follows_path,
        standing=standing,
        floor=floor,
        radii=_height_in_radii(bodies[0], motion),
    )
    level = None if situation.side_view is None else situation.side_view.level
    if level is not None:
        fit = SIDE_VIEW
    # What something is put into is as wide at its lower end as its opening was measured.
    openings = ((each.targets[0], each.opening) for each in (*before, *([] if carried is None else [carried])))
    bottoms = {body: opening.bottom for body, opening in openings if opening is not None and not opening.foot_hidden}
    # What else moves has a way and a speed of its own, and no end but what it meets.
    own = ("kind", "direction", "depth", "towards", "speed", "speed_deviation")
    alone = {"distance": None, "duration": None, "until": None, "steps": (), "others": (), "trail": (), "rises": False}
    others = {
        index: motion.model_copy(update=alone | {name: getattr(each, name) for name in own})
        for each in motion.others
        for index, body in enumerate(bodies)
        if index and not situation.follows_path and body.bbox == each.object.bbox
    }
    given = request.trajectory
    world = WorldInput(
        bodies=tuple(replace(body, taper=bottoms.get(index, body.taper)) for index, body in enumerate(present)),
        motion=motion,
        fit=fit,
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
    first = Obstacle(mover.object, mover.bbox, CroppedMask.of(scene.silhouette(mover.bbox)))
    for seen in (first, *situation.obstacles, *situation.removed):
        thing = located.get(seen.bbox) if bodies else mover
        said, region = None if thing is None else thing.prior, scene.region_of(seen.bbox)
        body = SeenBody(
            name=seen.name,
            bbox=seen.bbox,
            mask=seen.mask,
            # Where nothing is said of its shape, a disc is a sphere, and the rest stands upright.
            shape="sphere" if region is not None and region.is_disc else "cylinder",
            source=(None if thing is None else thing.source) or "embedded",
            confidence=seen.confidence,
            prior=said,
        )
        if said is not None and said.shape is not None:
            body = replace(body, shape=said.shape)
        elif situation.side_view is not None:
            body = replace(body, shape="sphere" if body.shape == "sphere" else "box")
        elif body.shape != "sphere":
            body = replace(body, is_form_known=False)
        if said is not None and not bodies:
            body = replace(body, elongated=said.elongated, equal_sided=said.equal_sided)
        bodies.append(body)
    return tuple(bodies)


def query_of(situation: Situation, bodies: Sequence[SeenBody], carried: PlacementGoal | None) -> Query | None:
    """What is asked of bodies; None where nothing is, or one that is named was not found under that name.

    Where the mover is put somewhere and nothing is asked, whether it gets there: shown is what it does in most worlds.
    """
    asked = situation.grounding.asked
    if asked is None:
        return None if carried is None else Query(Asked(relation="inside"), carried.targets[0])

    def named(words: str) -> tuple[int, ...]:
        if same_name(words, situation.grounding.object):
            return (0,)
        boxes = {each.bbox for each in situation.located if same_name(each.object, words)}
        return tuple(index for index, body in enumerate(bodies) if index and body.bbox in boxes)

    subjects = (0,) if asked.subject is None else named(asked.subject)
    targets = (None,) if asked.target is None else named(asked.target)
    among = [named(name) for name in asked.among]
    if not subjects or not targets or not all(among):
        return None
    known = tuple(dict.fromkeys(body for meant in among for body in meant))
    asked = asked.model_copy(update={"among": tuple(bodies[body].name for body in known)})
    query = Query(asked, targets[0], subjects[0], known)
    if carried is not None and asked.relation == "inside":
        return query
    # Worlds decide nothing of what is removed, and not that something lands that stands on the floor.
    subject = bodies[query.subject]
    in_air = subject.is_flying if query.subject else flies(subject, situation.motion)
    view = situation.side_view
    supports = supports_of(bodies) if view is None else supports_in_side_view(bodies, view.level)
    stands_on_floor = not in_air and supports[query.subject] is None
    is_present = situation.is_separated and query.subject <= len(situation.obstacles)
    is_seen = asked.relation in BY_EVENTS and not (stands_on_floor and asked.relation == "lands")
    return replace(query, is_decidable=is_present and is_seen)


# --- the camera


def camera_of(
    size: tuple[int, int],
    down: Vector,
    given: CameraRequest | None,
    shadow: Shadow | None = None,
    flying: BBox = (0, 0, 0, 0),
    fixed_focal: bool = False,
    standing: Sequence[Standing] = (),
    floor: Floats | None = None,
    radii: Estimate | None = None,
) -> CameraFit:
    """The camera of an image of a size (width, height; px), by what stands on the floor and the shadow of what flies.

    `floor` has segments [N, 4] (px) of what lies between things; `fixed_focal` holds the focal length where it is;
    `radii` is what is said of the height of what flies, in its radii.
    """
    fit, given = prior(math.atan2(*down), max(size) / size[0]), given or CameraRequest.model_construct()
    mean, sigma = fit.mean.copy(), np.sqrt(np.diag(fit.covariance))
    if given.pitch is not None:
        mean[0], sigma[0] = math.radians(given.pitch), GIVEN_PITCH_SIGMA
    if given.focal is not None and not fixed_focal:
        mean[1], sigma[1] = math.log(given.focal / size[0]), GIVEN_FOCAL_SIGMA
    if given.roll is not None:
        fit = replace(fit, roll=math.radians(given.roll), roll_sigma=GIVEN_ROLL_SIGMA)
    if radii is not None:
        mean[2], sigma[2] = math.log(radii.value), max(radii.deviation / radii.value, LEAST_HEIGHT_SIGMA)
    if fixed_focal:
        mean[1], sigma[1] = math.log(FOCAL_WIDTHS), FIXED
    source = "request" if given.model_fields_set else fit.source
    fit = replace(fit, mean=mean, covariance=np.diag(sigma**2), source=source)
    fit = narrowed(fit, standing, size, floor)
    return fit if shadow is None else fit_shadow(fit, flying, shadow, size) or fit


def _height_in_radii(mover: SeenBody, motion: Motion) -> Estimate | None:
    """What is said of the height of the middle of what flies above the floor, in its radii."""
    said = None if mover.prior is None else mover.prior.height
    if said is None or not flies(mover, motion):
        return None
    x0, y0, x1, y1 = mover.bbox
    radius = (x1 - x0 + y1 - y0) / 4 * motion.metres_per_pixel.value
    return Estimate(value=1 + said.value / radius, deviation=said.deviation / radius)


def standing_things(bodies: Sequence[SeenBody], motion: Motion, segments: Floats) -> tuple[list[Standing], Floats]:
    """What the bodies that stand on the floor show of the camera, and segments [N, 4] (px) that lie between them."""
    own, floor = divide(segments, [body.mask for body in bodies])
    things = [
        Standing(
            body.core,
            rim=body.rim if body.shape == "cylinder" and body.is_form_known else None,
            is_cube=body.prior is not None and body.prior.equal_sided,
            shape=body.shape if body.is_form_known else None,
            segments=own[index],
        )
        for index, (body, on) in enumerate(zip(bodies, supports_of(bodies), strict=True))
        if on is None and not (body.is_flying if index else flies(body, motion))
    ]
    return things, floor


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
    for each in (*([] if carried is None else [carried]), *situation.placed_before):
        goal, name = _goal(situation.scene, each, bodies), each.object.object
        if each is not carried and motion.kind == "place" and 0 in goal.targets:
            raise CannotGround(
                f"'{name}' is put {place_words(each)}, which is put somewhere itself, and seen going there last. Ask "
                "of one change at a time."
            )
        if each is not carried and situation.follows_path and goal.body == 0:
            raise CannotGround(
                f"'{name}' cannot be put {place_words(each)} before it moves: its path, which is given or follows the "
                "ballistic law, begins where the image shows it. Leave the path out, or ask for the law `contact`."
            )
        sets_out = 0 in goal.targets and motion.kind == "linear"
        goals.append(replace(goal, by_heading=sets_out and goal.relation in ("in-front-of", "behind")))
    return (None, tuple(goals)) if carried is None else (goals[0], tuple(goals[1:]))


def _goal(scene: Scene, placed: Intervention, bodies: Sequence[SeenBody]) -> PlacementGoal:
    """Where a thing is put.

    Raises `CannotGround` where it, or what it is put to, was not found; where both are one; where there is no opening.
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
        raise CannotGround(f"'{bodies[body].name}' cannot be put into, onto or beside itself.")
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
                f"'{target.name}' is no open container: nothing goes into it. Name a bowl, cup or box, or put it "
                "`onto` it."
            )
        opening = measure_opening(scene.clean, target.mask, square=form == "square")
        if form is None and not opening.has_edge:
            raise CannotGround(
                f"No opening is seen in '{target.name}': call it what it is, such as a bowl, a cup or a box."
            )
        opening = replace(opening, foot_hidden=is_hidden)
    return PlacementGoal(placed.relation, tuple(targets), opening, side, body)


def _says_no_place(name: str) -> CannotGround:
    return CannotGround(
        f"Nothing says where '{name}' is put: give an intervention of kind `place` with its `relation` and `targets`."
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
