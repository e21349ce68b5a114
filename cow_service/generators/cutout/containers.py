"""Draws what goes into a container between its back and its front: the wall below the nearer rim hides it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import MovingBody, StillBody
from cow_service.generators.cutout.ground import Ground, Placed
from cow_service.generators.cutout.sprites import Sprite, cut
from cow_service.records import BBox
from cow_service.vision.masks import CroppedMask, Image, Mask, iou
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
