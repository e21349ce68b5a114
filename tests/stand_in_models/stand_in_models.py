"""A segmenter and a detector that see plain scenes by their colours, in place of models that take weights.

The folder of this file on PYTHONPATH registers them, exactly as an installed package would.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from cow_service.media.masks import bbox_of, iou
from cow_service.media.types import Image, Mask
from cow_service.perception.base import Detection, Prompt, Segment
from cow_service.perception.classical.regions import find_regions

LEAST = 30  # px of a thing
OFF_FLOOR, OTHER_FACE = 40, 12  # grey levels: of a thing beside the floor, of a face beside the next one


class StandInSegmenter:
    """Finds things that lie inside the picture, and their faces where they have several."""

    fingerprint = "stand-in-segmenter"

    def embed(self, image: Image) -> list[tuple[Mask, float]]:
        """The masks of all things and faces, with their scores: things first."""
        edge = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
        gap = np.abs(image.astype(int) - np.median(edge, axis=0)).max(axis=2)
        count, labels = cv2.connectedComponents((gap > OFF_FLOOR).astype(np.uint8))
        things = [thing for i in range(1, count) if np.count_nonzero(thing := labels == i) >= LEAST]
        return [(thing, 0.9) for thing in things] + [(face, 0.88) for thing in things for face in faces(image, thing)]

    def segment(
        self, embedding: list[tuple[Mask, float]], prompts: Sequence[Prompt]
    ) -> tuple[tuple[Segment, ...], ...]:
        """All at a point; the one that fills a box best."""
        return tuple(tuple(self._segments(embedding, prompt)) for prompt in prompts)

    def _segments(self, embedding: list[tuple[Mask, float]], prompt: Prompt) -> list[Segment]:
        found = embedding
        if prompt.point is not None:
            x, y = (int(value) for value in prompt.point)
            found = [each for each in found if each[0][y : y + 1, x : x + 1].any()]
        elif prompt.bbox is not None:
            box = prompt.bbox
            found = sorted(found, key=lambda each: -iou(bbox_of(each[0]), box))[:1]
        return [Segment(np.where(mask, 8, -8).astype(np.float32), score) for mask, score in found]


def faces(image: Image, thing: Mask) -> list[Mask]:
    """The parts of a thing between steps of its colour; none where it is all one."""
    found: list[Mask] = []
    rest = thing.copy()
    while rest.any():
        y, x = np.argwhere(rest)[0].tolist()
        blocked = np.pad(~rest, 1, constant_values=True).astype(np.uint8)
        step = (OTHER_FACE,) * 3
        cv2.floodFill(image.copy(), blocked, (x, y), 0, step, step, 4 | cv2.FLOODFILL_MASK_ONLY | 2 << 8)
        face = blocked[1:-1, 1:-1] == 2
        rest &= ~face
        if LEAST <= np.count_nonzero(face) < 0.9 * np.count_nonzero(thing):
            found.append(face)
    return found


class StandInDetector:
    """Calls what is round a ball, and everything else by any other noun. A ghost is where nothing has an outline."""

    fingerprint = "stand-in-detector"

    def detect(self, image: Image, phrases: Sequence[str]) -> tuple[Detection, ...]:
        """The regions of the picture that may be called so."""
        regions, height, width = find_regions(image), *image.shape[:2]
        found = [
            Detection(phrase, region.bbox, 0.8)
            for phrase in phrases
            for region in regions
            if phrase != "ghost" and (phrase == "ball") == region.is_disc
        ]
        ghost = (0.4 * width, 0.05 * height, 0.6 * width, 0.3 * height)
        return (*found, *(Detection(phrase, ghost, 0.4) for phrase in phrases if phrase == "ghost"))


def create_segmenter(settings: Any) -> StandInSegmenter:
    """Factory for the registry."""
    return StandInSegmenter()


def create_detector(settings: Any) -> StandInDetector:
    """Factory for the registry."""
    return StandInDetector()
