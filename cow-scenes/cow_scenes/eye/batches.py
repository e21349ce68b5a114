"""Batches to learn from: cuttings of drawn pictures at many scales, with the targets of the network's two maps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from .network import OFFSET_UNIT
from .pictures import DRAWN, SHADOW, Picture, Shard
from .room import FIRST_FLAT, FIRST_SUPPORT, FIRST_THING, FIRST_WALL, IGNORED
from .surfaces import retextured

OTHER, SUPPORT, FLAT, THING = range(4)
FARTHEST = 15.0
"""Metres beyond which a depth is not learned."""
SHAPES = ((16, 192, 320), (16, 192, 320), (4, 384, 640))
"""Pictures of a batch, and their height and width: mostly cuttings, and whole pictures that cost the same."""


@dataclass(frozen=True)
class Batch:
    """Inputs `images` (n, h, w, 3) uint8, and targets.

    At half size: `classes` (n, h/2, w/2) int64, -1 to be ignored; `drawn`, `rim` and `near` (beside a thing) bool. At a
    quarter: `centres` (0 to 1), `offsets` (n, 2, h/4, w/4) with their weights `belongs`, `log_depth` and `has_depth`,
    `normals` (n, 3, h/4, w/4), zero where none is known.
    """

    images: np.ndarray
    classes: np.ndarray
    drawn: np.ndarray
    rim: np.ndarray
    near: np.ndarray
    centres: np.ndarray
    offsets: np.ndarray
    belongs: np.ndarray
    log_depth: np.ndarray
    has_depth: np.ndarray
    normals: np.ndarray


def resized(values: np.ndarray, height: int, width: int) -> np.ndarray:
    """Numbers at another size, none of them mixed."""
    return cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)


def corner(ids: np.ndarray, height: int, width: int, random: np.random.Generator) -> tuple[int, int]:
    """Where a window begins (multiples of 4): in four of five cases so that some thing is in it, large or small."""
    y, x = (
        int(random.integers((full - part) // 4 + 1)) * 4 for full, part in zip(ids.shape, (height, width), strict=True)
    )
    coarse = ids[::4, ::4]
    things = np.unique(coarse)
    things = things[(things >= FIRST_THING) & (things < FIRST_FLAT)]
    if not len(things) or random.random() < 0.2:
        return y, x
    points = np.argwhere(coarse == random.choice(things))
    at = points[random.integers(len(points))] - random.uniform(0.1, 0.9, 2) * (height // 4, width // 4)
    most = (np.array(ids.shape) - (height, width)) // 4
    top, left = np.clip(np.round(at), 0, most).astype(int)
    return int(top) * 4, int(left) * 4


def cutting(picture: Picture, height: int, width: int, random: np.random.Generator) -> Picture:
    """A part of a picture at `height` x `width`: 0.6 to 2 of its pixels become one; a little stretched, or mirrored."""
    full_height, full_width = picture.ids.shape
    scale, stretch = np.exp(random.uniform(np.log(0.6), np.log(2))), np.exp(random.normal(0, 0.08))
    w = int(min(full_width, width * scale * stretch)) // 4 * 4
    h = int(min(full_height, height * scale / stretch)) // 4 * 4
    y, x = corner(picture.ids, h, w, random)
    window = np.s_[y : y + h, x : x + w]
    how = cv2.INTER_AREA if w > width else cv2.INTER_CUBIC if random.random() < 0.3 else cv2.INTER_LINEAR
    image = cv2.resize(picture.image[window], (width, height), interpolation=how)
    ids, marks = (resized(v[window], height // 2, width // 2) for v in (picture.ids, picture.marks))
    depth = cv2.resize(
        picture.depth[y // 4 : (y + h) // 4, x // 4 : (x + w) // 4].astype(np.float32), (width // 4, height // 4)
    )
    normals = picture.normals
    if random.random() < 0.5:
        image, ids, marks, depth = (v[:, ::-1] for v in (image, ids, marks, depth))
        normals = normals * np.array([-1, 1, 1], normals.dtype)
    return Picture(image, np.ascontiguousarray(ids), marks, depth, normals, picture.focal * width / w)


def shaded(image: np.ndarray, ids: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """An image in which things darken what is around and below them, as they do in diffuse light; `ids` at half size.

    MuJoCo has no such light, and few photographs are without it.
    """
    is_thing = ((ids >= FIRST_THING) & (ids < FIRST_FLAT)).astype(np.float32)
    near = cv2.GaussianBlur(is_thing, (0, 0), random.uniform(1.5, 8))
    lowered = np.array([[1, 0, 0], [0, 1, random.uniform(0, 4)]], np.float32)
    near = cv2.warpAffine(near, lowered, near.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    dark = 1 - random.uniform(0.2, 0.7) * near * (1 - is_thing * random.uniform(0.5, 1))
    large = cv2.resize(dark, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return (image * large[..., None]).astype(np.uint8)


def degraded(image: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """An image as it may have been saved: softer, or as a JPEG of low quality."""
    if random.random() < 0.3:
        image = cv2.GaussianBlur(image, (0, 0), random.uniform(0.3, 1.3))
    if random.random() < 0.3:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(random.integers(30, 95))]
        image = np.asarray(cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_COLOR))
    return image


def classes_of(ids: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Classes (h, w) int64; a support in shadow is flat there, as what a rug is."""
    table = np.zeros(256, np.int64)
    table[FIRST_THING:FIRST_FLAT], table[FIRST_FLAT:FIRST_SUPPORT] = THING, FLAT
    table[FIRST_SUPPORT:FIRST_WALL], table[IGNORED] = SUPPORT, -1
    classes = table[ids]
    classes[(marks & SHADOW > 0) & (classes == SUPPORT)] = FLAT
    return classes


