"""Masks of objects, kept as small as the objects: an image of many megapixels can hold many of them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.vision.sizes import box_around, resized_mask

Mask = NDArray[np.bool_]
BBox = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Cutting:
    """A mask of an image, as the part of it that is not empty."""

    shape: tuple[int, int]  # height and width of the image, px
    rows: slice
    columns: slice
    patch: Mask  # [rows, columns]

    @property
    def bbox(self) -> BBox:
        """Tight box [x0, y0, x1, y1], px; x1 and y1 lie one past the last pixel."""
        return float(self.columns.start), float(self.rows.start), float(self.columns.stop), float(self.rows.stop)

    @property
    def area(self) -> int:
        """Pixels."""
        return int(np.count_nonzero(self.patch))

    def full(self) -> Mask:
        """The mask [H, W] of the whole image, made anew."""
        mask = np.zeros(self.shape, bool)
        mask[self.rows, self.columns] = self.patch
        return mask

    def at(self, size: tuple[int, int]) -> Mask:
        """The mask of the whole image at another size (width, height)."""
        return resized_mask(self.full(), size)

    def shared_with(self, mask: Mask) -> int:
        """Pixels that it shares with a mask [H, W]."""
        return int(np.count_nonzero(self.patch & mask[self.rows, self.columns]))

    def add_to(self, mask: Mask) -> None:
        """Sets its pixels in a mask [H, W]."""
        mask[self.rows, self.columns] |= self.patch


def cutting_of(mask: Mask) -> Cutting:
    """The cutting of a mask [H, W]; one pixel large for an empty mask."""
    window = box_around(mask) or (slice(0, 1), slice(0, 1))
    return Cutting((mask.shape[0], mask.shape[1]), *window, mask[window].copy())


def enlarged(soft: NDArray[np.float32], shape: tuple[int, int]) -> Cutting:
    """The cutting, in an image of `shape`, of where a smooth small mask [h, w] of 0..1, not empty, passes one half."""
    fy, fx = shape[0] / soft.shape[0], shape[1] / soft.shape[1]
    rows, columns = box_around(soft > 0.05) or (slice(0, 1), slice(0, 1))
    y0, y1 = int(rows.start * fy), min(shape[0], int(np.ceil(rows.stop * fy)))
    x0, x1 = int(columns.start * fx), min(shape[1], int(np.ceil(columns.stop * fx)))
    # Pixel centres map to pixel centres, as in a resize of the whole.
    back = np.array([[1 / fx, 0, (x0 + 0.5) / fx - 0.5], [0, 1 / fy, (y0 + 0.5) / fy - 0.5]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    values = cv2.warpAffine(soft, back, (x1 - x0, y1 - y0), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    patch = np.asarray(values) > 0.5
    tight = box_around(patch) or (slice(0, 1), slice(0, 1))
    rows, columns = (slice(o + s.start, o + s.stop) for o, s in zip((y0, x0), tight, strict=True))
    return Cutting(shape, rows, columns, patch[tight].copy())
