"""Splits a scene: the background without moving objects and their shadows, sprites, and still objects."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import cast

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import Ground, MovingBody, Sprite, StillBody, moving_bodies, still_bodies
from cow_service.generators.cutout.shadows import MovingShadow, UnshadedScene, take_shadows
from cow_service.media.images import fit_within
from cow_service.media.masks import CroppedMask, hull, iou, resized_mask, window_of
from cow_service.media.types import Image, Mask
from cow_service.perception.classical.inpainting import blend_fill, fill_hole, shadow_beside
from cow_service.perception.classical.openings import measure_opening

MAX_SIDE = 1280  # px: longer images give a clip of this size
HOLE_GROWTH = 0.03  # of the object's size: the rim, mixed with the background, is inpainted too
DRAWN_RIM = 9  # px: twice the width of the blur around what is drawn
SHADED_RIM = 3  # px: so much more of it where a contact shadow was taken out, which is not known right at the object
AROUND = 1.5  # of its half width: what is lower than that far from a container's middle may be in it
DEEPER = 0.02  # of the container's height: so far below the rim something is in it


class CutoutOptions(BaseModel):
    """What `generator_options` may hold for the cutout generator."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    clean_cues: bool = Field(default=True, description="Remove drawn arrows and boxes from the frames.")


@dataclass(frozen=True)
class Container:
    """A container that a body is put into, and the part of it that is drawn over what is inside."""

    index: int  # of `Trajectory.bodies`
    content: int  # the body that is put into it, of `Trajectory.bodies`
    holds: bool  # the body goes in; else it lies on the rim
    front: StillBody  # the wall below the nearer edge of the opening, at the first frame
    ground: Ground
    moving: MovingBody | None  # the container, where it moves
    sprite: Sprite | None  # of its front, where it moves

    def takes(self, body: MovingBody, frame: int) -> bool:
        """Whether a body is over or in the container at a frame: then the container as a whole does not hide it."""
        if body.path.body != self.content:
            return False
        it, ground = self.ground.bodies[self.index], self.ground
        position = it.position if self.moving is None else self.moving.path.states[frame][:3]
        here, there = ground.camera.to_floor(np.array([body.path.states[frame][:3], position]))
        return bool(np.hypot(here[0] - there[0], here[2] - there[2]) < AROUND * it.size[0] / 2)

    def covers(self, body: MovingBody, frame: int) -> bool:
        """Whether its front is drawn over a body at a frame."""
        front = self.front.extent
        inside = body.extent(frame).bottom < front.top - DEEPER * (front.top - front.bottom)
        return self.holds and inside and self.takes(body, frame)


@dataclass(frozen=True)
class Layers:
    """What is composed, at the clip's size."""

    image: Image  # [h, w, 3]: the scene before anything moves
    background: Image  # [h, w, 3] without what moves and its shadows
    moving: tuple[MovingBody, ...]
    sprites: tuple[Sprite, ...]  # of the moving bodies
    shadows: tuple[MovingShadow, ...]
    still: tuple[StillBody, ...]
    containers: tuple[Container, ...]  # into which bodies are put
    eye: float  # m: the camera's height above the floor, 0 where unknown
    factor: float  # clip px per image px


def take_apart(given: GeneratorInput, progress: Callable[[float], None] = lambda done: None) -> Layers:
    """All that the frames are composed of. `progress` hears how far an inpainter is, and may raise `Canceled`."""
    scene = given.scene
    clean = cast(CutoutOptions, given.options).clean_cues  # the generator's own `options_model`
    image = fit_within(scene.clean if clean else scene.image, MAX_SIDE)
    size = image.shape[1], image.shape[0]
    factor = image.shape[1] / scene.width
    ground = Ground.of(given, factor)
    eye = 0.0 if ground is None else ground.camera.height
    moving = moving_bodies(given, size, ground)
    still = still_bodies(given, moving, size, ground)
    if scene.backdrop is None:
        unshaded = take_shadows(given, image, moving, still, ground, factor)
        cues = resized_mask(scene.cues, size) if clean else None
        fill = None if given.inpainter is None else partial(given.inpainter.fill, progress=progress)
        background = without_bodies(unshaded, moving, still, eye, cues, fill)
    else:  # a drawing has no shadows, and what is behind its things is known
        unshaded, background = UnshadedScene(image, {}, frozenset(), ()), image.copy()
        holes = np.logical_or.reduce([_dilated(body.mask, DRAWN_RIM) for body in moving])
        holes &= ~np.logical_or.reduce([np.zeros_like(holes), *(body.mask for body in still)])
        background[holes] = fit_within(scene.backdrop, MAX_SIDE)[holes]
    sprites: list[Sprite] = []
    for body in moving:
        hidden = hidden_part(body, moving, still, eye)
        shape = None if ground is None else ground.bodies[body.path.body].shape
        sprites.append(Sprite.of(image, body.mask, hidden, factor * body.start, shape))
    containers = () if ground is None else _containers(given, image, moving, still, ground)
    return Layers(image, background, moving, tuple(sprites), unshaded.shadows, still, containers, eye, factor)


