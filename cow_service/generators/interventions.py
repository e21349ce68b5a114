"""Puts things elsewhere in a scene before anything is generated: they leave their places, and are drawn at new ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import Ground, MovingBody, Placed, StillBody, moving_body, still_bodies
from cow_service.generators.cutout.generator import Compositor
from cow_service.generators.cutout.layers import MAX_SIDE, CutoutOptions, without_bodies
from cow_service.generators.cutout.shadows import take_shadows
from cow_service.media.images import fit_within
from cow_service.physics.camera import FloorCamera
from cow_service.records import Body, Path, Point, Trajectory
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


def put_elsewhere(trajectory: Trajectory, factual: Trajectory) -> tuple[int, ...]:
    """The bodies that are not where the scene as it is has them when the motion begins."""
    pairs = zip(trajectory.bodies, factual.bodies, strict=False)
    return tuple(i for i, (body, seen) in enumerate(pairs) if body.bbox != seen.bbox)


def with_put(given: GeneratorInput, factual: Trajectory) -> GeneratorInput:
    """The input with its scene as it is when the motion begins.

    `given` has the scene in which nothing is put elsewhere yet, and the trajectory after that; `factual` is that of
    the scene as it is. What is given stays known as `before`.
    """
    put = put_elsewhere(given.trajectory, factual)
    if not put:
        return given
    before = replace(given, trajectory=from_the_image(given, factual, put))
    scene, image = given.scene, first_image(before)
    changed = scene.changed(np.asarray(np.where(scene.cues[..., None], scene.image, image), np.uint8), image)
    obstacles, grounding = list(given.obstacles), given.grounding
    for path in before.trajectory.paths:
        if path.body not in put:
            continue
        bbox, mask = given.trajectory.bodies[path.body].bbox, moved_mask(before, path)
        if path.body:
            obstacles[path.body - 1] = replace(obstacles[path.body - 1], bbox=bbox, mask=mask)
        else:
            changed = changed.with_mask(bbox, mask.full())
            grounding = grounding.model_copy(update={"bbox": bbox, "point": path.points[1]})
    return replace(given, scene=changed, obstacles=tuple(obstacles), grounding=grounding, before=before)


def first_image(before: GeneratorInput) -> Image:
    """The scene [H, W, 3] at the first frame of the clip, without its cues."""
    small = fit_within(before.scene.clean, MAX_SIDE)
    drawn = Compositor.of(replace(before, options=CutoutOptions())).frame(1)
    return at_full_size(before.scene.clean, small, drawn)


def moved_mask(before: GeneratorInput, path: Path) -> CroppedMask:
    """The mask of a body where it is at the first frame of the clip."""
    mask = before.obstacles[path.body - 1].mask if path.body else None
    mask = mask or CroppedMask.of(before.scene.silhouette(before.grounding.bbox))
    degrees = path.rotation[1] if path.rotation else 0.0
    return mask.moved(np.array(path.points[0]), np.array(path.points[1]), path.scale[1], degrees)


def from_the_image(given: GeneratorInput, factual: Trajectory, put: Sequence[int]) -> Trajectory:
    """The trajectory with one frame more, before the others, in which all is where the image shows it.

    What is put elsewhere has a path, whether it moves in the clip or not.
    """
    told = given.trajectory
    assert told.camera is not None  # every world has one
    camera = FloorCamera.of(told.camera, given.scene.width, given.scene.height)
    paths: list[Path] = []
    for path in told.paths:
        if path.body in put:
            seen, body = factual.bodies[path.body], told.bodies[path.body]
            start = given.grounding.point if path.body == 0 else _middle(seen)
            paths.append(_put(path, seen, start, body))
        else:
            paths.append(_with_frame_before(path, path.states[0], path.points[0]))
    moving = {path.body for path in told.paths}
    for index in put:
        if index not in moving:
            resting = _resting(index, told.bodies[index], factual.bodies[index], camera, told.num_frames)
            paths.append(_put(resting, factual.bodies[index], _middle(factual.bodies[index]), told.bodies[index]))
    bodies = tuple(factual.bodies[i] if i in put else body for i, body in enumerate(told.bodies))
    return told.model_copy(update={"bodies": bodies, "paths": tuple(paths)})


def _put(path: Path, seen: Body, start: Point, body: Body) -> Path:
    """A path that begins at the new place of a body, with a frame before it in which it is where it is seen."""
    x, y, z = seen.position
    scale = seen.position[2] / body.position[2]
    rotation = path.rotation or (0.0,) * len(path.points)
    begun = path.model_copy(
        update={
            "scale": tuple(scale * each for each in path.scale),
            "rotation": tuple(body.rotation + each for each in rotation),
        }
    )
    return _with_frame_before(begun, (x, y, z, 0.0, 0.0, 0.0), start)


def _with_frame_before(path: Path, state: tuple[float, float, float, float, float, float], start: Point) -> Path:
    """A path with a first frame in which its body is as the image shows it."""
    return path.model_copy(
        update={
            "states": (state, *path.states),
            "points": (start, *path.points),
            "visible": (True, *path.visible),
            "scale": (1.0, *path.scale),
            "rotation": (0.0, *path.rotation) if path.rotation else (),
            "band": (),
            "futures": (),
            "tracks": (),
            "tracks_visible": None,
        }
    )


def _resting(index: int, body: Body, seen: Body, camera: FloorCamera, num_frames: int) -> Path:
    """The path of a body that stays at its new place."""
    old, new = camera.project(np.array([seen.position, body.position]))
    offset = (np.array(_middle(seen)) - old) * seen.position[2] / body.position[2]
    x, y = (new + offset).tolist()
    return Path(
        body=index,
        states=((*body.position, 0.0, 0.0, 0.0),) * num_frames,
        points=((x, y),) * num_frames,
        visible=(True,) * num_frames,
        scale=(1.0,) * num_frames,
        tracks=(),
    )


def _middle(body: Body) -> Point:
    x0, y0, x1, y1 = body.bbox
    return (x0 + x1) / 2, (y0 + y1) / 2
