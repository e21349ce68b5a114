"""Puts several frames side by side into one named picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cow_service.media.labels import Label, draw_labels

PER_ROW = 3  # frames
GAP = 6  # px between frames
BAR = 26  # px above the frames for the name, in a picture whose unit is 1
LIGHT, DARK = (255, 255, 255), (20, 20, 20)

Image = NDArray[np.uint8]


def named_strip(frames: Sequence[Image], name: str) -> Image:
    """Frames [h, w, 3] of one size in their order, in rows from left to right, below a name."""
    height, width = frames[0].shape[:2]
    unit = max(1.0, max(height, width) / 640)
    columns, bar = min(PER_ROW, len(frames)), round(BAR * unit)
    rows = -(-len(frames) // columns)
    total = columns * (width + GAP) - GAP, bar + rows * (height + GAP) - GAP
    strip = np.full((total[1], total[0], 3), DARK[0], np.uint8)
    for place, frame in enumerate(frames):
        y, x = bar + place // columns * (height + GAP), place % columns * (width + GAP)
        strip[y : y + height, x : x + width] = frame
    draw_labels(strip, [Label(name, (0.0, float(bar), float(total[0]), float(bar)), LIGHT, below=False)], unit, DARK)
    return strip