def hidden_part(body: MovingBody, moving: Sequence[MovingBody], still: Sequence[StillBody], eye: float) -> Mask | None:
    """What nearer bodies hide of one at the first frame: of a sphere's disc; of the hull of what is seen, else."""
    extent, window = body.extent(0), window_of(body.mask, 2) or (slice(0, 0), slice(0, 0))
    others = [(other.mask, other.extent) for other in still]
    others += [(other.mask, other.extent(0)) for other in moving if other is not body]
    nearer = [mask for mask, at in others if mask[window].any() and not extent.is_in_front_of(at, eye)]
    if not nearer:
        return None
    return (hull(body.mask) | body.disc) & np.logical_or.reduce(nearer) & ~body.mask


def without_bodies(
    unshaded: UnshadedScene,
    moving: Sequence[MovingBody],
    still: Sequence[StillBody],
    eye: float,
    cues: Mask | None,
    fill: Callable[[Image, Mask], Image] | None = None,
) -> Image:
    """A scene without shadows [h, w, 3], with the bodies that move taken out of it, too.

    `fill` paints all that they hid in one call; without it each hole is closed from what lies around it.
    """
    image = unshaded.image
    gone, stays = np.zeros(image.shape[:2], bool), np.zeros(image.shape[:2], bool)
    for body in moving:
        hole = _hole_of(body, unshaded, cues)
        window = window_of(hole, 2)
        if window is None:
            continue
        # First what is behind it is completed, then the rest filled with floor.
        objects, behind = np.zeros_like(hole), list[StillBody]()
        for other in still:
            objects |= other.mask
            if other.mask[window].any() and body.extent(0).is_in_front_of(other.extent, eye):
                behind.append(other)
        # The top of what it stands on was in the shadow around its foot.
        support = [other.mask for other in behind if other.index == body.support]
        rest = hole & ~(objects & ~np.logical_or.reduce([body.mask, *support]))
        if fill is not None:
            if body.path.body in unshaded.unmeasured:
                rest |= shadow_beside(image, rest, objects)
            gone, stays = gone | rest, stays | objects
            continue
        for other in moving:
            objects |= other.mask & ~body.mask if other is not body else False
        for other in behind:
            part = other.outline & rest
            if part.any():
                image = fill_hole(image, part, ~other.mask)
                rest &= ~part
                objects |= part
        image = fill_hole(image, rest, objects)
    if fill is not None and gone.any():
        image = blend_fill(image, fill(image, gone), gone, stays & ~gone)
    return image


def _hole_of(body: MovingBody, unshaded: UnshadedScene, cues: Mask | None) -> Mask:
    """The hole of a removed body [h, w]: its mask, its rim, and parts next to it that were too dark."""
    noisy = unshaded.noisy.get(body.path.body)
    growth = max(2, round(HOLE_GROWTH * float(np.sqrt(np.count_nonzero(body.mask)))))
    hole = _dilated(body.mask, 2 * (growth if noisy is None else growth + SHADED_RIM) + 1)
    if noisy is not None:
        hole |= noisy
    if cues is not None:  # where a cue next to the body was inpainted, the body's colour has spread
        hole |= cues & _dilated(hole, 2 * growth + 1, 3)
    return hole


def _dilated(mask: Mask, width: int, iterations: int = 1) -> Mask:
    """A mask [h, w] grown by an ellipse of a width (px); only its window is looked at."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    window = window_of(mask, iterations * (width // 2 + 1))
    if window is None:
        return mask.copy()
    grown = np.zeros_like(mask)
    grown[window] = cv2.dilate(mask[window].astype(np.uint8), kernel, iterations=iterations) > 0
    return grown


def _containers(
    given: GeneratorInput, image: Image, moving: Sequence[MovingBody], still: Sequence[StillBody], ground: Ground
) -> tuple[Container, ...]:
    """The containers of a clip image [h, w, 3] into which bodies are put."""
    results = {each.body: each.result for each in given.trajectory.placed}
    if given.trajectory.placement is not None:
        results[0] = given.trajectory.placement.result
    boxes = [given.grounding.bbox, *(obstacle.bbox for obstacle in given.obstacles)]
    masks = {body.path.body: body.mask for body in moving} | {body.index: body.mask for body in still}
    paths = {body.path.body: body for body in moving}
    found: list[Container] = []
    for each in given.grounding.interventions:
        if each.relation != "into":
            continue
        content, index = (
            int(np.argmax([iou(thing.bbox, box) for box in boxes])) for thing in (each.object, each.targets[0])
        )
        if content not in results or index == content or index not in masks:
            continue
        it, body, front_mask = ground.bodies[index], paths.get(index), front_of(masks[index])
        front = StillBody(index, front_mask, ground.extent(index, it.bbox))
        sprite = None if body is None else Sprite.of(image, front_mask, None, ground.factor * body.start, it.shape)
        holds = results[content] in ("inside", "sticks-out")
        found.append(Container(index, content, holds, front, ground, body, sprite))
    return tuple(found)


def front_of(mask: Mask) -> Mask:
    """A container's mask [h, w] below the nearer edge of its opening; without a rim, below its upper third."""
    cropped = CroppedMask.of(mask)
    seen, (x0, y0, x1, y1) = measure_opening(cropped), cropped.bbox
    x, y, half, tall = seen.rim or ((x0 + x1) / 2, y0 + (y1 - y0) / 6, (x1 - x0) / 2, (y1 - y0) / 6)
    inner = min(1.0, seen.inner * (x1 - x0) / 2 / half)
    rows, columns = np.ogrid[: mask.shape[0], : mask.shape[1]]
    off = np.clip((columns + 0.5 - x) / (inner * half), -1, 1)
    return mask & (rows + 0.5 > y + inner * tall * np.sqrt(1 - off**2))
