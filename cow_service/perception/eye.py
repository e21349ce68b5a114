"""The eye of the default installation: a small network, by OpenCV, which finds what stands in any picture.

`models/things.onnx` is trained on drawn pictures; the card beside it, `things.json`, says how, what it was measured on
and what it cannot see. Classical regions have sharper outlines where they are found: both are put together.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from threading import Lock
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from cow_service.errors import PerceptionUnavailable
from cow_service.media.masks import CroppedMask, dilated
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.perception.base import Thing
from cow_service.perception.classical.regions import find_regions, thing_of
from cow_service.records import Record
from cow_service.settings import Settings
from cow_service.weights.manifests import CARDS, NETWORKS

NAME = "things"
AREA, STEP = 640 * 384, 32  # px that the network sees; the sides of its input are multiples of the step
STANDING, DRAWN, RIM = 3, 4, 5  # channels of its fine map; before them anything else, supports, what lies flat
OFFSET_UNIT = 16.0  # px of the fine map in one unit of an offset
DAMAGED = "The network `things` is missing, or not the one that its card tells of: install the package again."
TOUCH = 4  # px of the fine map along which two things touch, at least
MOST = 250  # things of a class: labels are bytes


class MatchRules(NamedTuple):
    """How regions and what the network sees go together.

    Measured on 100 scenes of three families: `seen` takes away 59 of 103 regions that are no thing, and none of 303
    that are one. The others were tried in two or three values each, between which little changes.
    """

    seen: float = 0.1  # mean probability of standing in a region: with less it is a texture, a patch of light, a rug
    sure: float = 0.6  # probability from which what the network sees counts
    part: float = 0.7  # of a region's area inside of what is seen: it may be a part of that, such as a label
    larger: float = 1.5  # times the region's area: what is seen is the whole
    shared: float = 0.3  # of either area: with more in common they are one thing, of which the region is taken


MATCH = MatchRules()


class Limits(Record):
    """What counts as found, in the network's own units; part of its card."""

    centre: float  # the least height of a centre
    member: float  # the least probability of a thing's pixel
    smallest: int  # px of the fine map: the least area
    reach: float  # px of the fine map: so far from its centre a pixel may point
    rim: float  # mean height of a rim between two things that touch, at least
    probability: float  # with which a thing is reported, at least


class Calibration(Record):
    """A logistic regression from what the maps say of a thing to the probability that it is there; part of the card."""

    constant: float
    member: float  # weight of the logit of the mean probability of its pixels
    centre: float  # weight of the logit of the height of its centre
    size: float  # weight of the logarithm of its area
    drawn: float  # weight of the mean probability that its pixels are drawn over the picture

    def probability(self, part: Mask, member: Floats32, heat: Floats32, drawn: Floats32) -> float:
        """Of a thing by its mask [h, w] in the fine map, and by what that says of its pixels."""
        values = np.clip([member[part].mean(), heat[part].max()], 0.005, 0.995)
        told = [*np.log(values / (1 - values)), np.log(np.count_nonzero(part) / 400), drawn[part].mean()]
        logit = self.constant + np.dot([self.member, self.centre, self.size, self.drawn], told)
        return float(_sigmoid(np.float64(logit)))


class Card(BaseModel):
    """What the product reads of the card; the rest is for people."""

    model_config = ConfigDict(frozen=True)

    sha256: str  # of the network
    limits: Limits
    calibration: dict[str, Calibration]  # of `standing` things, and of flat ones


@dataclass(frozen=True)
class Instance:
    """Something found."""

    mask: CroppedMask
    probability: float  # that it is there


@dataclass(frozen=True)
class Seen:
    """What the network sees in a picture."""

    instances: tuple[Instance, ...]  # the surest first
    standing: Floats32  # [H, W] probability that something stands there


