"""Takes a scene apart: the background without what moves and its shadows, sprites, and what stands still."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import MovingBody, StillBody, moving_body, still_bodies
from cow_service.generators.cutout.containers import Container, containers_of
from cow_service.generators.cutout.ground import Ground
from cow_service.generators.cutout.measuring import Lit, take_shadows
from cow_service.generators.cutout.shadows import Shadow
from cow_service.generators.cutout.sprites import Sprite, cut
from cow_service.media.images import fit_within
from cow_service.vision.inpainting import fill_hole
from cow_service.vision.masks import Image, Mask, hull, resized_mask, window_of

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
