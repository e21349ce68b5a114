"""Takes things out of a scene before anything is generated: they, their shadows, and what they hide is completed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import MovingBody, StillBody, moving_body, still_bodies
from cow_service.generators.cutout.ground import Ground, Placed
from cow_service.generators.cutout.layers import MAX_SIDE, without_bodies
from cow_service.generators.cutout.measuring import take_shadows
from cow_service.media.images import fit_within
from cow_service.records import Path, Trajectory
from cow_service.vision.masks import CroppedMask, Image, Mask, hull, resized_mask

AWAY = 1e6  # px: where the path of what is taken away ends
CHANGED = 3  # grey levels: what differs less is as it was
FEATHER = 5  # px at the clip's size, around what was changed


def without_removed(as_it_is: GeneratorInput, removed: Sequence[int], trajectory: Trajectory) -> GeneratorInput:
    """The input with some bodies taken out of its scene, for the trajectory of the world without them.

    `as_it_is` has the factual trajectory, whose last bodies are the `removed` ones. What is behind them is completed,
    in the image and in its masks.
    """
    scene, kept = as_it_is.scene, len(as_it_is.obstacles) - len(removed)
    clean = fit_within(scene.clean, MAX_SIDE)
    size = clean.shape[1], clean.shape[0]
    leaving = _leaving(as_it_is, removed)
    ground = Ground.of(leaving, size[0] / scene.width)
    moving = tuple(moving_body(leaving, path, size, ground) for path in leaving.trajectory.paths)
    still = (*still_bodies(leaving, moving, size, ground), _mover(leaving, moving, size, ground))
    eye = 0.0 if ground is None else ground.camera.height
    lit = take_shadows(leaving, clean, moving, still, ground, size[0] / scene.width)
    erased = without_bodies(lit, moving, still, eye, resized_mask(scene.cues, size))
    image = at_full_size(scene.clean, clean, erased)
    drawn = np.where(scene.cues[..., None], scene.image, image)
    gone = np.logical_or.reduce([as_it_is.obstacles[index - 1].mask.full() for index in removed])
    behind = {each.index for each in still if _is_behind(each, moving, eye)}
    obstacles = tuple(
        replace(each, mask=_completed(each.mask, gone)) if index in behind else each
        for index, each in enumerate(as_it_is.obstacles[:kept], start=1)
    )
    changed = scene.changed(np.asarray(drawn, np.uint8), image)
    if 0 in behind:
        mover = as_it_is.grounding.bbox
        changed = changed.with_mask(mover, _completed(CroppedMask.of(scene.silhouette(mover)), gone).full())
    return replace(as_it_is, scene=changed, trajectory=trajectory, obstacles=obstacles)


def _leaving(given: GeneratorInput, removed: Sequence[int]) -> GeneratorInput:
    """The input with a trajectory in which nothing moves but what is taken away."""
    paths: list[Path] = []
    for index in removed:
        x0, y0, x1, y1 = given.obstacles[index - 1].bbox
        start, bodies = ((x0 + x1) / 2, (y0 + y1) / 2), given.trajectory.bodies
        x, y, z = bodies[index].position if bodies else (0.0, 0.0, 0.0)
        state = (x, y, z, 0.0, 0.0, 0.0)
        paths.append(
            Path(
                body=index,
                states=(state, state),
                points=(start, (AWAY, start[1])),
                visible=(True, False),
                scale=(1.0, 1.0),
                tracks=(),
            )
        )
    return replace(given, trajectory=given.trajectory.model_copy(update={"paths": tuple(paths)}))


def _mover(
    given: GeneratorInput, moving: Sequence[MovingBody], size: tuple[int, int], ground: Ground | None
) -> StillBody:
    """The mover, which stands still before anything moves."""
    mask = whole = resized_mask(given.scene.silhouette(given.grounding.bbox), size)
    for body in moving:
        mask = mask & ~body.mask
    placed = Placed(given.grounding.bbox, airborne=False)
    if ground is not None:
        body = ground.bodies[0]
        middle, half = ground.height(np.array(body.position)), body.size[1] / 2
        placed = Placed(given.grounding.bbox, False, body.position[2], middle - half, middle + half)
    return StillBody(0, mask, placed, whole)


def _is_behind(body: StillBody, moving: Sequence[MovingBody], eye: float) -> bool:
    """Whether something that is taken away hid a part of a body."""
    return any((body.outline & one.mask).any() and one.placed(0).in_front_of(body.placed, eye) for one in moving)


def _completed(mask: CroppedMask, gone: Mask) -> CroppedMask:
    """A mask with the part of its hull that was hidden."""
    full = mask.full()
    return CroppedMask.of(full | (hull(full) & gone))


def at_full_size(full: Image, before: Image, after: Image) -> Image:
    """An image [H, W, 3] with what was changed in a smaller copy of it."""
    if full.shape == after.shape:
        return after
    changed = (cv2.absdiff(before, after).max(axis=2) > CHANGED).astype(np.uint8)
    share = cv2.GaussianBlur(cv2.dilate(changed, np.ones((FEATHER, FEATHER), np.uint8)).astype(np.float32), (0, 0), 1.5)
    size = full.shape[1], full.shape[0]
    share = cv2.resize(share, size, interpolation=cv2.INTER_LINEAR)[..., None]
    enlarged = cv2.resize(after, size, interpolation=cv2.INTER_CUBIC)
    return np.where(share > 0, full + share * (enlarged.astype(np.float32) - full), full).astype(np.uint8)
