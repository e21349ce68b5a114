"""Straight edges of an image as line segments, and which of them are those of a thing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from cow_service.media.masks import CroppedMask, dilated, scaled
from cow_service.media.types import Floats, Image, Mask
from cow_service.physics.vanishing import lengths_of


class SegmentRules(NamedTuple):
    """Which straight edges tell of the camera, and whose they are.

    Set by hand on rendered scenes of the first family; no single number has a measurement of its own.
    """

    working_side: int = 832  # px: longer images are searched at this size
    least_length: float = 0.016  # of the longer side of the image
    own_gap: int = 4  # px at the working size: nearer to a thing lie its own edges
    other_gap: int = 12  # px at the working size: farther from a thing lie the edges of others
    least_beside: float = 0.05  # of the longer side of the image, between things: shorter ones are texture
    sampled: tuple[float, float, float] = (0.1, 0.5, 0.9)  # of the way along a segment
    drawing_reach: int = 9  # px: width of the square by which drawings are grown, over what was left of their edges


SEGMENT = SegmentRules()


def find_segments(image: Image, drawn: Mask) -> Floats:
    """Ends [N, 4] (x, y, x, y; px) of the line segments of an RGB image [H, W, 3], longest first.

    Those are left out that touch a mask [H, W] of what was drawn over the image.
    """
    longest = max(image.shape[:2])
    scale = min(1.0, SEGMENT.working_side / longest)
    grey = cv2.cvtColor(scaled(image, scale), cv2.COLOR_RGB2GRAY)
    found: Any = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    segments = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64).reshape(-1, 4) / scale
    lengths = lengths_of(segments)
    order = np.argsort(-lengths, kind="stable")
    segments = segments[order[lengths[order] >= SEGMENT.least_length * longest]]
    if not len(segments) or not drawn.any():
        return segments
    grown = dilated(drawn, SEGMENT.drawing_reach)
    x, y = np.clip(_samples(segments).astype(int), 0, np.array(drawn.shape[::-1]) - 1).transpose(2, 0, 1)
    return segments[~grown[y, x].any(axis=0)]


def divide(segments: Floats, masks: Sequence[CroppedMask]) -> tuple[list[Floats], Floats]:
    """Of segments [N, 4] (px) those [S, 4] of each thing by its mask, and the long ones that lie away from all."""
    own: list[Floats] = []
    beside = np.ones(len(segments), bool)
    for mask in masks:
        scale = max(1.0, max(mask.shape) / SEGMENT.working_side)
        own.append(segments[_within(segments, mask, round(SEGMENT.own_gap * scale)).all(axis=0)])
        beside &= ~_within(segments, mask, round(SEGMENT.other_gap * scale)).any(axis=0)
    if masks:
        beside &= lengths_of(segments) > SEGMENT.least_beside * max(masks[0].shape)
    return own, segments[beside]


def _within(segments: Floats, mask: CroppedMask, margin: int) -> Mask:
    """Which [3, N] samples of segments [N, 4] (px) lie within a margin (px) of a mask."""
    patch = dilated(np.pad(mask.patch, margin), 2 * margin + 1)
    corner = np.array([mask.columns.start, mask.rows.start]) - margin
    x, y = (np.floor(_samples(segments)).astype(int) - corner).transpose(2, 0, 1)
    inside = (x >= 0) & (y >= 0) & (x < patch.shape[1]) & (y < patch.shape[0])
    return np.asarray(patch[np.where(inside, y, 0), np.where(inside, x, 0)] & inside)


def _samples(segments: Floats) -> Floats:
    """Points [3, N, 2] (px) along segments [N, 4] (px)."""
    along = segments[:, 2:] - segments[:, :2]
    return np.stack([segments[:, :2] + share * along for share in SEGMENT.sampled])
