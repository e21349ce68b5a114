"""Finds strokes drawn over an image: patches of one flat colour with sharp edges and a narrow part.

A closed rim counts twice: as it is, and together with what it encloses. `arrows.py` classifies strokes by their shape.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media.masks import eroded, scaled, without_holes
from cow_service.media.types import Image, Mask


class StrokeRules(NamedTuple):
    """What is drawn over a picture, and no part of the scene.

    Set by hand on the arrows and boxes of 18 rendered scenes of the first family, as JPEG. No single number has a
    measurement of its own.
    """

    working_side: int = 896  # px: longer images are searched at this size
    thin: int = 41  # px: side of the median window; narrower structures stand out from it
    stands_out: int = 28  # grey levels from that median, in any channel
    # grey levels around a flat colour: strict first, then with the fringes that JPEG leaves
    tolerances: tuple[int, int] = (26, 52)
    flat: int = 14  # grey levels: median distance of a drawing's pixels from its colour
    sharp: int = 56  # grey levels between a drawing and its surroundings
    sharp_share: float = 0.85  # of its surroundings
    gap_share: float = 0.25  # of the surroundings that have the colour of a patch which is a part of them
    fringe: int = 4  # px around a drawing that compression has mixed with it
    outline: int = 5  # px: maximum width of an outline
    length: float = 18.0  # px at the working size
    alike: float = 0.04  # of the area: patches that differ less are the same, found with another tolerance
    inside: float = 0.12  # of a hollow drawing's area that its rim encloses
    bin: int = 16  # grey levels: colours this close are tried as one
    colours: int = 36  # flat colours tried per thin structure


STROKE = StrokeRules()


Box = tuple[int, int, int, int]  # x, y, width, height, px
Colour = tuple[int, int, int]  # RGB

_SQUARE = np.ones((3, 3), np.uint8)
_CROSS = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))


@dataclass(frozen=True)
class Stroke:
    """A connected patch of one flat colour, at the working size: an arrow, a box, a letter, or something else."""

    x: int
    y: int
    patch: Mask  # [h, w], its top left corner at (x, y)
    colour: Colour  # RGB; of a rim where the stroke has one
    hollow: bool = False  # a rim and the one flat colour that it encloses, both in the patch

    def surroundings(self, image: Image, pad: int) -> tuple[tuple[slice, slice], NDArray[np.uint8]]:
        """Rows and columns of the image up to `pad` px around it, and its patch there: 1 where it is, else 0."""
        (h, w), top, left = self.patch.shape, max(0, self.y - pad), max(0, self.x - pad)
        window = slice(top, self.y + h + pad), slice(left, self.x + w + pad)
        patch = np.zeros(image[window].shape[:2], np.uint8)
        patch[self.y - top : self.y - top + h, self.x - left : self.x - left + w] = self.patch
        return window, patch


@dataclass(frozen=True)
class WorkingImage:
    """An RGB image [h, w, 3] at the working size, and the factor that brought it there."""

    pixels: Image
    scale: float
    size: tuple[int, int]  # of the image itself: height and width

    @staticmethod
    def of(image: Image) -> WorkingImage:
        """The image, scaled down where it is longer than the working size."""
        scale = min(1.0, STROKE.working_side / max(image.shape[:2]))
        return WorkingImage(scaled(image, scale), scale, (image.shape[0], image.shape[1]))

    def full(self, mask: Mask) -> Mask:
        """A mask of working size at the size of the image itself."""
        if mask.shape == self.size:
            return mask
        return cv2.resize(mask.astype(np.uint8), self.size[::-1], interpolation=cv2.INTER_NEAREST).astype(bool)


def find_strokes(image: Image) -> Iterator[Stroke]:
    """Candidates in an RGB image [h, w, 3] of working size. A drawing can be found twice, with slight differences."""
    # Where something narrow stands out from what is around it, and a little beyond.
    half = scaled(image, 0.5)
    # A median over so wide a window is as good of every second pixel, and takes a fifth of the time.
    around = cv2.resize(cv2.medianBlur(scaled(half, 0.5), STROKE.thin // 4 | 1), half.shape[1::-1])
    red, green, blue = cv2.split(cv2.absdiff(half, around))
    _, narrow = cv2.threshold(cv2.max(cv2.max(red, green), blue), STROKE.stands_out, 255, cv2.THRESH_BINARY)
    narrow = cv2.resize(cv2.dilate(narrow, _SQUARE), image.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    for (bx, by, bw, bh), _, _, thin in _patches(np.asarray(narrow, np.uint8), most=1.0):
        window = image[by : by + bh, bx : bx + bw]
        allowed = thin.astype(np.uint8) * np.uint8(255)
        known: dict[Box, int] = {}
        for colour, tolerance in itertools.product(_flat_colours(window[thin]), STROKE.tolerances):
            same = np.asarray(cv2.bitwise_and(_alike(window, colour, tolerance), allowed), np.uint8)
            for box, area, flat, patch in _patches(same, most=0.30, flat=partial(_alike, window, colour, STROKE.flat)):
                before = known.get(box)
                if before is not None and abs(area - before) <= STROKE.alike * before:
                    continue
                known[box] = area
                stroke = Stroke(bx + box[0], by + box[1], patch, colour)
                if 2 * flat >= area and _is_drawn(image, stroke):
                    yield stroke
                    yield from _hollow(image, stroke)


def _alike(image: Image, colour: Colour, tolerance: int) -> NDArray[np.uint8]:
    """255 where an image [h, w, 3] has a colour, within so many grey levels."""
    low, high = tuple(max(0, v - tolerance) for v in colour), tuple(min(255, v + tolerance) for v in colour)
    return np.asarray(cv2.inRange(image, low, high), np.uint8)


def drawing_mask(image: Image, stroke: Stroke) -> Mask:
    """Mask [h, w] of the stroke with the outline around it, if it has one, and the fringe that compression leaves."""
    window, patch = stroke.surroundings(image, STROKE.fringe + 2 * STROKE.outline)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    reach, grown = STROKE.fringe, cv2.dilate(patch, kernel)
    for width in range(1, STROKE.outline + 1):
        wider = cv2.dilate(grown, kernel)
        ring = image[window][(wider > 0) & (grown == 0)].astype(np.float32)
        if len(ring):
            colour = np.median(ring, axis=0)
            is_ink = colour.min() > 225 or colour.max() < 30  # outlines are white or black
            if is_ink and np.median(np.abs(ring - colour).max(axis=1)) < STROKE.flat:
                reach = width + STROKE.fringe + 1
        grown = wider
    mask = np.zeros(image.shape[:2], bool)
    mask[window] = cv2.dilate(patch, kernel, iterations=reach) > 0
    return mask


def _is_drawn(image: Image, stroke: Stroke) -> bool:
    """Whether a patch of one colour has a sharp edge all around, unlike shading."""
    window, inside = stroke.surroundings(image, 4)
    near = cv2.dilate(inside, _SQUARE, iterations=2)
    beyond = image[window][cv2.dilate(near, _SQUARE) > near].astype(np.int16)
    sharp = (np.abs(beyond - np.array(stroke.colour, np.int16)) > STROKE.sharp).any(axis=1)
    if np.count_nonzero(sharp) <= STROKE.sharp_share * len(beyond):
        return False
    # What has the colour of its surroundings is floor that is seen between two objects.
    around = image[stroke.surroundings(image, max(stroke.patch.shape))[0]]
    alike = np.count_nonzero(_alike(around, stroke.colour, STROKE.flat)) - np.count_nonzero(stroke.patch)
    return alike <= STROKE.gap_share * around.shape[0] * around.shape[1]


def _hollow(image: Image, stroke: Stroke) -> Iterator[Stroke]:
    """The hollow drawings whose rim, and whose inside, a stroke may be."""
    whole = without_holes(stroke.patch)
    if np.count_nonzero(whole & ~stroke.patch) > STROKE.inside * np.count_nonzero(whole):
        inside = eroded(whole & ~stroke.patch, beyond=0)
        pixels = image[stroke.surroundings(image, 0)[0]][inside].astype(np.int16)
        if len(pixels) and np.median(np.abs(pixels - np.median(pixels, axis=0)).max(axis=1)) <= STROKE.tolerances[1]:
            yield Stroke(stroke.x, stroke.y, whole, stroke.colour, hollow=True)
        return
    if eroded(stroke.patch, beyond=0).sum() <= STROKE.inside * stroke.patch.sum():
        return
    # The rim around a flat patch differs in colour from the patch and from its surroundings. Compression may have
    # broken it: then it is not found as a separate stroke.
    pad = STROKE.outline + STROKE.fringe + 1
    window, patch = stroke.surroundings(image, pad)
    near = image[window].astype(np.int16)
    grown = [patch, *(cv2.dilate(patch, _CROSS, iterations=i) for i in (1, 3, STROKE.outline + 1, pad - 2, pad))]
    rim, beyond = (
        np.median(near[(grown[outer] > 0) & (grown[inner] == 0)], axis=0) for inner, outer in ((1, 2), (4, 5))
    )
    if min(np.abs(rim - beyond).max(), np.abs(rim - np.array(stroke.colour)).max()) > STROKE.sharp:
        is_rim = (grown[3] > 0) & (2 * np.abs(near - rim).sum(axis=2) < np.abs(near - beyond).sum(axis=2))
        count, labels = cv2.connectedComponents(((patch > 0) | is_rim).astype(np.uint8), connectivity=4)
        kept = labels == np.bincount(labels[patch > 0], minlength=count).argmax()
        colour = int(rim[0]), int(rim[1]), int(rim[2])
        yield Stroke(window[1].start, window[0].start, without_holes(kept), colour, hollow=True)


def _flat_colours(pixels: NDArray[np.uint8]) -> list[Colour]:
    """Colours that many of the pixels [N, 3] share: a drawing has one, a shaded object spreads over many."""
    if len(pixels) < 40:
        return []
    binned = np.ascontiguousarray((pixels // STROKE.bin + 1).T).astype(np.int16)  # [3, N]; a margin of one bin
    side = 256 // STROKE.bin + 2
    flat = np.ravel_multi_index((binned[0], binned[1], binned[2]), (side, side, side))
    smooth = np.bincount(flat, minlength=side**3).reshape(side, side, side).astype(np.float32)
    for axis in range(3):
        smooth = smooth + 0.5 * (np.roll(smooth, 1, axis) + np.roll(smooth, -1, axis))
    colours: list[Colour] = []
    for _ in range(STROKE.colours):
        peak = np.unravel_index(int(smooth.argmax()), smooth.shape)
        if smooth[peak] < 30:
            break
        close = [np.abs(channel - np.int16(middle)) <= 1 for channel, middle in zip(binned, peak, strict=True)]
        near = pixels[close[0] & close[1] & close[2]]
        colour = np.median(near, axis=0).astype(np.int64)
        if (np.abs(near - colour).max(axis=1) <= STROKE.flat).sum() >= 24:
            colours.append((int(colour[0]), int(colour[1]), int(colour[2])))
        r, g, b = (slice(max(0, int(p) - 1), int(p) + 2) for p in peak)
        smooth[r, g, b] = 0
    return colours


def _patches(
    same: NDArray[np.uint8], most: float, flat: Callable[[], NDArray[np.uint8]] | None = None
) -> Iterator[tuple[Box, int, int, Mask]]:
    """Connected patches that are long enough for an arrow; `most` bounds area / diagonal^2.

    Of each its box, its area, how many of its pixels have its colour itself, and its mask [h, w] in the box. `flat`
    tells where [h, w] pixels have that colour.
    """
    left, top, width, height = cv2.boundingRect(same)
    if not width:
        return
    window = slice(top, top + height), slice(left, left + width)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(same[window], connectivity=8)
    squared = stats[:, 2].astype(np.int64) ** 2 + stats[:, 3].astype(np.int64) ** 2
    fitting = (stats[:, 4] >= 40) & (squared >= STROKE.length**2) & (stats[:, 4] <= most * squared)
    fitting[0] = False  # the background
    flats = np.zeros(len(stats), np.int64)
    if flat is not None and fitting.any():
        flats = np.bincount(labels[flat()[window] > 0], minlength=len(stats))
    for i in np.nonzero(fitting)[0].tolist():
        x, y, w, h, area = stats[i].tolist()
        yield (left + x, top + y, w, h), area, int(flats[i]), labels[y : y + h, x : x + w] == i
