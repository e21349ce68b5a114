"""Where bodies pass in the image: the mask of everything that may move."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from cow_service.records import Path
from cow_service.vision.masks import CroppedMask, scaled_size
from cow_service.vision.types import Floats, Mask

WORKING_SIDE = 320  # px: paths are swept at this size


def swept(masks: Sequence[CroppedMask], starts: Sequence[Floats], paths: Sequence[Path]) -> Mask:
    """Mask [H, W] of every place that bodies cover on their paths: those of `masks`, first at `starts` [2] (px)."""
    height, width = masks[0].shape
    factor = min(1.0, WORKING_SIDE / max(height, width))
    size = scaled_size(width, height, factor)
    canvas = np.zeros((size[1], size[0]), np.uint8)
    for mask, start, path in zip(masks, starts, paths, strict=True):
        contours, _ = cv2.findContours(mask.patch.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        if not contours:
            continue
        outline = np.asarray(max(contours, key=len)[:, 0], np.float64) - start
        outline += np.array([mask.columns.start, mask.rows.start])
        for point, scale in zip(path.points, path.scale, strict=True):
            moved = (np.array(point) + scale * outline) * factor
            if np.all(np.abs(moved) < 4 * max(size)):
                cv2.fillPoly(canvas, [np.round(moved).astype(np.int32)], 1)
    return cv2.resize(canvas, (width, height), interpolation=cv2.INTER_NEAREST) > 0
