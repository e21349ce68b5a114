"""The bodies of a scene, for the world: the mover, its obstacles and what is taken away, with their shapes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.physics.bodies import SeenBody
from cow_service.physics.camera import CameraFit, fit_shadow, prior
from cow_service.physics.outcome import Query
from cow_service.readers.options import plain
from cow_service.records import Asked, BBox, Grounding, LocatedObject, Motion, Shape
from cow_service.requests import CameraRequest
from cow_service.stages.grounding import others_of
from cow_service.vision.masks import CroppedMask
from cow_service.vision.scene import Obstacle, Scene
from cow_service.vision.shadows import find_shadow

PART = 0.5  # of a region's area: with more of it inside a thing that is taken away, it is a part of that


def seen_bodies(scene: Scene, grounding: Grounding, obstacles: Sequence[Obstacle]) -> tuple[SeenBody, ...]:
    """The mover first, then the obstacles in their order."""
    mover = SeenBody(
        name=grounding.object,
        bbox=grounding.bbox,
        mask=CroppedMask.of(scene.silhouette(grounding.bbox)),
        shape=_shape(scene, LocatedObject(object=grounding.object, bbox=grounding.bbox, prior=grounding.prior)),
        source=grounding.source,
        prior=grounding.prior,
        elongated=grounding.prior is not None and grounding.prior.elongated,
        equal_sided=grounding.prior is not None and grounding.prior.equal_sided,
    )
    return mover, *(_obstacle(scene, grounding, obstacle) for obstacle in obstacles)


def obstacles_of(scene: Scene, grounding: Grounding) -> tuple[tuple[Obstacle, ...], tuple[Obstacle, ...]]:
    """What stands beside the mover, and what of it is taken away before the motion."""
    removed = removed_objects(grounding)
    found = scene.obstacles(grounding.bbox, (*others_of(grounding), *removed))
    boxes = {each.bbox for each in removed}
    taken = tuple(each for each in found if each.bbox in boxes)
    masks = [each.mask.full() for each in taken]
    # A part of what is taken away, such as its lit top, may have been found as a region of its own.
    parts = {each.bbox for each in found if any(each.mask.shared_with(m) > PART * each.mask.area for m in masks)}
    named = {other.bbox for other in others_of(grounding)}
    kept = (each for each in found if each.bbox not in boxes and (each.bbox in named or each.bbox not in parts))
    return tuple(kept), taken


def removed_objects(grounding: Grounding) -> tuple[LocatedObject, ...]:
    """What is taken away before the motion."""
    return tuple(each.object for each in grounding.interventions if each.kind == "remove")


def query_of(asked: Asked, grounding: Grounding, bodies: Sequence[SeenBody]) -> Query | None:
    """What a question asks of bodies; None where one that it names was not found under that name."""
    subjects = (0,) if asked.subject is None else bodies_named(asked.subject, grounding, bodies)
    targets = (None,) if asked.target is None else bodies_named(asked.target, grounding, bodies)
    among = [bodies_named(name, grounding, bodies) for name in asked.among]
    if not subjects or not targets or not all(among):
        return None
    known = tuple(dict.fromkeys(body for meant in among for body in meant))
    named = asked.model_copy(update={"among": tuple(bodies[body].name for body in known)})
    return Query(named, targets[0], subjects[0], known)


def bodies_named(words: str, grounding: Grounding, bodies: Sequence[SeenBody]) -> tuple[int, ...]:
    """The bodies that were found under a name; the mover is the first."""
    name = plain(words)
    if name == plain(grounding.object):
        return (0,)
    placed = (*others_of(grounding), *removed_objects(grounding))
    boxes = {other.bbox for other in placed if plain(other.object) == name}
    return tuple(i for i, body in enumerate(bodies) if i and body.bbox in boxes)


def _obstacle(scene: Scene, grounding: Grounding, obstacle: Obstacle) -> SeenBody:
    placed = (*others_of(grounding), *removed_objects(grounding))
    located = next((other for other in placed if other.bbox == obstacle.bbox), None)
    located = located or LocatedObject(object=obstacle.name, bbox=obstacle.bbox)
    return SeenBody(
        name=obstacle.name,
        bbox=obstacle.bbox,
        mask=obstacle.mask,
        shape=_shape(scene, located),
        source=located.source or "embedded",
        confidence=obstacle.confidence,
        prior=located.prior,
    )


def _shape(scene: Scene, located: LocatedObject) -> Shape:
    """What is said of it, else by its outline: a disc is a sphere, the rest stands upright."""
    if located.prior is not None and located.prior.shape is not None:
        return located.prior.shape
    region = scene.region_of(located.bbox)
    return "sphere" if region is not None and region.is_disc else "cylinder"


GIVEN_PITCH_SIGMA, GIVEN_ROLL_SIGMA = math.radians(1.0), math.radians(0.5)
GIVEN_FOCAL_SIGMA = 0.02  # of the logarithm
FIXED = 1e-6  # deviation of a focal length that must not vary


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
    mean, sigma = fit.mean.copy(), np.sqrt(np.diag(fit.covariance))
    roll, roll_sigma = fit.roll, fit.roll_sigma
    if given is not None and given.pitch is not None:
        mean[0], sigma[0] = math.radians(given.pitch), GIVEN_PITCH_SIGMA
    if given is not None and given.focal is not None and not fixed_focal:
        mean[1], sigma[1] = math.log(given.focal / width), GIVEN_FOCAL_SIGMA
    if given is not None and given.roll is not None:
        roll, roll_sigma = math.radians(given.roll), GIVEN_ROLL_SIGMA
    if fixed_focal:
        sigma[1] = FIXED
    source = fit.source if given is None else "request"
    return replace(fit, mean=mean, covariance=np.diag(sigma**2), roll=roll, roll_sigma=roll_sigma, source=source)
