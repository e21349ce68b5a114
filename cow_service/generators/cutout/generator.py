"""The generator `cutout`: all bodies that move are drawn as sprites along their paths, in the order of their depths.

A frame is put together from far to near: the background, the shadows on it, then each sprite behind what is nearer.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cmp_to_key

import cv2
import numpy as np

from cow_service import __version__
from cow_service.generators.base import GeneratorInput
from cow_service.generators.cutout.bodies import MovingBody, Sprite, StillBody, Window
from cow_service.generators.cutout.layers import MAX_SIDE, CutoutOptions, Layers, take_apart
from cow_service.media.masks import scaled_size, three_channels
from cow_service.media.types import Floats32, Image, Mask
from cow_service.physics.ballistic import has_passed
from cow_service.records import GeneratorInfo
from cow_service.settings import Settings


class CutoutGenerator:
    """Milliseconds per frame, no weights. It moves and turns sprites: nothing breaks, and no other side is seen."""

    options_model = CutoutOptions
    concurrency = None
    fingerprint = f"cutout {__version__}"

    def describe(self, given: GeneratorInput) -> GeneratorInfo:
        """The same image, trajectory and version give the same frames; the seed changes nothing."""
        return GeneratorInfo(name="cutout", revision=__version__, seed=given.seed, options=given.options.model_dump())

    def nearest_lengths(self, num_frames: int, fps: float) -> tuple[int, ...]:
        """Any length."""
        return (num_frames,)

    def size(self, width: int, height: int) -> tuple[int, int]:
        """The image's own size, up to 1280 px on the longer side."""
        return scaled_size(width, height, min(1.0, MAX_SIDE / max(width, height)))

    def render(
        self, given: GeneratorInput, indices: Sequence[int], progress: Callable[[float], None]
    ) -> Iterator[Image]:
        """The frames of these indices, RGB [h, w, 3]; only the windows of what moves are composed."""
        source, earlier = (given, 0) if given.before is None else (given.before, 1)
        layers = take_apart(source, lambda done: progress(0.0))
        for done, index in enumerate(indices):
            progress(done / len(indices))
            yield compose(layers, index + earlier)


def create(settings: Settings) -> CutoutGenerator:
    """Factory for the registry."""
    return CutoutGenerator()


def compose(layers: Layers, index: int) -> Image:
    """The clip frame [h, w, 3] of an index."""
    if all(body.is_unmoved(index) for body in layers.moving):
        return layers.image.copy()
    frame = layers.background.copy()
    for shadow in layers.shadows:
        shade = shadow(index, (frame.shape[1], frame.shape[0]))
        if shade is None:
            continue
        # Where the surface is seen: the floor between still bodies, or the top of one.
        others = [other for other in layers.still if shade.surface in (None, other.index)]
        others = [other for other in others if _overlap(shade.window, other)]
        if not others and shade.surface is not None:
            continue
        seen = np.ones(shade.dark.shape[:2], np.float32)
        for other in others:
            _hide(seen, shade.window, other)
        share = three_channels(seen if shade.surface is None else 1 - seen) if others else 1.0
        window = frame[shade.window]
        window[:] = cv2.multiply(window, 1 - shade.dark * share, dtype=cv2.CV_8U)
    for window, pixels in _drawn(layers, index):
        shown = frame[window]
        mixed = cv2.multiply(shown, three_channels(1 - pixels[..., 3]), dtype=cv2.CV_32F) + pixels[..., :3]
        shown[:] = cv2.convertScaleAbs(mixed)
    return frame


def moving_mask(layers: Layers, index: int) -> Mask:
    """Where the bodies that move are seen in the clip frame of an index [h, w]: what hides them is left out."""
    mask = np.zeros(layers.image.shape[:2], bool)
    for window, pixels in _drawn(layers, index):
        mask[window] |= pixels[..., 3] > 0.5
    return mask


def _drawn(layers: Layers, index: int) -> Iterator[tuple[Window, Floats32]]:
    """What is drawn over the background, in that order: windows, and colours times alpha with alpha in them."""
    for body, sprite in _far_to_near(layers, index):
        pieces = [(body, sprite)]
        for container in layers.containers:
            if container.moving is not None and container.sprite is not None and container.covers(body, index):
                pieces.append((container.moving, container.sprite))
        for piece in pieces:
            if (found := _seen(layers, *piece, index)) is not None:
                yield found


def _far_to_near(layers: Layers, index: int) -> list[tuple[MovingBody, Sprite]]:
    """The bodies before the camera at a frame, in the order in which they are drawn."""
    there = [
        (body, sprite)
        for body, sprite in zip(layers.moving, layers.sprites, strict=True)
        if not has_passed(np.array([body.path.states[index][2]]), body.path.states[0][2])[0]
    ]

    def order(a: tuple[MovingBody, Sprite], b: tuple[MovingBody, Sprite]) -> int:
        for one, other, sign in ((a[0], b[0], 1), (b[0], a[0], -1)):
            if any(each.index == other.path.body and each.takes(one, index) for each in layers.containers):
                return sign  # the container first, then what is in it
        return 1 if a[0].extent(index).is_in_front_of(b[0].extent(index), layers.eye) else -1

    return sorted(there, key=cmp_to_key(order))


def _seen(layers: Layers, body: MovingBody, sprite: Sprite, index: int) -> tuple[Window, Floats32] | None:
    """A body at a frame, but for what still bodies hide of it; None if nothing is seen."""
    path, extent = body.path, body.extent(index)
    rotation = path.rotation[index] if path.rotation else 0.0
    point = layers.factor * np.array(path.points[index])
    found = sprite.at(point, path.scale[index], rotation, (layers.image.shape[1], layers.image.shape[0]))
    if found is None:
        return None
    hiding = [other for other in layers.still if not extent.is_in_front_of(other.extent, layers.eye)]
    for container in layers.containers:
        if container.takes(body, index):  # then its front wall alone hides the body
            hiding = [other for other in hiding if other.index != container.index]
            hiding += [container.front] if container.moving is None and container.covers(body, index) else []
    window, pixels = found
    for other in hiding:
        if _overlap(window, other):
            _hide(pixels, window, other)
    return window, pixels


def _overlap(window: Window, other: StillBody) -> bool:
    there = other.alpha[0]
    return all(a.start < b.stop and b.start < a.stop for a, b in zip(window, there, strict=True))


def _hide(pixels: Floats32, window: Window, other: StillBody) -> None:
    """Takes away the part of a window's values [a, b] or [a, b, 4] that another body covers."""
    there, alpha = other.alpha
    both = [slice(max(a.start, b.start), min(a.stop, b.stop)) for a, b in zip(window, there, strict=True)]
    inner = tuple(slice(s.start - w.start, s.stop - w.start) for s, w in zip(both, window, strict=True))
    covered = tuple(slice(s.start - w.start, s.stop - w.start) for s, w in zip(both, there, strict=True))
    left = 1 - alpha[covered]
    pixels[inner] *= left if pixels.ndim == 2 else left[..., None]
