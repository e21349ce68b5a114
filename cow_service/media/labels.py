"""Places labels on a picture: inside it, and where they do not cover each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

LETTERS = 0.42  # size of the letters, in OpenCV's unit, for a picture whose unit is 1
STEPS = 12  # places tried above each other, in heights of a label, before covering another one is accepted

Image = NDArray[np.uint8]
Floats = NDArray[np.float64]
Colour = tuple[int, int, int]
Plate = tuple[int, int, int, int]  # left, top, right and bottom, px


@dataclass(frozen=True)
class Label:
    """Words about something in a box."""

    text: str
    bbox: tuple[float, float, float, float]  # [x0, y0, x1, y1], px
    colour: Colour
    below: bool  # rather than above the box


def draw_labels(
    canvas: Image, labels: Sequence[Label], unit: float, dark: Colour, points: Sequence[tuple[float, float]] = ()
) -> tuple[Plate, ...]:
    """Draws texts on dark plates, and returns the plates. Letters that OpenCV lacks become '?'.

    A label covers another one only where there is no other place, and as few of the points (px) as can be.
    """
    height, width = canvas.shape[:2]
    weight, pad, size = max(1, round(unit)), round(3 * unit), LETTERS * unit
    placed: list[Plate] = []
    spots = np.array(points, np.float64).reshape(-1, 2)
    for label in labels:
        text = _fitted(label.text.encode("ascii", "replace").decode(), size, weight, width - 2 * pad)
        (across, up), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, weight)
        plate = _free_place(label, across + 2 * pad, up + base + 2 * pad, pad, (width, height), placed, spots)
        placed.append(plate)
        cv2.rectangle(canvas, plate[:2], (plate[2] - 1, plate[3] - 1), dark, -1)
        origin = plate[0] + pad, plate[1] + pad + up
        cv2.putText(canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, size, label.colour, weight, cv2.LINE_AA)
    return tuple(placed)


def _fitted(text: str, size: float, weight: int, width: int) -> str:
    """The text, cut to a width (px)."""
    shown = text
    while len(shown) > 4 and cv2.getTextSize(shown, cv2.FONT_HERSHEY_SIMPLEX, size, weight)[0][0] > width:
        text = text[:-1]
        shown = text.rstrip() + "..."
    return shown


def _free_place(
    label: Label,
    width: int,
    height: int,
    gap: int,
    size: tuple[int, int],
    placed: Sequence[Plate],
    points: Floats,
) -> Plate:
    """Where a label of a width and height (px) covers least of the others; then fewest points; then next to its box."""
    x0, y0, x1, y1 = (float(np.clip(v, -20_000, 20_000)) for v in label.bbox)
    below, above = y1 + gap, y0 - gap - height
    rows = (below, above) if label.below else (above, below)
    places = [(x, y) for y in rows for x in (x0, x1 - width)] + [(x1 + gap, y0), (x0 - gap - width, y0)]
    for step in range(1, STEPS):
        places += [(x0, below + step * (height + 1)), (x0, above - step * (height + 1))]
    tried = [_inside(x, y, width, height, size) for x, y in places]
    tried += [(0, row, width, row + height) for row in range(0, max(1, size[1] - height), height + 1)]
    return min(tried, key=lambda plate: (sum(_shared(plate, other) for other in placed), _count_in(plate, points)))


def _count_in(plate: Plate, points: Floats) -> int:
    inside = (points >= plate[:2]) & (points < plate[2:])
    return int(np.count_nonzero(inside[:, 0] & inside[:, 1]))


def _inside(x: float, y: float, width: int, height: int, size: tuple[int, int]) -> Plate:
    left, top = (
        int(max(0, min(v, whole - part))) for v, part, whole in zip((x, y), (width, height), size, strict=True)
    )
    return left, top, left + width, top + height


def _shared(a: Plate, b: Plate) -> int:
    """Pixels that two plates have in common."""
    return max(0, min(a[2], b[2]) - max(a[0], b[0])) * max(0, min(a[3], b[3]) - max(a[1], b[1]))
