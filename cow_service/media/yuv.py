"""RGB frames to 4:2:0 Y'CbCr of BT.709, limited range. Only what has changed since the frame before is converted.

The matrix is that of ITU-R BT.709-6, section 3, quantized to 8 bits: Y' 16 to 235, Cb and Cr 16 to 240. A sample of Cb
and Cr is the mean of the four pixels around it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_RED, _BLUE = 0.2126, 0.0722
_LUMA = np.array([_RED, 1 - _RED - _BLUE, _BLUE])
_CB = (np.array([0, 0, 1]) - _LUMA) / (2 * (1 - _BLUE))
_CR = (np.array([1, 0, 0]) - _LUMA) / (2 * (1 - _RED))
# Of R, G, B and 1; the second and third row give Cb and Cr.
_TO_LUMA = np.array([[*(_LUMA * 219 / 255), 16]], np.float32)
_TO_CHROMA = np.array([[*(_CB * 224 / 255), 128], [*(_CR * 224 / 255), 128]], np.float32)


class YuvFrames:
    """The planes of one frame after another of a clip."""

    def __init__(self, height: int, width: int) -> None:
        """Of frames [height, width, 3], both even."""
        self._rgb = np.empty((height, width, 3), np.uint8)
        self._planes = np.empty((height * 3 // 2, width), np.uint8)
        self._is_first = True

    def converted(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The planes [H * 3 / 2, W] of a frame [H, W, 3], as `yuv420p` lays them out; valid until the next call."""
        window = self._changed(rgb)
        if window is not None:
            self._convert(rgb[window], *window)
            self._rgb[window] = rgb[window]
            self._is_first = False
        return self._planes

    def _changed(self, rgb: NDArray[np.uint8]) -> tuple[slice, slice] | None:
        """The rows and columns, even, in which a frame differs from the one before; None where it does not."""
        height, width = rgb.shape[:2]
        if self._is_first:
            return slice(0, height), slice(0, width)
        differs = rgb.reshape(height, -1) != self._rgb.reshape(height, -1)
        rows = np.nonzero(differs.any(axis=1))[0]
        if not len(rows):
            return None
        top, bottom = int(rows[0]) // 2 * 2, int(rows[-1]) // 2 * 2 + 2
        columns = np.nonzero(differs[top:bottom].any(axis=0))[0] // 3
        return slice(top, bottom), slice(int(columns[0]) // 2 * 2, int(columns[-1]) // 2 * 2 + 2)

    def _convert(self, rgb: NDArray[np.uint8], rows: slice, columns: slice) -> None:
        """Writes a window of a frame into the planes."""
        height, width = self._rgb.shape[:2]
        self._planes[rows, columns] = cv2.transform(rgb, _TO_LUMA).reshape(rgb.shape[:2])
        size = rgb.shape[1] // 2, rgb.shape[0] // 2
        chroma = cv2.transform(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), _TO_CHROMA)
        planes = self._planes[height:].reshape(2, height // 2, width // 2)
        window = slice(rows.start // 2, rows.stop // 2), slice(columns.start // 2, columns.stop // 2)
        for plane, values in zip(planes, cv2.split(chroma), strict=True):
            plane[window] = values