class Eye:
    """Finds things. Safe to use from several threads, of which one looks at a time."""

    def __init__(self) -> None:
        """Raises `PerceptionUnavailable` where the network is missing, or not the one that its card tells of."""
        try:
            self._data, card = NETWORKS.file(NAME).read_bytes(), Card.model_validate_json(CARDS.read(NAME))
        except (LookupError, ValueError, OSError) as error:
            raise PerceptionUnavailable(DAMAGED) from error
        digest = hashlib.sha256(self._data).hexdigest()
        if digest != card.sha256:
            raise PerceptionUnavailable(DAMAGED)
        decided = json.dumps([digest, card.model_dump(mode="json"), MATCH, cv2.__version__])
        self.fingerprint = f"eye {hashlib.sha256(decided.encode()).hexdigest()[:16]}"
        self.limits, self.calibration = card.limits, card.calibration["standing"]
        self._lock = Lock()

    @cached_property
    def _network(self) -> cv2.dnn.Net:
        """Read when it first looks: a process that ends while OpenCV works in another thread crashes."""
        try:
            return cv2.dnn.readNetFromONNX(np.frombuffer(self._data, np.uint8))
        except cv2.error as error:
            raise PerceptionUnavailable(DAMAGED) from error

    def find(self, image: Image, names: Sequence[str] = ()) -> tuple[Thing, ...]:
        """What stands in an RGB image [H, W, 3] without drawings on it, whatever its names.

        Regions, whose outlines are sharper, where the network sees something standing and nothing of which they are a
        part; and what it sees where there is no region.
        """
        seen = self.look(image)
        likely = [each for each in seen.instances if each.probability >= MATCH.sure]

        def is_part(mask: CroppedMask) -> bool:
            wholes = (each.mask for each in likely if each.mask.area > MATCH.larger * mask.area)
            return any(mask.overlap(whole) > MATCH.part * mask.area for whole in wholes)

        def stands(mask: CroppedMask) -> bool:
            return bool(seen.standing[mask.rows, mask.columns][mask.patch].mean() >= MATCH.seen)

        kept = [each for each in find_regions(image) if stands(each.mask) and not is_part(each.mask)]
        new = [
            replace(thing_of(image, each.mask), confidence=each.probability)
            for each in likely
            if all(each.mask.overlap(one.mask) < MATCH.shared * min(each.mask.area, one.mask.area) for one in kept)
        ]
        found = [*kept, *new]  # what does not exist hides nothing
        found = [replace(each, is_hidden=each.is_hidden and is_behind_any(each, found)) for each in found]
        return tuple(sorted(found, key=lambda thing: -thing.mask.area))

    def look(self, image: Image) -> Seen:
        """What the network sees in an RGB image [H, W, 3]."""
        height, width = image.shape[:2]
        fine, coarse = self.maps(image)
        shares = np.exp(fine[:DRAWN] - fine[:DRAWN].max(axis=0))
        shares /= shares.sum(axis=0)
        heat, drawn, size = _sigmoid(coarse[0]), _sigmoid(fine[DRAWN]), fine.shape[:0:-1]
        offsets = cv2.resize(OFFSET_UNIT * np.moveaxis(coarse[1:3], 0, 2), size).astype(np.float32)
        wide_heat = np.asarray(cv2.resize(heat, size), np.float32)
        smooth = cv2.GaussianBlur(heat, (0, 0), 0.6)
        is_peak = (smooth >= cv2.dilate(smooth, np.ones((5, 5), np.uint8))) & (heat > self.limits.centre)
        centres = np.argwhere(is_peak).astype(np.float64) * 2 + 0.5  # row and column of the fine map
        member = np.ascontiguousarray(shares[STANDING])
        labels = self.joined(self._labels(member, centres, offsets), _sigmoid(fine[RIM]))
        grown = np.where(labels > 0, labels, cv2.dilate(labels, np.ones((3, 3), np.uint8)))
        near = cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST)
        standing = np.asarray(cv2.resize(member, (width, height)), np.float32)
        large = np.where(standing > self.limits.member, near, np.uint8(0))  # outlines are finer than the labels
        found = self._instances(labels, large, (member, wide_heat, drawn))
        return Seen(tuple(sorted(found, key=lambda thing: -thing.probability)), standing)

    def maps(self, image: Image) -> tuple[Floats32, Floats32]:
        """The fine map [6, h/2, w/2] and the coarse one [7, h/4, w/4]."""
        scale = (AREA / (image.shape[0] * image.shape[1])) ** 0.5
        # Of an input one step high OpenCV reads memory that was never written.
        height, width = (max(2 * STEP, round(side * scale / STEP) * STEP) for side in image.shape[:2])
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        with self._lock:
            self._network.setInput(cv2.dnn.blobFromImage(small, 1 / 255))
            fine, coarse = self._network.forward(["fine", "coarse"])
        return np.asarray(fine[0], np.float32), np.asarray(coarse[0], np.float32)

    def _labels(self, member: Floats32, centres: Floats, offsets: Floats32) -> Image:
        """Labels [h, w] of the pixels of things by their probabilities: 1 + the centre to which they point; patches
        that point to none have labels of their own."""
        limits, region = self.limits, member > self.limits.member
        around = cv2.dilate(region.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        centres = centres[around[tuple(centres.astype(int).T)]][:MOST]
        labels, nearest = np.zeros(region.shape, np.uint8), np.full(region.shape, limits.reach**2, np.float32)
        rows, columns = np.indices(region.shape, np.float32)
        down, right = rows + offsets[..., 0], columns + offsets[..., 1]
        for number, (row, column) in enumerate(centres.tolist(), start=1):
            away = np.square(down - row) + np.square(right - column)
            is_nearer = region & (away < nearest)
            labels[is_nearer], nearest[is_nearer] = number, away[is_nearer]
        rest = (region & (labels == 0)).astype(np.uint8)
        count, patches, stats, _ = cv2.connectedComponentsWithStats(rest, connectivity=4)
        large = [i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= 3 * limits.smallest]
        for number, patch in enumerate(large[: MOST - len(centres)], start=len(centres) + 1):
            labels[patches == patch] = number
        return self.tidied(labels)

    def joined(self, labels: Image, rim: Floats32) -> Image:
        """Labels [h, w] in which two things that touch are one where the rim between them is low."""
        pairs, heights = list[NDArray[np.int64]](), list[Floats32]()
        for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
            first, second = labels[a], labels[b]
            border = (first != second) & (first > 0) & (second > 0)
            low, high = np.minimum(first, second)[border], np.maximum(first, second)[border]
            pairs.append(low.astype(np.int64) * 256 + high)
            heights.append(np.maximum(rim[a], rim[b])[border])
        pair, owner = np.concatenate(pairs), np.arange(256)
        count, total = np.bincount(pair, minlength=1), np.bincount(pair, np.concatenate(heights), minlength=1)
        for touching in np.flatnonzero(count >= TOUCH):
            if total[touching] / count[touching] < self.limits.rim:
                owner[owner == owner[touching % 256]] = owner[touching // 256]
        return owner.astype(np.uint8)[labels]

    def tidied(self, labels: Image) -> Image:
        """Labels [h, w] without small things, and without patches far smaller than the largest of their thing."""
        kept = np.zeros_like(labels)
        for number in np.flatnonzero(np.bincount(labels.ravel(), minlength=256)[1:] >= self.limits.smallest) + 1:
            x, y, w, h = cv2.boundingRect((labels == number).astype(np.uint8))
            part = (labels[y : y + h, x : x + w] == number).astype(np.uint8)
            _, patches, stats, _ = cv2.connectedComponentsWithStats(part, connectivity=8)
            areas = stats[:, cv2.CC_STAT_AREA]
            is_kept = areas >= 0.25 * areas[1:].max()
            is_kept[0] = False
            if areas[is_kept].sum() >= self.limits.smallest:
                kept[y : y + h, x : x + w][is_kept[patches]] = number
        return kept

    def _instances(self, labels: Image, large: Image, clues: tuple[Floats32, Floats32, Floats32]) -> list[Instance]:
        """What labels [h, w] of the fine map mean, with their masks by labels [H, W] of the picture."""
        found = list[Instance]()
        for number in np.unique(labels)[1:]:
            told, mask = self.calibration.probability(labels == number, *clues), large == number
            if told >= self.limits.probability and mask.any():
                found.append(Instance(CroppedMask.of(mask), told))
        return found


def create(settings: Settings) -> Eye:
    """Factory for the registry."""
    return Eye()


def is_behind_any(thing: Thing, others: Sequence[Thing]) -> bool:
    """Whether another thing that ends lower in the image touches it."""
    grown = dilated(thing.mask.full(), 5)
    return any(each.bbox[3] > thing.bbox[3] and each.mask.shared_with(grown) for each in others)


def _sigmoid(logits: Floats32 | np.float64) -> Floats32:
    return np.asarray(1 / (1 + np.exp(-np.clip(logits, -30, 30))), np.float32)
