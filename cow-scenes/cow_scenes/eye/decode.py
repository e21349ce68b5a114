"""Looks at a picture: the network by OpenCV, and things from its two maps. NumPy and OpenCV only, no torch.

This module depends on nothing else of the package, so that whoever uses the weights can take it along.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

AREA, STEP = 640 * 384, 32
"""Pixels that the network sees, and what the sides of its input are multiples of."""
SUPPORT, FLAT, THING, DRAWN, RIM = 1, 2, 3, 4, 5
"""Channels of the fine map; channel 0 is anything else."""
OFFSET_UNIT = 16.0
"""Pixels of the fine map in one unit of an offset."""


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Probabilities of logits, which are cut at 30: beyond that float32 would overflow."""
    return 1 / (1 + np.exp(-np.clip(logits, -30, 30)))


@dataclass(frozen=True)
class Limits:
    """What counts as found, in the network's own units; chosen on drawn pictures that were not learned from.

    `centre` is the least height of a centre, `member` the least probability of a thing's pixel, `smallest` the least
    pixels of a thing in the fine map, `reach` how far from its centre a pixel may point, in pixels there, `rim` the
    least mean height of a rim between two things that touch, `probability` the least with which a thing is reported.
    """

    centre: float = 0.3
    member: float = 0.5
    smallest: int = 16
    reach: float = 24.0
    rim: float = 0.25
    probability: float = 0.3


@dataclass(frozen=True)
class Calibration:
    """A logistic regression from what the maps say of a thing to the probability that one is there (IoU of 0.5)."""

    constant: float = 0.0
    member: float = 1.0
    centre: float = 1.0
    size: float = 0.0
    drawn: float = 0.0

    def probability(self, evidence: np.ndarray) -> float:
        """The probability for (member, centre, size, drawn) as `evidence_of` gives them."""
        weights = np.array([self.member, self.centre, self.size, self.drawn])
        return float(sigmoid(self.constant + evidence @ weights))


@dataclass(frozen=True)
class Instance:
    """Something found: its `mask` (h, w) bool, whether it lies flat, and how probable it is that it exists."""

    mask: np.ndarray
    is_flat: bool
    probability: float
    evidence: np.ndarray


@dataclass(frozen=True)
class Sight:
    """What is seen in a picture: things, and masks (h, w) bool of supports, of what is flat on them, of what is drawn.

    `normal` (right, down, forward) is the mean normal of the supports, None without any.
    """

    instances: tuple[Instance, ...]
    support: np.ndarray
    flat: np.ndarray
    drawn: np.ndarray
    normal: np.ndarray | None


def input_size(height: int, width: int) -> tuple[int, int]:
    """The height and width at which the network sees a picture: its shape, AREA pixels, multiples of STEP."""
    scale = (AREA / (height * width)) ** 0.5
    return tuple(max(STEP, round(side * scale / STEP) * STEP) for side in (height, width))  # type: ignore[return-value]


def peaks_of(heat: np.ndarray, least: float) -> np.ndarray:
    """Centres (n, 2) as row and column of the fine map, from heights (h/2, w/2) of the coarse map."""
    smooth = cv2.GaussianBlur(heat, (0, 0), 0.6)
    is_peak = (smooth >= cv2.dilate(smooth, np.ones((5, 5), np.uint8))) & (heat > least)
    return np.argwhere(is_peak) * 2 + 0.5


def grouped(
    region: np.ndarray, centres: np.ndarray, offsets: np.ndarray, limits: Limits, keep_rest: bool
) -> np.ndarray:
    """Labels (h, w) uint8 of a region's pixels: 1 + the centre they point to, then the patches that point to none."""
    labels = np.zeros(region.shape, np.uint8)
    rows, columns = np.nonzero(region)
    if len(rows) and len(centres):
        pointed = np.stack([rows, columns], 1) + OFFSET_UNIT * offsets[rows, columns]
        away = np.square(pointed[:, None, 0] - centres[:, 0]) + np.square(pointed[:, None, 1] - centres[:, 1])
        nearest = away.argmin(1)
        is_near = away[np.arange(len(nearest)), nearest] < limits.reach**2
        labels[rows[is_near], columns[is_near]] = nearest[is_near] + 1
    if keep_rest:
        rest = (region & (labels == 0)).astype(np.uint8)
        count, patches, stats, _ = cv2.connectedComponentsWithStats(rest, connectivity=4)
        number = len(centres)
        for k in range(1, count):
            if stats[k, cv2.CC_STAT_AREA] >= 3 * limits.smallest and number < 250:
                number += 1
                labels[patches == k] = number
    return labels


