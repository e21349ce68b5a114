"""Draws the results over the input image: box, point, direction, path and encounters."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.records import BBox, Grounding, Motion, Trajectory

BOX, PATH, ARROW, LIGHT, DARK = (255, 196, 0), (0, 229, 255), (255, 64, 129), (255, 255, 255), (20, 20, 20)
ENCOUNTERS = {"touches": (255, 82, 82), "occludes": (190, 120, 255), "occluded-by": (120, 200, 255)}  # RGB
SUBPIXEL = 4  # binary places of the coordinates handed to OpenCV

Image = NDArray[np.uint8]


def draw_overlay(image: Image, grounding: Grounding, motion: Motion, trajectory: Trajectory) -> Image:
    """A copy of the RGB image [H, W, 3] with the records drawn on it; sizes follow the image's."""
    canvas = np.ascontiguousarray(image).copy()
    unit = max(1.0, max(canvas.shape[:2]) / 640)
    thin = max(1, round(unit))
    for encounter in trajectory.encounters:
        _rectangle(canvas, encounter.bbox, ENCOUNTERS[encounter.kind], thin)
    _draw_path(canvas, trajectory, thin)
    _rectangle(canvas, grounding.bbox, BOX, 2 * thin)
    for encounter in trajectory.encounters:
        text = f"{encounter.kind} {encounter.object} {encounter.first_frame / trajectory.fps:.1f} s"
        _label(canvas, text, encounter.bbox, ENCOUNTERS[encounter.kind], unit, below=True)
    _label(canvas, grounding.object, grounding.bbox, BOX, unit, below=False)
    if motion.direction is not None:
        start = np.array(grounding.point)
        reach = 0.14 * max(canvas.shape[:2])
        tip = start + np.array(motion.direction) * reach
        for colour, width in ((DARK, 4 * thin), (ARROW, 2 * thin)):
            cv2.arrowedLine(canvas, _fixed(start), _fixed(tip), colour, width, cv2.LINE_AA, SUBPIXEL, 0.28)
    cv2.circle(canvas, _fixed(grounding.point), round(4 * unit * 2**SUBPIXEL), DARK, -1, cv2.LINE_AA, SUBPIXEL)
    cv2.circle(canvas, _fixed(grounding.point), round(3 * unit * 2**SUBPIXEL), LIGHT, -1, cv2.LINE_AA, SUBPIXEL)
    return canvas


def _draw_path(canvas: Image, trajectory: Trajectory, thin: int) -> None:
    """The path as far as it is visible, with a dot every half second."""
    seen = [point for point, visible in zip(trajectory.points, trajectory.visible, strict=True) if visible]
    line = np.array([_fixed(point) for point in seen], np.int32).reshape(-1, 1, 2)
    for colour, width in ((DARK, 3 * thin), (PATH, thin)):
        cv2.polylines(canvas, [line], False, colour, width, cv2.LINE_AA, SUBPIXEL)
    step = max(1, round(trajectory.fps / 2))
    for index in range(step, len(trajectory.points), step):
        if trajectory.visible[index]:
            centre = _fixed(trajectory.points[index])
            cv2.circle(canvas, centre, round(3.5 * thin * 2**SUBPIXEL), DARK, -1, cv2.LINE_AA, SUBPIXEL)
            cv2.circle(canvas, centre, round(2.5 * thin * 2**SUBPIXEL), PATH, -1, cv2.LINE_AA, SUBPIXEL)


def _rectangle(canvas: Image, bbox: BBox, colour: tuple[int, int, int], width: int) -> None:
    corners = _fixed(bbox[:2]), _fixed(bbox[2:])
    cv2.rectangle(canvas, *corners, DARK, width + 2, cv2.LINE_AA, SUBPIXEL)
    cv2.rectangle(canvas, *corners, colour, width, cv2.LINE_AA, SUBPIXEL)


def _label(
    canvas: Image,
    text: str,
    bbox: BBox,
    colour: tuple[int, int, int],
    unit: float,
    *,
    below: bool,
) -> None:
    """Text on a dark plate above or below a box, kept inside the image. Letters that OpenCV lacks become '?'."""
    shown = text.encode("ascii", "replace").decode()[:60]
    size, weight = 0.42 * unit, max(1, round(unit))
    (width, height), base = cv2.getTextSize(shown, cv2.FONT_HERSHEY_SIMPLEX, size, weight)
    pad = round(3 * unit)
    plate = height + base + 2 * pad
    y = bbox[3] + pad if below else bbox[1] - plate - pad
    y = int(min(max(0, y), canvas.shape[0] - plate))
    x = int(min(max(0, bbox[0]), max(0, canvas.shape[1] - width - 2 * pad)))
    cv2.rectangle(canvas, (x, y), (x + width + 2 * pad, y + plate), DARK, -1)
    cv2.putText(canvas, shown, (x + pad, y + pad + height), cv2.FONT_HERSHEY_SIMPLEX, size, colour, weight, cv2.LINE_AA)


def _fixed(point: tuple[float, ...] | NDArray[np.float64]) -> tuple[int, int]:
    """Fixed-point pixel centres, bounded so that far points stay drawable."""
    x, y = (float(np.clip(v, -20_000, 20_000)) for v in point[:2])
    return round((x - 0.5) * 2**SUBPIXEL), round((y - 0.5) * 2**SUBPIXEL)
