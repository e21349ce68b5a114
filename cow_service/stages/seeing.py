"""What stage 3 starts from: all that it takes from the picture, gathered before anything is computed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cow_service.media.masks import is_among
from cow_service.media.types import Floats
from cow_service.narration.words import same_name
from cow_service.perception.classical.edges import divide
from cow_service.perception.classical.forms import shape_seen
from cow_service.perception.classical.openings import measure_opening
from cow_service.perception.observation import CLEAR_CUT, Observation, Obstacle
from cow_service.physics.bodies import SeenBody, SeenOpening, Shadow, no_edges
from cow_service.physics.geometry import DepthMap
from cow_service.records import Asked, BBox, Estimate, Grounding, Intervention, LocatedObject, Motion, ObjectPrior
from cow_service.requests import SimulateRequest
from cow_service.stages.depth import depth_map, focal_of
from cow_service.stages.grounding import others_of, placed_mover, removed_of
from cow_service.stages.keys import EstimatedDepth
from cow_service.stages.run import Run

PART = 0.5  # of a region's area: with more of it inside a thing that is removed, it is a part of that


@dataclass(frozen=True)
class Situation:
    """What the picture shows, how one of its things moves, and what the request wants."""

    grounding: Grounding
    motion: Motion
    request: SimulateRequest
    size: tuple[int, int]  # px, of the image: width and height
    bodies: tuple[SeenBody, ...]  # the mover, what else is there, then what is removed
    count: int  # of the bodies without those that are removed
    follows_path: bool = False  # the mover follows a path that no contact changes: a given or a ballistic one
    is_separated: bool = True  # the surroundings could be told apart into objects
    level: float | None = None  # px: height in the image of the floor of a drawing that has no depth
    faint: tuple[BBox, ...] = ()  # px: where the image shows things that a list which was read does not have
    # Of what something may be put into, by its box.
    openings: Mapping[BBox, SeenOpening] = field(default_factory=dict[BBox, SeenOpening])
    lines: Floats = field(default_factory=no_edges)  # [N, 4] px: straight edges beside all bodies
    shadow: Shadow | None = None  # of a ball in the air
    depth: DepthMap | None = None
    focal: Estimate | None = None  # px, by what else than the request tells it

    @property
    def present(self) -> tuple[SeenBody, ...]:
        """The bodies that are not removed."""
        return self.bodies[: self.count]

    @property
    def located(self) -> tuple[LocatedObject, ...]:
        """What was located beside the mover, what is removed last."""
        return located_of(self.grounding)

    @property
    def carried(self) -> Intervention | None:
        """What puts the mover somewhere, where that is seen as its motion."""
        return placed_mover(self.grounding) if self.motion.kind == "place" else None

    @property
    def asked(self) -> Asked | None:
        """What is asked. Whether the mover moves asks of one that is put somewhere whether it stays there."""
        asked = self.grounding.asked
        if asked is None or asked.relation != "moves" or self.carried is None:
            return asked
        return asked.model_copy(update={"relation": "inside", "negated": not asked.negated, "target": None})

    def named(self, words: str) -> tuple[int, ...]:
        """The bodies that some words name."""
        if same_name(words, self.grounding.object):
            return (0,)
        boxes = {each.bbox for each in self.located if same_name(each.object, words)}
        return tuple(index for index, body in enumerate(self.bodies) if index and body.bbox in boxes)


def located_of(grounding: Grounding) -> tuple[LocatedObject, ...]:
    """What was located beside the mover, what is removed last."""
    return (*others_of(grounding), *removed_of(grounding))


def see(
    run: Run[SimulateRequest],
    observation: Observation,
    grounding: Grounding,
    motion: Motion,
    estimated: EstimatedDepth | None = None,
) -> Situation:
    """The situation that an image shows. Raises `InvalidRequest` for a depth map that is none of the image."""
    request = run.request
    on_path = request.trajectory is not None or (motion.law == "ballistic" and motion.kind != "place")
    side_view = None if on_path else observation.side_view
    depth, (obstacles, removed) = depth_map(run, estimated), obstacles_of(observation, grounding)
    bodies = see_bodies(observation, grounding, motion, (*obstacles, *removed), side_view is not None)
    situation = Situation(
        grounding=grounding,
        motion=motion,
        request=request,
        size=(observation.width, observation.height),
        bodies=bodies,
        count=1 + len(obstacles),
        follows_path=on_path,
        is_separated=bool(observation.things or obstacles or removed),
        level=None if side_view is None else side_view.level,
        faint=see_unlisted(observation, grounding, request),
        openings=see_openings(grounding, bodies),
        depth=None if on_path else depth,
        focal=focal_of(run, depth),
    )
    return situation if situation.depth is not None or side_view is not None else with_edges(observation, situation)


def with_edges(observation: Observation, situation: Situation) -> Situation:
    """With what else than a depth map tells of the camera: straight edges, and the shadow of a ball in the air."""
    mover = situation.bodies[0]
    edges, lines = divide(observation.segments, [body.mask for body in situation.bodies])
    bodies = tuple(replace(body, edges=own) for body, own in zip(situation.bodies, edges, strict=True))
    is_ball_in_air = mover.shape == "sphere" and mover.flies(situation.motion)
    shadow = observation.shadow_below(mover.bbox) if is_ball_in_air else None
    return replace(situation, bodies=bodies, lines=lines, shadow=shadow)


def obstacles_of(observation: Observation, grounding: Grounding) -> tuple[tuple[Obstacle, ...], tuple[Obstacle, ...]]:
    """What stands beside the mover, and what of it is removed before the motion; no more than is listed where a list
    says that it is complete."""
    removed, others = removed_of(grounding), others_of(grounding)
    found = observation.obstacles(grounding.bbox, (*others, *removed))
    gone, named = {each.bbox for each in removed}, {other.bbox for other in others}
    if grounding.objects_complete:
        found = tuple(each for each in found if each.bbox in gone | named)
    taken = tuple(each for each in found if each.bbox in gone)
    masks = [each.mask.full() for each in taken]
    # A part of what is removed, such as its lit top, may have been found as a region of its own.
    parts = {each.bbox for each in found if any(each.mask.shared_with(m) > PART * each.mask.area for m in masks)}
    kept = (each for each in found if each.bbox not in gone and (each.bbox in named or each.bbox not in parts))
    return tuple(kept), taken


def see_bodies(
    observation: Observation, grounding: Grounding, motion: Motion, others: Sequence[Obstacle], is_side_view: bool
) -> tuple[SeenBody, ...]:
    """The mover, then some others."""
    mover = LocatedObject(
        object=grounding.object,
        bbox=grounding.bbox,
        prior=grounding.prior,
        source=grounding.source,
        bbox_deviation=grounding.bbox_deviation,
    )
    located = {each.bbox: each for each in located_of(grounding)}
    rider, carrier = _carrier_of(grounding, motion)

    def body_of(seen: Obstacle, thing: LocatedObject) -> SeenBody:
        prior, region = thing.prior or ObjectPrior(), observation.thing_in(seen.bbox)
        if carrier and same_name(seen.name, rider) and prior.stands_on is None:
            prior = prior.model_copy(update={"stands_on": carrier})
        shape = prior.shape
        if shape is None:
            shape = None if region is None else shape_seen(region)
            shape = "box" if is_side_view and shape != "sphere" else shape
        return SeenBody(
            name=seen.name,
            bbox=seen.bbox,
            mask=seen.mask,
            shape=shape or "cylinder",  # it stands upright
            is_form_known=shape is not None,
            source=thing.source or "embedded",
            confidence=observation.confidence_in(seen.bbox),
            prior=prior,
            bbox_deviation=thing.bbox_deviation,
            stands_out=region is not None or is_side_view,
        )

    first = body_of(Obstacle(mover.object, mover.bbox, observation.mask_in(mover.bbox)), mover)
    own = first.prior  # of what moves it is known which way is along
    first = replace(first, elongated=own.elongated, equal_sided=own.equal_sided, point=grounding.point)
    unnamed = (located.get(each.bbox, LocatedObject(object=each.name, bbox=each.bbox)) for each in others)
    return (first, *(body_of(*each) for each in zip(others, unnamed, strict=True)))


def _carrier_of(grounding: Grounding, motion: Motion) -> tuple[str, str | None]:
    """What is asked to come down on the floor, and the thing that it is asked to fall off: it stands on that."""
    asked = grounding.asked
    if asked is None or asked.relation != "lands" or motion.kind != "linear":
        return "", None
    named = (each.object for each in located_of(grounding) if same_name(each.object, asked.target or ""))
    return asked.subject or grounding.object, next(named, None)


def see_openings(grounding: Grounding, bodies: Sequence[SeenBody]) -> dict[BBox, SeenOpening]:
    """Of what something is put into, or may be put into as well: the opening, as what is said of it and its rim show
    it."""
    put = [each for each in grounding.interventions if each.kind == "place" and each.relation == "into"]
    boxes = [target.bbox for each in put for target in each.targets]
    if put and grounding.asked is not None and grounding.asked.form == "which":
        boxes += [each.bbox for each in others_of(grounding)]
    containers = (body for body in bodies if is_among(body.bbox, boxes))
    return {body.bbox: measure_opening(body.mask, square=body.prior.opening == "square") for body in containers}


def see_unlisted(observation: Observation, grounding: Grounding, request: SimulateRequest) -> tuple[BBox, ...]:
    """Boxes of what is clearly seen as one thing, and is no part of an estimated list that says that it is complete."""
    is_given = request.objects_complete and all(each.source == "request" for each in request.objects)
    if is_given or not grounding.objects_complete:
        return ()
    listed = located_of(grounding)
    known = np.zeros((observation.height, observation.width), bool)
    for x0, y0, x1, y1 in (grounding.bbox, *(each.bbox for each in listed)):
        known[int(y0) : int(y1) + 1, int(x0) : int(x1) + 1] = True
    clear = (each for each in observation.obstacles(grounding.bbox, listed) if each.confidence >= CLEAR_CUT)
    return tuple(each.bbox for each in clear if each.mask.shared_with(known) < PART * each.mask.area)
