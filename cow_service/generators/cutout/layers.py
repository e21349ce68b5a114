"""Takes a scene apart: the background without what moves and its shadows, sprites, and what stands still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import (
    Ground,
    MovingBody,
    Placed,
    Sprite,
    StillBody,
    cut,
    moving_body,
    still_bodies,
)
from cow_service.generators.cutout.shadows import Lit, Shadow, take_shadows
from cow_service.media.images import fit_within
from cow_service.records import BBox
from cow_service.vision.inpainting import fill_hole
from cow_service.vision.masks import CroppedMask, Image, Mask, hull, iou, resized_mask, window_of
from cow_service.vision.openings import SeenOpening, measure_opening

AROUND = 1.5  # of its half width: what is lower than that far from a container's middle may be in it
DEEPER = 0.02  # of the container's height: so far below the rim something is in it


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
        placed, front = body.placed(frame), self.front.placed
        inside = placed.bottom < front.top - DEEPER * (front.top - front.bottom)
        return self.holds and inside and self.takes(body, frame)


def containers_of(
    given: GeneratorInput, image: Image, moving: Sequence[MovingBody], still: Sequence[StillBody], ground: Ground | None
) -> tuple[Container, ...]:
    """The containers of a clip image [h, w, 3] into which bodies are put."""
    if ground is None:
        return ()
    results = {each.body: each.result for each in given.trajectory.placed}
    if given.trajectory.placement is not None:
        results[0] = given.trajectory.placement.result
    found: list[Container] = []
    for each in given.grounding.interventions:
        if each.relation != "into":
            continue
        content, index = (_body_at(given, thing.bbox) for thing in (each.object, each.targets[0]))
        if content in results and index != content:
            holds = results[content] in ("inside", "sticks-out")
            container = _container(image, moving, still, ground, index, content, holds=holds)
            found += [] if container is None else [container]
    return tuple(found)


def _body_at(given: GeneratorInput, bbox: BBox) -> int:
    """The body that is seen in a box."""
    shared = [iou(bbox, given.grounding.bbox), *(iou(bbox, obstacle.bbox) for obstacle in given.obstacles)]
    return int(np.argmax(shared))


def _container(
    image: Image,
    moving: Sequence[MovingBody],
    still: Sequence[StillBody],
    ground: Ground,
    index: int,
    content: int,
    *,
    holds: bool,
) -> Container | None:
    masks = {body.path.body: body.mask for body in moving} | {body.index: body.mask for body in still}
    if index not in masks:
        return None
    mask, it = masks[index], ground.bodies[index]
    front_mask = mask & _below_rim(mask, measure_opening(image, CroppedMask.of(mask)))
    middle, half = ground.height(np.array(it.position)), it.size[1] / 2
    placed = Placed(it.bbox, False, it.position[2], middle - half, middle + half)
    goes = next((body for body in moving if body.path.body == index), None)
    sprite = None
    if goes is not None:
        x, y = (ground.factor * float(v) for v in goes.start)
        sprite = cut(image, front_mask, None, (x, y), it.shape)
    return Container(index, content, holds, StillBody(index, front_mask, placed), ground, goes, sprite)


def _below_rim(mask: Mask, seen: SeenOpening) -> Mask:
    """Where an image is below the nearer edge of an opening [h, w]; without a rim, below the mask's upper third."""
    height, width = mask.shape
    rows, columns = np.mgrid[:height, :width] + 0.5
    if seen.rim is None:
        x0, y0, x1, y1 = CroppedMask.of(mask).bbox
        x, y, half, tall = (x0 + x1) / 2, y0 + (y1 - y0) / 6, (x1 - x0) / 2, (y1 - y0) / 6
    else:
        x, y, half, tall = seen.rim
    x0, _, x1, _ = CroppedMask.of(mask).bbox
    inner = min(1.0, seen.inner * (x1 - x0) / 2 / half)
    off = np.clip((columns - x) / (inner * half), -1, 1)
    return rows > y + inner * tall * np.sqrt(1 - off**2)


MAX_SIDE = 1280  # px: longer images give a clip of this size
HOLE_GROWTH = 0.03  # of the object's size: the rim, mixed with the background, is inpainted too
SHADED_RIM = 3  # px: so much more of it where a contact shadow was taken out, which is not known right at the object


class CutoutOptions(BaseModel):
    """What `generator_options` may hold for the cutout generator."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    clean_cues: bool = Field(default=True, description="Take drawn arrows and boxes out of the frames.")


@dataclass(frozen=True)
class Layers:
    """What is composed, at the clip's size."""

    image: Image  # [h, w, 3]: the scene before anything moves
    background: Image  # [h, w, 3] without what moves and its shadows
    moving: tuple[MovingBody, ...]
    sprites: tuple[Sprite, ...]  # of the moving bodies
    shadows: tuple[Shadow, ...]
    still: tuple[StillBody, ...]
    containers: tuple[Container, ...]  # into which bodies are put
    eye: float  # m: the camera's height above the floor, 0 where unknown
    factor: float  # clip px per image px


