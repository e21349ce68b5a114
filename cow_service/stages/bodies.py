"""The bodies of a scene, for the world: the mover and its obstacles, with their shapes."""

from __future__ import annotations

from collections.abc import Sequence

from cow_service.physics.bodies import SeenBody
from cow_service.readers.question.choices import plain
from cow_service.readers.question.shapes import is_cube, is_vehicle, shape_of
from cow_service.records import Asked, Grounding, LocatedObject, Shape
from cow_service.vision.masks import CroppedMask
from cow_service.vision.obstacles import Obstacle
from cow_service.vision.scene import Scene


def seen_bodies(scene: Scene, grounding: Grounding, obstacles: Sequence[Obstacle]) -> tuple[SeenBody, ...]:
    """The mover first, then the obstacles in their order."""
    mover = SeenBody(
        name=grounding.object,
        bbox=grounding.bbox,
        mask=CroppedMask.of(scene.silhouette(grounding.bbox)),
        shape=_shape(scene, LocatedObject(object=grounding.object, bbox=grounding.bbox, prior=grounding.prior)),
        source=grounding.source,
        prior=grounding.prior,
        elongated=is_vehicle(grounding.object),
        equal_sided=is_cube(grounding.object),
    )
    return mover, *(_obstacle(scene, grounding, obstacle) for obstacle in obstacles)


def target_of(asked: Asked, grounding: Grounding, bodies: Sequence[SeenBody]) -> int | None:
    """Which body a question asks about, where it was found under that name."""
    name = None if asked.target is None else plain(asked.target)
    boxes = {other.bbox for other in grounding.others if plain(other.object) == name}
    return next((i for i, body in enumerate(bodies) if i and body.bbox in boxes), None)


def _obstacle(scene: Scene, grounding: Grounding, obstacle: Obstacle) -> SeenBody:
    located = next((other for other in grounding.others if other.bbox == obstacle.bbox), None)
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
    """What is said of it, else by its noun, else by its outline: a disc is a sphere, the rest stands upright."""
    if located.prior is not None and located.prior.shape is not None:
        return located.prior.shape
    region = scene.region_of(located.bbox)
    return shape_of(located.object) or ("sphere" if region is not None and region.is_disc else "cylinder")
