"""Interventions on the image, before anything is generated: things are taken out of it, or put elsewhere in it.

What is taken away leaves its place with its shadow, and what it hid is completed. What is put elsewhere is drawn there.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from cow_service.generators.base import GeneratorInput, Scene
from cow_service.generators.cutout.bodies import Extent, Ground, StillBody, moving_bodies, still_bodies
from cow_service.generators.cutout.generator import compose
from cow_service.generators.cutout.layers import MAX_SIDE, CutoutOptions, take_apart, without_bodies
from cow_service.generators.cutout.shadows import take_shadows
from cow_service.media.images import BAND, fit_within
from cow_service.media.masks import CroppedMask, hull, resized_mask
from cow_service.media.types import Image, Mask
from cow_service.physics.camera import FloorCamera
from cow_service.records import BBox, Path, Point, Trajectory

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
    paths: list[Path] = []  # nothing moves but what is taken away
    for index in removed:
        (x, y), bodies = _middle(as_it_is.obstacles[index - 1].bbox), as_it_is.trajectory.bodies
        states = ((*(bodies[index].position if bodies else (0.0, 0.0, 0.0)), 0.0, 0.0, 0.0),) * 2
        points, visible = ((x, y), (AWAY, y)), (True, False)
        paths.append(Path(body=index, states=states, points=points, visible=visible, scale=(1.0, 1.0), tracks=()))
    leaving = replace(as_it_is, trajectory=as_it_is.trajectory.model_copy(update={"paths": tuple(paths)}))
    ground = Ground.of(leaving, size[0] / scene.width)
    moving = moving_bodies(leaving, size, ground)
    mover = as_it_is.grounding.bbox
    whole = resized_mask(scene.mover.full(), size)
    seen = whole & ~np.logical_or.reduce([body.mask for body in moving])
    extent = Extent(mover, False) if ground is None else ground.extent(0, mover)
    still = (*still_bodies(leaving, moving, size, ground), StillBody(0, seen, extent, whole))
    eye = 0.0 if ground is None else ground.camera.height
    unshaded = take_shadows(leaving, clean, moving, still, ground, size[0] / scene.width)
    fill = None if leaving.inpainter is None else partial(leaving.inpainter.fill, progress=lambda done: None)
    erased = without_bodies(unshaded, moving, still, eye, resized_mask(scene.cues, size), fill)
    changed = _with_changes(scene, erased)
    gone = np.logical_or.reduce([as_it_is.obstacles[index - 1].mask.full() for index in removed])
    behind = {
        each.index
        for each in still
        if any((each.outline & one.mask).any() and one.extent(0).is_in_front_of(each.extent, eye) for one in moving)
    }
    obstacles = tuple(
        replace(each, mask=_completed(each.mask, gone)) if index in behind else each
        for index, each in enumerate(as_it_is.obstacles[:kept], start=1)
    )
    if 0 in behind:
        changed = replace(changed, mover=_completed(scene.mover, gone))
    return replace(as_it_is, scene=changed, trajectory=trajectory, obstacles=obstacles)


def _completed(mask: CroppedMask, gone: Mask) -> CroppedMask:
    """A mask with the part of its hull that was hidden."""
    full = mask.full()
    return CroppedMask.of(full | (hull(full) & gone))


def _with_changes(scene: Scene, after: Image) -> Scene:
    """The scene with what was changed in a smaller copy [h, w, 3] of its clean image."""
    full = scene.clean
    if full.shape != after.shape:
        before = fit_within(full, MAX_SIDE)
        changed = (cv2.absdiff(before, after).max(axis=2) > CHANGED).astype(np.uint8)
        grown = cv2.dilate(changed, np.ones((FEATHER, FEATHER), np.uint8)).astype(np.float32)
        size = full.shape[1], full.shape[0]
        share = cv2.resize(cv2.GaussianBlur(grown, (0, 0), 1.5), size, interpolation=cv2.INTER_LINEAR)[..., None]
        enlarged, after = cv2.resize(after, size, interpolation=cv2.INTER_CUBIC), full.copy()
        for rows in (slice(top, top + BAND) for top in range(0, full.shape[0], BAND)):
            mixed = full[rows] + share[rows] * (enlarged[rows].astype(np.float32) - full[rows])
            after[rows] = np.where(share[rows] > 0, mixed, full[rows])
    image = np.where(scene.cues[..., None], scene.image, after) if scene.cues.any() else after
    return replace(scene, image=image, clean=after)


def with_put(given: GeneratorInput, factual: Trajectory) -> GeneratorInput:
    """The input with its scene as it is when the motion begins.

    `given` has the scene in which nothing is put elsewhere yet, and the trajectory after that; `factual` is that of
    the scene as it is. What is given stays known as `before`.
    """
    pairs = zip(given.trajectory.bodies, factual.bodies, strict=False)
    put = tuple(i for i, (body, seen) in enumerate(pairs) if body.bbox != seen.bbox)
    if not put:
        return given
    before, scene = replace(given, trajectory=_with_image_first(given, factual, put)), given.scene
    drawn = compose(take_apart(replace(before, options=CutoutOptions())), 1)
    changed = _with_changes(scene, drawn)
    obstacles, grounding = list(given.obstacles), given.grounding
    for path in before.trajectory.paths:
        if path.body not in put:
            continue
        bbox, degrees = given.trajectory.bodies[path.body].bbox, path.rotation[1] if path.rotation else 0.0
        mask = given.obstacles[path.body - 1].mask if path.body else scene.mover
        mask = mask.moved(np.array(path.points[0]), np.array(path.points[1]), path.scale[1], degrees)
        if path.body:
            obstacles[path.body - 1] = replace(obstacles[path.body - 1], bbox=bbox, mask=mask)
        else:
            changed = replace(changed, mover=mask, shadow=None)
            grounding = grounding.model_copy(update={"bbox": bbox, "point": path.points[1]})
    return replace(given, scene=changed, obstacles=tuple(obstacles), grounding=grounding, before=before)


def _with_image_first(given: GeneratorInput, factual: Trajectory, put: Sequence[int]) -> Trajectory:
    """The trajectory with one frame more, before the others, in which all is where the image shows it.

    What is put elsewhere has a path, whether it moves in the clip or not.
    """
    told = given.trajectory
    assert told.camera is not None  # every world has one
    camera = FloorCamera.of(told.camera, given.scene.width, given.scene.height)
    paths = list(told.paths)
    for index in set(put) - {path.body for path in told.paths}:  # what stays at its new place
        seen, body, count = factual.bodies[index], told.bodies[index], told.num_frames
        old, new = camera.project(np.array([seen.position, body.position]))
        x, y = (new + (np.array(_middle(seen.bbox)) - old) * seen.position[2] / body.position[2]).tolist()
        states, points = ((*body.position, 0.0, 0.0, 0.0),) * count, ((x, y),) * count
        still = Path(body=index, states=states, points=points, visible=(True,) * count, scale=(1.0,) * count, tracks=())
        paths.append(still)
    for place, path in enumerate(paths):
        state, start, scale, rotation = path.states[0], path.points[0], path.scale, path.rotation
        if path.body in put:  # it begins as large and turned against how the image shows it
            seen, body = factual.bodies[path.body], told.bodies[path.body]
            state = (*seen.position, 0.0, 0.0, 0.0)
            start = given.grounding.point if path.body == 0 else _middle(seen.bbox)
            factor = seen.position[2] / body.position[2]
            scale = tuple(factor * each for each in scale)
            rotation = tuple(body.rotation + each for each in rotation or (0.0,) * len(path.points))
        update = {
            "states": (state, *path.states),
            "points": (start, *path.points),
            "visible": (True, *path.visible),
            "scale": (1.0, *scale),
            "rotation": (0.0, *rotation) if rotation else (),
            "band": (),
            "futures": (),
            "turns": (),
            "tracks": (),
            "tracks_visible": None,
        }
        paths[place] = path.model_copy(update=update)
    bodies = tuple(factual.bodies[i] if i in put else body for i, body in enumerate(told.bodies))
    return told.model_copy(update={"bodies": bodies, "paths": tuple(paths)})


def _middle(bbox: BBox) -> Point:
    return (bbox[0] + bbox[2]) / 2, (bbox[1] + bbox[3]) / 2