def joined(labels: np.ndarray, rim: np.ndarray, least: float) -> np.ndarray:
    """Labels in which two things that touch are one if the mean height of the rim between them is below `least`."""
    pairs, heights = [], []
    for a, b in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        first, second = labels[a], labels[b]
        border = (first != second) & (first > 0) & (second > 0)
        low, high = np.minimum(first, second)[border], np.maximum(first, second)[border]
        pairs.append(low.astype(np.int64) * 256 + high)
        heights.append(np.maximum(rim[a], rim[b])[border])
    pair, height = np.concatenate(pairs), np.concatenate(heights)
    count, total = np.bincount(pair, minlength=1), np.bincount(pair, height, minlength=1)
    owner = np.arange(256)
    for k in np.flatnonzero(count >= 4):
        if total[k] / count[k] < least:
            low, high = owner[k // 256], owner[k % 256]
            owner[owner == high] = low
    return owner.astype(np.uint8)[labels]


def tidied(labels: np.ndarray, limits: Limits) -> np.ndarray:
    """Labels without small things, and without patches far smaller than the largest of their thing."""
    kept = np.zeros_like(labels)
    for number in np.flatnonzero(np.bincount(labels.ravel(), minlength=256)[1:] >= limits.smallest) + 1:
        x, y, w, h = cv2.boundingRect((labels == number).astype(np.uint8))
        part = labels[y : y + h, x : x + w] == number
        _, patches, stats, _ = cv2.connectedComponentsWithStats(part.astype(np.uint8), connectivity=8)
        area = stats[:, cv2.CC_STAT_AREA]
        is_kept = area >= 0.25 * area[1:].max()
        is_kept[0] = False
        if area[is_kept].sum() >= limits.smallest:
            kept[y : y + h, x : x + w][is_kept[patches]] = number
    return kept


def enlarged(labels: np.ndarray, member: np.ndarray, least: float, height: int, width: int) -> np.ndarray:
    """Labels at the picture's size; outlines follow the probability, which is finer than the labels."""
    grown = np.where(labels > 0, labels, cv2.dilate(labels, np.ones((3, 3), np.uint8)))
    near = cv2.resize(grown, (width, height), interpolation=cv2.INTER_NEAREST)
    return np.where(cv2.resize(member, (width, height)) > least, near, 0)


def evidence_of(part: np.ndarray, member: np.ndarray, heat: np.ndarray, drawn: np.ndarray) -> np.ndarray:
    """What tells a thing from none: logits of its mean probability and of its centre, size, share drawn over."""
    values = np.clip([member[part].mean(), heat[part].max()], 0.005, 0.995)
    return np.array([*np.log(values / (1 - values)), np.log(part.sum() / 400), drawn[part].mean()])


class Eye:
    """The network and its calibration, read from `things.onnx` and the card `things.json` beside it."""

    def __init__(self, weights: Path, limits: Limits | None = None) -> None:
        self.network = cv2.dnn.readNetFromONNX(str(weights))
        card = json.loads(weights.with_suffix(".json").read_text())
        self.calibrations = {
            is_flat: Calibration(**card["calibration"]["flat" if is_flat else "standing"]) for is_flat in (False, True)
        }
        self.limits = limits or Limits(**card["limits"])

    def maps(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The fine map (6, h/2, w/2) and the coarse one (7, h/4, w/4) of a picture (h, w, 3) uint8 RGB."""
        height, width = input_size(*image.shape[:2])
        small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        self.network.setInput(cv2.dnn.blobFromImage(small, 1 / 255))
        fine, coarse = self.network.forward(["fine", "coarse"])
        return fine[0], coarse[0]

    def look(self, image: np.ndarray) -> Sight:
        """Everything that is seen in a picture (h, w, 3) uint8 RGB, the surest things first."""
        return self.interpret(*self.maps(image), *image.shape[:2])

    def interpret(self, fine: np.ndarray, coarse: np.ndarray, height: int, width: int) -> Sight:
        """What the two maps of a picture of some size show."""
        shares = np.exp(fine[:DRAWN] - fine[:DRAWN].max(0))
        shares /= shares.sum(0)
        heat, drawn, rim, size = sigmoid(coarse[0]), sigmoid(fine[DRAWN]), sigmoid(fine[RIM]), fine.shape[:0:-1]
        offsets = cv2.resize(np.ascontiguousarray(coarse[1:3].transpose(1, 2, 0)), size)
        centres = peaks_of(heat, self.limits.centre)
        clues = (cv2.resize(heat, size), drawn)
        found: list[Instance] = []
        for member, is_flat in ((shares[THING], False), (shares[FLAT], True)):
            labels = joined(self.labels_of(member, centres, offsets, keep_rest=not is_flat), rim, self.limits.rim)
            large = enlarged(labels, member, self.limits.member, height, width)
            for number in np.unique(labels)[1:]:
                evidence = evidence_of(labels == number, member, *clues)
                probability = self.calibrations[is_flat].probability(evidence)
                if probability >= self.limits.probability:
                    found.append(Instance(large == number, is_flat, probability, evidence))
        support, flat, over = (cv2.resize(m, (width, height)) > 0.5 for m in (shares[SUPPORT], shares[FLAT], drawn))
        normal = coarse[4:7][:, shares[SUPPORT][::2, ::2] > 0.5].sum(1)
        length = float(np.linalg.norm(normal))
        ordered = tuple(sorted(found, key=lambda thing: -thing.probability))
        return Sight(ordered, support, flat, over, normal / length if length else None)

    def labels_of(self, member: np.ndarray, centres: np.ndarray, offsets: np.ndarray, *, keep_rest: bool) -> np.ndarray:
        """Labels (h/2, w/2) of the things of one class, of which a map gives the probabilities."""
        region = member > self.limits.member
        around = cv2.dilate(region.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        rows, columns = centres.astype(int).T
        chosen = centres[around[rows, columns]][:250]
        return tidied(grouped(region, chosen, offsets, self.limits, keep_rest=keep_rest), self.limits)
