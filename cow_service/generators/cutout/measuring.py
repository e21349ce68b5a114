"""Finds the shadows of what moves in the image, takes them out of it, and says how each goes with its body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import MovingBody, StillBody
from cow_service.generators.cutout.ground import Ground
from cow_service.generators.cutout.shade import (
    LEAST_SHADE,
    Shade,
    cast_shade,
    contact_shade,
    drawn,
    floor_in_light,
    reach,
    strongest,
)
from cow_service.generators.cutout.shadows import (
    AttachedShadow,
    CastShadow,
    ContactShadow,
    Shadow,
    SkyShadow,
    cast_onto,
)
from cow_service.generators.cutout.sprites import clipped
from cow_service.records import Vector
from cow_service.vision.masks import Floats, Image, Mask, bbox_of
from cow_service.vision.shadows import find_shadow

DEEP = 0.55  # share of light: with more taken away, noise is all that dividing brings back
LEAST_SPREAD, TEXTURE = 0.02, 2.5  # of the lightness, deviations of the texture: so far a lit floor's colours spread
RIM = 2  # px around an object, where its colours mix with those of the floor
STRETCH = 1.25  # of a sphere's radius: how far its shadow reaches from its middle


@dataclass(frozen=True)
class Lit:
    """A scene without the shadows of what moves."""

    image: Image  # [h, w, 3]
    lost: dict[int, Mask]  # by `Path.body`: where a body with a contact shadow has left too little to divide
    shadows: tuple[Shadow, ...]


def take_shadows(
    given: GeneratorInput,
    image: Image,
    moving: Sequence[MovingBody],
    still: Sequence[StillBody],
    ground: Ground | None,
    factor: float,
) -> Lit:
    """The scene [h, w, 3] without the shadows of the bodies that move, and these shadows."""
    objects = np.zeros(image.shape[:2], bool)
    for body in (*moving, *still):
        objects |= body.mask
    floor, shadows = _shrunk(~objects), list[Shadow]()
    lost = dict[int, Mask]()
    for body in (body for body in moving if _moves(body)):
        index = body.path.body
        if ground is not None and ground.bodies[index].support == "air":
            shadows.append(SkyShadow(ground, body.path))
            cast = _cast(given, image, body, ground, floor)
            if cast is not None:
                shadows.append(cast)
                image, _ = _lit(image, cast.shade, ~objects)
            continue
        masks = [other.mask for other in still if other.index == body.support]
        beside = _shrunk(masks[0]) if masks else floor
        shade = None if body.airborne else contact_shade(image, body.mask, bbox_of(body.mask), beside)
        if shade is None:
            continue
        if ground is None:
            start = (factor * float(body.start[0]), factor * float(body.start[1]))
            shadows.append(AttachedShadow(shade, body.path, start, factor))
        else:
            shadows.append(ContactShadow(ground, body.path, shade, body.support))
        image, lost[index] = _lit(image, shade, masks[0] if masks else ~objects)
    return Lit(image, lost, tuple(shadows))


def _shrunk(mask: Mask) -> Mask:
    """A mask [h, w] without its rim."""
    return cv2.erode(mask.astype(np.uint8), np.ones((2 * RIM + 1, 2 * RIM + 1), np.uint8)) > 0


def _moves(body: MovingBody) -> bool:
    """Whether it leaves its place by a pixel at some frame."""
    points = np.array(body.path.points)
    return bool(np.abs(points - points[0]).max() > 1) or bool(np.ptp(body.path.scale) > 0.01)


def _cast(given: GeneratorInput, image: Image, body: MovingBody, ground: Ground, floor: Mask) -> CastShadow | None:
    """The shadow of a thing in the air: where the light says, or else where one is found below the mover."""
    first = np.array(body.path.states[0][:3])
    light = given.trajectory.light
    if light is None and body.path.body == 0:
        light = _light_of_shadow(given, first, ground)
    if light is None:
        return None
    middle = cast_onto(ground, first, light, 0.0)
    outline = ground.bodies[body.path.body].size[0] / 2 * STRETCH * _ring(ground)
    points = np.array([ground.project(middle + step) for step in outline])
    height, width = floor.shape
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    if middle[2] <= 0 or x1 < 2 or y1 < 2 or x0 > width - 2 or y0 > height - 2:
        return None
    ellipse = np.zeros(floor.shape, np.uint8)
    inner = 0.7 * points + 0.3 * points.mean(axis=0)
    cv2.fillConvexPoly(ellipse, np.rint(inner).astype(np.int32), 1)
    seed = (ellipse > 0) & floor
    shade = cast_shade(image, seed, (float(x0), float(y0), float(x1), float(y1)), floor)
    return None if shade is None else CastShadow(ground, body.path, shade, light)


def _light_of_shadow(given: GeneratorInput, first: Floats, ground: Ground) -> Vector | None:
    """Metres right and ahead per metre of height, from a shadow found in the image."""
    found = find_shadow(given.scene, given.grounding.bbox)
    if found is None:
        return None
    there = ground.camera.floor_points(np.array([found.centre]))
    high = ground.height(first)
    if not np.isfinite(there).all() or high <= 0:
        return None
    gap = ground.camera.to_floor(there)[0] - ground.camera.to_floor(first[None])[0]
    return float(gap[0]) / high, float(gap[2]) / high


def _ring(ground: Ground) -> Floats:
    """Unit steps [N, 3] around a point of the floor."""
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    camera = ground.camera
    return np.cos(angles)[:, None] * camera.right + np.sin(angles)[:, None] * camera.ahead


def _lit(image: Image, shade: Shade, where: Mask) -> tuple[Image, Mask]:
    """The image [h, w, 3] with a shade taken out of it in a mask, and a mask of where that leaves nothing but noise."""
    none, deep = np.zeros(2), np.zeros_like(where)
    window = clipped(*reach(shade, np.eye(2), none, none), (image.shape[1], image.shape[0]))
    if window is None:
        return image, deep
    dark = np.where(where[window][..., None], drawn(shade, np.eye(2), none, none, window), np.float32(0))
    result = image.copy()
    lit = image[window] / (1 - dark)
    # At a sharp edge of the shadow a pixel more or less would leave a line: nothing differs more than its texture.
    floor, spread = floor_in_light(shade, window), max(LEAST_SPREAD, TEXTURE * shade.texture)
    bounded = np.clip(lit, (1 - spread) * floor, (1 + spread) * floor)
    shaded = np.clip(cv2.dilate(strongest(dark), np.ones((5, 5), np.uint8)) / LEAST_SHADE, 0, 1)[..., None]
    result[window] = np.clip(shaded * bounded + (1 - shaded) * lit + 0.5, 0, 255).astype(np.uint8)
    deep[window] = dark @ np.full(3, 1 / 3, np.float32) > DEEP
    return result, deep
