"""Brings images and masks to another size, never to none."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


def scaled(image: Image, scale: float) -> Image:
    """An image [H, W, ...] times a scale of at most 1, each side at least 1 px; the same array for 1."""
    if scale >= 1:
        return image
    height, width = image.shape[:2]
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def resized_mask(mask: Mask, size: tuple[int, int]) -> Mask:
    """A mask [H, W] at a size (width, height): set where half of a pixel is; the same array for its own size."""
    if (mask.shape[1], mask.shape[0]) == size:
        return mask
    return cv2.resize(mask.astype(np.uint8) * np.uint8(255), size, interpolation=cv2.INTER_AREA) >= 128


def box_around(mask: Mask) -> tuple[slice, slice] | None:
    """Rows and columns that a mask [H, W] spans, or None for an empty one."""
    rows, columns = np.nonzero(mask.any(axis=1))[0], np.nonzero(mask.any(axis=0))[0]
    if not len(rows):
        return None
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