def rims(ids: np.ndarray, is_thing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where (h, w) a thing ends or begins, inside it and on both sides."""
    edge = np.zeros(ids.shape, bool)
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        differs = ids[a] != ids[b]
        edge[a] |= differs
        edge[b] |= differs
    return edge & is_thing, edge & (cv2.dilate(is_thing.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def centres_of(ids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bumps (h, w) at the centres of things and flat things, offsets (2, h, w) to them, and the offsets' weights."""
    height, width = ids.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    unit = OFFSET_UNIT / 4
    bumps, offsets, weights = (
        np.zeros((height, width), np.float32),
        np.zeros((2, height, width), np.float32),
        np.zeros((height, width), np.float32),
    )
    count = np.bincount(ids.ravel(), minlength=256)
    for number in np.flatnonzero(count[FIRST_THING:FIRST_SUPPORT] >= 3) + FIRST_THING:
        mask = ids == number
        size = count[number]
        cy, cx = y[mask].mean(), x[mask].mean()
        spread = np.clip(0.12 * size**0.5, 0.75, 2)
        reach = int(3 * spread) + 1
        part = np.s_[max(0, int(cy) - reach) : int(cy) + reach + 1, max(0, int(cx) - reach) : int(cx) + reach + 1]
        bump = np.exp(-((y[part] - cy) ** 2 + (x[part] - cx) ** 2) / 2 / spread**2)
        bumps[part] = np.maximum(bumps[part], bump)
        offsets[0][mask], offsets[1][mask] = (cy - y[mask]) / unit, (cx - x[mask]) / unit
        weights[mask] = (1.0 if number < FIRST_FLAT else 0.3) / size**0.5
    return bumps, offsets, weights


def batch_of(pictures: Sequence[Picture]) -> Batch:
    """A batch of cuttings of one size."""
    rows = []
    for picture in pictures:
        height, width = picture.ids.shape
        small = resized(picture.ids, height // 2, width // 2)
        classes = classes_of(picture.ids, picture.marks)
        depth = np.maximum(picture.depth.astype(np.float32), 0.05)
        rows.append(
            (
                picture.image, classes, picture.marks & DRAWN > 0,
                *rims(picture.ids, classes == THING), *centres_of(small),
                -np.log(depth), depth < FARTHEST, picture.normals.astype(np.float32)[small].transpose(2, 0, 1),
            )
        )  # fmt: skip
    return Batch(*(np.stack(column) for column in zip(*rows, strict=True)))


class Album:
    """The shards of a folder, which may grow while it is read."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shards: dict[str, Shard] = {}

    def refresh(self) -> int:
        """Read new shards; the number of pictures there are."""
        for path in sorted(self.folder.glob("seed*.npz")):
            if path.name not in self.shards:
                self.shards[path.name] = Shard(path)
        return sum(len(shard) for shard in self.shards.values())

    def picture(self, random: np.random.Generator) -> Picture:
        """Any picture."""
        shard = self.shards[sorted(self.shards)[random.integers(len(self.shards))]]
        return shard[int(random.integers(len(shard)))]

    def batch(self, random: np.random.Generator, shape: tuple[int, int, int]) -> Batch:
        """A batch of (count, height, width); every picture that is decoded gives two cuttings."""
        count, height, width = shape
        made: list[Picture] = []
        while len(made) < count:
            picture = self.picture(random)
            if random.random() < 0.4:
                picture = retextured(picture, random)
            for _ in range(min(2 if height < picture.ids.shape[0] else 1, count - len(made))):
                cut = cutting(picture, height, width, random)
                image = shaded(cut.image, cut.ids, random) if random.random() < 0.35 else cut.image
                made.append(replace(cut, image=degraded(image, random)))
        return batch_of(made)
