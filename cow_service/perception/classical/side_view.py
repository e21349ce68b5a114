"""Recognizes a drawing seen from the side: flat shapes on a level ground, before a flat background.

In such a picture there is no depth: the ground is a line, and what is drawn above it is that far above it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media import masks
from cow_service.media.masks import CroppedMask
from cow_service.media.types import Image, Mask


class DrawingRules(NamedTuple):
    """When a picture is a drawing seen from the side.

    Set by hand on 20 drawings, of which 16 are answered right and 4 not surely. No single number has a measurement of
    its own.
    """

    same: int = 6  # levels: pixels that differ less from a colour have it
    apart: int = 24  # levels between two colours of a drawing, at least
    flat: float = 0.9  # share of the pixels of a drawing that have one of its colours: edges are blurred
    most_colours: int = 12  # of a drawing
    least_colour: float = 0.0005  # of the pixels
    ground: float = 0.45  # of the image's width, at least, is ground
    level: float = 0.006  # of the image's height: so even is the upper edge of a ground
    no_gap: float = 0.01  # of the image's width: what is open of its ground is no gap
    line: float = 0.15  # of the image's width: a shorter piece of a line is no ground
    thin: float = 0.007  # of the larger side: half the width of an outline, at most
    least_shape: float = 0.0003  # of the image
    highest_ground: float = 0.55  # of the image's height, from the top
    band: int = 1 << 18  # px


DRAWING = DrawingRules()


@dataclass(frozen=True)
class SideView:
    """What a drawing shows."""

    shapes: tuple[CroppedMask, ...]  # things, and pieces of ground between which there is a gap
    level: float  # px: height in the image of the floor; of a ground with a gap the image's lower border
    empty: Image  # [H, W, 3] without the things


def find_side_view(image: Image) -> SideView | None:
    """The side view that an RGB image [H, W, 3] is; None for a picture that has depth, or no level ground."""
    height = image.shape[0]
    if _labelled(np.ascontiguousarray(image[::4, ::4])) is None:  # most pictures end here
        return None
    found = _labelled(image)
    if found is None:
        return None
    labels, background, ground, level = found
    rest = (labels != background) & ~masks.dilated(ground, 5)  # its edge is blurred
    open_ground = (labels[level : level + 2] == background).all(axis=0) & ~ground.any(axis=0)
    whole = bool(open_ground.mean() < DRAWING.no_gap)
    shapes = _shapes(labels, rest)
    if not whole:
        count, pieces = cv2.connectedComponents(ground.astype(np.uint8))
        shapes += [CroppedMask.of(pieces == i) for i in range(1, count)]
    # What reaches below the ground's edge stands before it: the picture has depth after all.
    elif any(each.bbox[3] > level + 2 + DRAWING.level * height for each in shapes):
        return None
    empty = np.full_like(image, image[labels == background].mean(axis=0).round())
    empty[ground] = image[ground]
    return SideView(tuple(shapes), float(level if whole else height), empty)


def _labelled(image: Image) -> tuple[NDArray[np.uint8], int, Mask, int] | None:
    """Which of the few colours of a drawing each pixel has [H, W], the background's, the ground [H, W], and the height
    in the image of its upper edge; None for a photograph, or where there is no ground."""
    colours = _flat_colours(image)
    if colours is None:
        return None
    labels = np.empty(image.shape[:2], np.uint8)
    for rows in _bands(image):
        labels[rows] = np.stack([np.abs(image[rows] - colour).sum(axis=2) for colour in colours]).argmin(axis=0)
    background = int(np.bincount(labels[: max(2, image.shape[0] // 50)].ravel()).argmax())
    ground, level = _ground(labels, background)
    return None if ground is None else (labels, background, ground, level)


def _bands(image: Image) -> Iterator[slice]:
    """Rows that are looked at together: numbers for all pixels of a large image at once would fill the memory."""
    step = max(1, DRAWING.band // image.shape[1])
    yield from (slice(top, top + step) for top in range(0, image.shape[0], step))


def _flat_colours(image: Image) -> list[NDArray[np.int16]] | None:
    """The few colours [3] of a drawing; None for a photograph."""
    counts = np.zeros(1 << 18, np.int64)
    for rows in _bands(image):
        red, green, blue = np.moveaxis((image[rows] >> 2).astype(np.int32), 2, 0)
        counts += np.bincount((red << 12 | green << 6 | blue).ravel(), minlength=len(counts))
    size = image.shape[0] * image.shape[1]
    common = np.nonzero(counts >= DRAWING.least_colour * size)[0]
    found, has_one = list[NDArray[np.int16]](), np.zeros(image.shape[:2], np.uint8)
    for at in common[np.argsort(-counts[common], kind="stable")].tolist():
        colour = np.array([at >> 12, at >> 6 & 63, at & 63], np.int16) * 4 + 2
        if len(found) == DRAWING.most_colours:
            break
        if all(np.abs(colour - other).max() >= DRAWING.apart for other in found):
            found.append(colour)
            low, high = (tuple(np.clip(colour + step, 0, 255).tolist()) for step in (-DRAWING.same, DRAWING.same))
            has_one |= np.asarray(cv2.inRange(image, low, high), np.uint8)
    return found if len(found) > 1 and np.count_nonzero(has_one) > DRAWING.flat * size else None


def _ground(labels: NDArray[np.uint8], background: int) -> tuple[Mask | None, int]:
    """The ground [H, W] of one colour, and the height in the image of its upper edge; None if there is none."""
    height, width = labels.shape
    kernel = np.ones((1, round(DRAWING.line * width)), np.uint8)
    best, level = None, 0
    for colour in np.unique(labels[labels != background]):
        wide = cv2.morphologyEx((labels == colour).astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0
        count, parts, stats, _ = cv2.connectedComponentsWithStats(wide.astype(np.uint8))
        sides = [i for i in range(1, count) if stats[i][0] == 0 or stats[i][0] + stats[i][2] == width]
        sides = [i for i in sides if stats[i][1] > (1 - DRAWING.highest_ground) * height]
        if not sides:
            continue
        top = min(stats[i][1] for i in sides)
        level_ones = [i for i in range(1, count) if abs(stats[i][1] - top) <= 1 + DRAWING.level * height]
        ground = np.logical_or.reduce([parts == i for i in level_ones])
        if ground.any(axis=0).mean() > DRAWING.ground and (best is None or top < level):
            best, level = ground, int(top)
    return best, level


def _shapes(labels: NDArray[np.uint8], rest: Mask) -> list[CroppedMask]:
    """The things among what is neither background nor ground [H, W]: of one colour each, with their outlines."""
    thin = max(3.0, DRAWING.thin * max(rest.shape))
    bodies, lines = list[CroppedMask](), list[CroppedMask]()
    for colour in np.unique(labels[rest]):
        count, parts, stats, _ = cv2.connectedComponentsWithStats((rest & (labels == colour)).view(np.uint8))
        for i in range(1, count):
            left, top, width, height, area = stats[i].tolist()
            if area < 8:
                continue
            window = slice(top, top + height), slice(left, left + width)
            part = CroppedMask(rest.shape, *window, parts[window] == i)
            (lines if masks.half_width(part.patch) <= thin else bodies).append(part)
    for line in lines:  # an outline belongs to the shape that it runs along
        near = masks.dilated(line.full(), 5)
        shared = [body.shared_with(near) for body in bodies]
        if shared and max(shared) > 0:
            at = int(np.argmax(shared))
            whole = bodies[at].full()
            line.add_to(whole)
            bodies[at] = CroppedMask.of(whole)
    large = [body for body in bodies if body.area / rest.size > DRAWING.least_shape]
    whole = [replace(body, patch=masks.without_holes(body.patch)) for body in large]
    # Small holes are patterns on a shape: nothing has room in them.
    return [filled if body.area > 0.8 * filled.area else body for body, filled in zip(large, whole, strict=True)]