def take_apart(given: GeneratorInput) -> Layers:
    """All that the frames are composed of."""
    scene = given.scene
    clean = cast(CutoutOptions, given.options).clean_cues  # the generator's own `options_model`
    image = fit_within(scene.clean if clean else scene.image, MAX_SIDE)
    size = image.shape[1], image.shape[0]
    factor = image.shape[1] / scene.width
    ground = Ground.of(given, factor)
    eye = 0.0 if ground is None else ground.camera.height
    moving = tuple(moving_body(given, path, size, ground) for path in given.trajectory.paths)
    still = still_bodies(given, moving, size, ground)
    lit = take_shadows(given, image, moving, still, ground, factor)
    cues = resized_mask(scene.cues, size) if clean else None
    background, sprites = without_bodies(lit, moving, still, eye, cues), list[Sprite]()
    for body in moving:
        hidden = _hidden(body, moving, still, eye)
        shape = None if ground is None else ground.bodies[body.path.body].shape
        start = (factor * float(body.start[0]), factor * float(body.start[1]))
        sprites.append(cut(image, body.mask, hidden, start, shape))
    containers = containers_of(given, image, moving, still, ground)
    return Layers(image, background, moving, tuple(sprites), lit.shadows, still, containers, eye, factor)


def without_bodies(
    lit: Lit, moving: tuple[MovingBody, ...], still: tuple[StillBody, ...], eye: float, cues: Mask | None
) -> Image:
    """A scene without shadows [h, w, 3], with the bodies that move taken out of it, too."""
    image = lit.image
    for body in moving:
        hole = _hole(body, lit.lost.get(body.path.body), cues)
        image = _without(image, hole, body, moving, still, eye)
    return image


def _hidden(body: MovingBody, moving: tuple[MovingBody, ...], still: tuple[StillBody, ...], eye: float) -> Mask | None:
    """What nearer bodies hide of a body at the first frame: of a sphere's disc; of the hull of what is seen, else."""
    placed = body.placed(0)
    window = window_of(body.mask, 2)
    others = [(other.mask, other.placed) for other in still]
    others += [(other.mask, other.placed(0)) for other in moving if other is not body]
    if window is None:
        return None
    nearer = [mask for mask, at in others if mask[window].any() and not placed.in_front_of(at, eye)]
    if not nearer:
        return None
    hidden = (hull(body.mask) | body.disc) & np.logical_or.reduce(nearer) & ~body.mask
    return hidden if hidden.any() else None


def _hole(body: MovingBody, lost: Mask | None, cues: Mask | None) -> Mask:
    """Where a body [h, w] leaves something to fill in: it, its rim, and what lies in its contact shadow's depth."""
    growth = max(2, round(HOLE_GROWTH * float(np.sqrt(np.count_nonzero(body.mask)))))
    hole = _dilated(body.mask, 2 * (growth if lost is None else growth + SHADED_RIM) + 1)
    if lost is not None:
        hole |= lost
    if cues is not None:  # where a cue next to the body was inpainted, the body's colour has spread
        hole |= cues & _dilated(hole, 2 * growth + 1, 3)
    return hole


def _without(
    image: Image, hole: Mask, body: MovingBody, moving: tuple[MovingBody, ...], still: tuple[StillBody, ...], eye: float
) -> Image:
    """The image with one body taken out: first what is behind it is completed, then the rest filled with floor."""
    window = window_of(hole, 2)
    if window is None:
        return image
    objects, behind = np.zeros_like(hole), list[StillBody]()
    for other in still:
        objects |= other.mask
        if other.mask[window].any() and body.placed(0).in_front_of(other.placed, eye):
            behind.append(other)
    solid = objects & ~body.mask
    for other in behind:
        if other.index == body.support:  # its top around the foot was in the shadow
            solid &= ~other.mask
    rest = hole & ~solid
    for other in moving:
        objects |= other.mask & ~body.mask if other is not body else False
    for other in behind:
        part = other.outline & rest
        if part.any():
            image = fill_hole(image, part, ~other.mask)
            rest &= ~part
            objects |= part
    return fill_hole(image, rest, objects)


def _dilated(mask: Mask, width: int, iterations: int = 1) -> Mask:
    """A mask [h, w] grown by an ellipse of a width (px); only its window is looked at."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (width, width))
    window = window_of(mask, iterations * (width // 2 + 1))
    if window is None:
        return mask.copy()
    grown = np.zeros_like(mask)
    grown[window] = cv2.dilate(mask[window].astype(np.uint8), kernel, iterations=iterations) > 0
    return grown
