"""Finds boxes drawn over an image to mark an object: an upright rectangle's outline in one flat colour."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.vision.strokes import Stroke, WorkingImage, drawing_mask, full_size
from cow_service.vision.types import Mask

MIN_SIDE = 14  # px at the working size
ON_OUTLINE = 0.93  # share of the stroke that lies on its own bounding rectangle
COVERED = 0.85  # share of that rectangle's outline that the stroke covers: dashes are fine


@dataclass(frozen=True)
class DrawnBox:
    """A rectangle drawn over the image to mark something. It does not say what."""

    bbox: tuple[float, float, float, float]  # x0, y0, x1, y1, px: inside the line
    colour: tuple[int, int, int]  # RGB
    mask: Mask  # [H, W]: the line with its fringe


def find_boxes(image: WorkingImage, strokes: Iterable[Stroke], size: tuple[int, int]) -> tuple[DrawnBox, ...]:
    """Drawn boxes among the strokes of an image whose full size is [height, width], largest first."""
    boxes: list[DrawnBox] = []
    for stroke in strokes:
        if stroke.hollow:  # a box is drawn around something: its inside is not drawn
            continue
        line = _line_width(stroke.patch)
        if line is None:
            continue
        h, w = stroke.patch.shape
        inner = (stroke.x + line, stroke.y + line, stroke.x + w - line, stroke.y + h - line)
        x0, y0, x1, y1 = (value / image.scale for value in inner)
        if any(np.abs(np.array(box.bbox) - (x0, y0, x1, y1)).max() < 8 / image.scale for box in boxes):
            continue
        mask = full_size(drawing_mask(image.pixels, stroke), size)
        boxes.append(DrawnBox((x0, y0, x1, y1), stroke.colour, mask))
    return tuple(sorted(boxes, key=lambda box: -(box.bbox[2] - box.bbox[0]) * (box.bbox[3] - box.bbox[1])))


def _line_width(patch: Mask) -> int | None:
    """Width in px of the line, where the patch [h, w] is the outline of an upright rectangle; else None."""
    h, w = patch.shape
    if min(h, w) < MIN_SIDE:
        return None
    sides = (patch[:, w // 2], patch[:, w // 2][::-1], patch[h // 2], patch[h // 2][::-1])
    widths = [_first_run(side) for side in sides]
    line = int(np.median(widths))
    if not 1 <= line <= 0.2 * min(h, w):
        return None
    outline = np.zeros((h, w), np.uint8)
    cv2.rectangle(outline, (0, 0), (w - 1, h - 1), 1, -1)
    outline[line + 1 : h - line - 1, line + 1 : w - line - 1] = 0
    frame = outline.astype(bool)
    rim = np.concatenate([patch[:line].any(0), patch[-line:].any(0), patch[:, :line].any(1), patch[:, -line:].any(1)])
    if patch[frame].sum() < ON_OUTLINE * patch.sum() or rim.mean() < COVERED:
        return None
    return line


def _first_run(side: NDArray[np.bool_]) -> int:
    """How many pixels inwards the line ends, where it begins within a fringe of 2 px; else 0."""
    start = int(np.argmax(side))
    return start + int(np.argmin(side[start:])) if side[start] and start <= 2 else 0
