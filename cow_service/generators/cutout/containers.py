"""Draws what goes into a container between its back and its front: the wall below the nearer rim hides it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import MovingBody, StillBody
from cow_service.generators.cutout.ground import Ground, Placed
from cow_service.vision.masks import CroppedMask, iou
from cow_service.vision.openings import SeenOpening, measure_opening
from cow_service.vision.types import Image, Mask

AROUND = 1.5  # of its half width: what is lower than that far from a container's middle may be in it
DEEPER = 0.02  # of the container's height: so far below the rim something is in it


@dataclass(frozen=True)
class Container:
    """The container that the mover is put into, and the part of it that is drawn over what is inside."""

    index: int  # of `Trajectory.bodies`
    holds: bool  # the mover goes in; else it lies on the rim
    front: StillBody  # the wall below the nearer edge of the opening, at the first frame
    ground: Ground

    def takes(self, body: MovingBody, frame: int) -> bool:
        """Whether a body is over or in the container at a frame: then the container as a whole does not hide it."""
        if body.path.body != 0:
            return False
        it, ground = self.ground.bodies[self.index], self.ground
        here = ground.camera.to_floor(np.array([body.path.states[frame][:3]]))[0]
        there = ground.camera.to_floor(np.array([it.position]))[0]
        return bool(np.hypot(here[0] - there[0], here[2] - there[2]) < AROUND * it.size[0] / 2)

    def covers(self, body: MovingBody, frame: int) -> bool:
        """Whether its front is drawn over a body at a frame."""
        placed, front = body.placed(frame), self.front.placed
        inside = placed.bottom < front.top - DEEPER * (front.top - front.bottom)
        return self.holds and inside and self.takes(body, frame)


def container_of(
    given: GeneratorInput, image: Image, moving: Sequence[MovingBody], still: Sequence[StillBody], ground: Ground | None
) -> Container | None:
    """The container of a clip image [h, w, 3] into which the mover is put; None where there is none."""
    placement = given.trajectory.placement
    targets = [each.targets[0].bbox for each in given.grounding.interventions if each.relation == "into"]
    if placement is None or ground is None or not targets:
        return None
    index = 1 + int(np.argmax([iou(targets[0], obstacle.bbox) for obstacle in given.obstacles]))
    masks = {body.path.body: body.mask for body in moving} | {body.index: body.mask for body in still}
    if index not in masks:
        return None
    mask = masks[index]
    seen = measure_opening(image, CroppedMask.of(mask))
    middle, half = ground.height(np.array(ground.bodies[index].position)), ground.bodies[index].size[1] / 2
    bbox = given.obstacles[index - 1].bbox
    placed = Placed(bbox, False, ground.bodies[index].position[2], middle - half, middle + half)
    front = StillBody(index, mask & _below_rim(mask, seen), placed)
    return Container(index, placement.result in ("inside", "sticks-out"), front, ground)


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
