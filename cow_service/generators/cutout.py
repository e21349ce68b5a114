"""The CPU compositor: the mover is cut out and drawn along its trajectory over the inpainted background."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from cow_service import __version__
from cow_service.generators.base import GeneratorInput
from cow_service.media.images import fit_within
from cow_service.physics.camera import has_passed
from cow_service.physics.encounters import box_at, boxes_overlap, stands_nearer
from cow_service.records import FALLING_KINDS, BBox, GeneratorInfo
from cow_service.settings import Settings
from cow_service.vision.inpainting import fill_hole, push_pull
from cow_service.vision.masks import resized_mask, scaled_size, window_of
from cow_service.vision.obstacles import Obstacle
from cow_service.vision.types import Floats, Floats32, Image, Mask

MAX_SIDE = 1280  # px: longer images give a clip of this size
EDGE_SIGMA = 0.8  # px: Gaussian that softens the sprite's edge
HOLE_GROWTH = 0.03  # of the object's size: the rim, mixed with the background, is inpainted too


class CutoutOptions(BaseModel):
    """What `generator_options` may hold for the cutout generator."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    clean_cues: bool = Field(default=True, description="Take drawn arrows and boxes out of the frames.")


@dataclass(frozen=True)
class _Layers:
    """What is composed, at the clip's size."""

    background: Image  # [h, w, 3] with the mover taken out
    sprite: Floats32  # [a, b, 4] the mover, colours times alpha, then alpha 0..1
    origin: tuple[float, float]  # x, y of the sprite's top left corner at the first frame, px
    occluders: tuple[tuple[BBox, Floats32], ...]  # boxes (px of the image) and alphas [h, w] of other objects
    factor: float  # clip px per image px


class CutoutGenerator:
    """Milliseconds per frame, no weights. It moves a sprite: nothing turns, breaks or changes its lighting."""

    options_model = CutoutOptions
    concurrency = None
    fingerprint = f"cutout {__version__}"

    def describe(self, given: GeneratorInput) -> GeneratorInfo:
        """The same image, trajectory and version give the same frames; the seed changes nothing."""
        return GeneratorInfo(name="cutout", revision=__version__, seed=given.seed, options=given.options.model_dump())

    def nearest_lengths(self, num_frames: int) -> tuple[int, ...]:
        """Any length."""
        return (num_frames,)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """The image's own size, up to 1280 px on the longer side."""
        return scaled_size(width, height, min(1.0, MAX_SIDE / max(width, height)))

    def render(
        self, given: GeneratorInput, indices: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[Image]:
        """The frames of these indices, RGB [h, w, 3]; only the window of the mover is composed."""
        layers = _layers(given)
        start = np.array(given.grounding.point)
        airborne = given.motion.kind in FALLING_KINDS
        depths = np.array([state[2] for state in given.trajectory.states])
        gone = has_passed(depths, depths[0])
        for done, index in enumerate(indices):
            progress(done / len(indices))
            if gone[index]:  # behind the camera
                yield layers.background.copy()
                continue
            point, scale = np.array(given.trajectory.points[index]), given.trajectory.scale[index]
            box = box_at(given.grounding.bbox, start, point, scale)
            in_front = [alpha for other, alpha in layers.occluders if not stands_nearer(box, other, airborne=airborne)]
            yield _compose(layers, start, point, scale, in_front)


def create(settings: Settings) -> CutoutGenerator:
    """Factory for the registry."""
    return CutoutGenerator()


def _layers(given: GeneratorInput) -> _Layers:
    scene = given.scene
    clean = cast(CutoutOptions, given.options).clean_cues  # the generator's own `options_model`
    image = fit_within(scene.clean if clean else scene.image, MAX_SIDE)
    size = image.shape[1], image.shape[0]
    factor = image.shape[1] / scene.width
    mover = resized_mask(scene.silhouette(given.grounding.bbox), size)
    others = np.zeros(mover.shape, bool)
    for obstacle in given.obstacles:
        others |= obstacle.mask.at(size)
    growth = 2 * max(2, round(HOLE_GROWTH * float(np.sqrt(mover.sum())))) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (growth, growth))
    hole = cv2.dilate(mover.astype(np.uint8), kernel) > 0
    if clean:  # where a cue next to the mover was inpainted, the mover's colour has spread
        hole |= resized_mask(scene.cues, size) & (cv2.dilate(hole.astype(np.uint8), kernel, iterations=3) > 0)
    hole &= ~(others & ~mover)
    sprite, origin = _sprite(image, mover)
    occluders = tuple((obstacle.bbox, _soft(obstacle.mask.at(size) & ~mover)) for obstacle in _near(given))
    return _Layers(fill_hole(image, hole, others & ~mover), sprite, origin, occluders, factor)


def _near(given: GeneratorInput) -> list[Obstacle]:
    """The objects whose box the mover's box crosses at some frame: no other can hide it."""
    start, bbox = np.array(given.grounding.point), given.grounding.bbox
    boxes = [
        box_at(bbox, start, np.array(point), scale)
        for point, scale in zip(given.trajectory.points, given.trajectory.scale, strict=True)
    ]
    return [other for other in given.obstacles if any(boxes_overlap(box, other.bbox) for box in boxes)]


def _sprite(image: Image, mover: Mask) -> tuple[Floats32, tuple[float, float]]:
    """The mover with a soft edge, and where its corner lies. Colours at the edge are the mover's own, not mixed."""
    inside = window_of(mover, 4) or (slice(0, 1), slice(0, 1))
    mask, colours = mover[inside], image[inside].astype(np.float32)
    alpha = _soft(mask)
    core = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1) > 0
    own = push_pull(colours, core) if core.any() else colours
    blended = np.where((core | ~mask)[..., None], np.where(core[..., None], colours, own), 0.5 * colours + 0.5 * own)
    sprite = np.dstack([blended * alpha[..., None], alpha]).astype(np.float32)
    return sprite, (float(inside[1].start), float(inside[0].start))


def _compose(layers: _Layers, start: Floats, point: Floats, scale: float, in_front: list[Floats32]) -> Image:
    """One frame: the sprite's corner moves with the object, to a fraction of a pixel."""
    height, width = layers.background.shape[:2]
    corner = layers.factor * point + scale * (np.array(layers.origin) - layers.factor * start)
    reach = np.array(layers.sprite.shape[1::-1]) * scale
    x0, y0 = (int(v) for v in np.floor(np.maximum(corner - 1, 0)))
    x1, y1 = (int(v) for v in np.ceil(np.minimum(corner + reach + 1, [width, height])))
    frame = layers.background.copy()
    if x1 <= x0 or y1 <= y0:
        return frame
    shift = corner - [x0, y0] + 0.5 * scale - 0.5  # pixel centres, not corners, are what warpAffine maps
    transform = np.array([[scale, 0, shift[0]], [0, scale, shift[1]]], np.float64)
    moved = cv2.warpAffine(layers.sprite, transform, (x1 - x0, y1 - y0), flags=cv2.INTER_LINEAR)
    for alpha in in_front:
        moved *= 1 - alpha[y0:y1, x0:x1, None]
    window = frame[y0:y1, x0:x1]
    mixed = window * (1 - moved[..., 3:]) + moved[..., :3]
    frame[y0:y1, x0:x1] = np.clip(mixed + 0.5, 0, 255).astype(np.uint8)
    return frame


def _soft(mask: Mask) -> Floats32:
    """Alpha 0..1 of a mask: half at its outline."""
    return np.asarray(cv2.GaussianBlur(mask.astype(np.float32), (0, 0), EDGE_SIGMA), np.float32)
