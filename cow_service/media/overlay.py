"""Draws the results over the input image: outline, direction, paths with their bands, contacts and encounters."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from typing import Any, ParamSpec, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media.images import fit_within, tiled
from cow_service.records import MEETINGS, BBox, Grounding, Motion, Path, Trajectory

LETTERS = 0.42  # size of the letters, in OpenCV's unit, for a picture whose unit is 1
STEPS = 12  # places tried above each other, in heights of a label, before covering another one is accepted

Given = ParamSpec("Given")
Made = TypeVar("Made")
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


# OpenCV loads its font again in each thread that writes, which takes longer than the rest of the drawing.
_letters = ThreadPoolExecutor(1, "cow-letters")


def draw_labels(
    canvas: Image, labels: Sequence[Label], unit: float, dark: Colour, points: Sequence[tuple[float, float]] = ()
) -> tuple[Plate, ...]:
    """Draws texts on dark plates, and returns the plates. Letters that OpenCV lacks become '?'.

    A label covers another one only where there is no other place, and as few of the points (px) as can be.
    """
    return in_letters_thread(_write, canvas, labels, unit, dark, points)


def in_letters_thread(write: Callable[Given, Made], *args: Given.args, **more: Given.kwargs) -> Made:
    """Calls what writes or measures letters in the thread that has them."""
    return _letters.submit(write, *args, **more).result()


def _write(
    canvas: Image, labels: Sequence[Label], unit: float, dark: Colour, points: Sequence[tuple[float, float]]
) -> tuple[Plate, ...]:
    height, width = canvas.shape[:2]
    weight, pad, size = max(1, round(unit)), round(3 * unit), LETTERS * unit
    placed: list[Plate] = []
    spots = np.array(points, np.float64).reshape(-1, 2)
    for label in labels:
        whole = text = label.text.encode("ascii", "replace").decode()
        (across, up), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, weight)
        while len(text) > 4 and across > width - 2 * pad:  # cut to the width of the picture
            whole = whole[:-1]
            text = whole.rstrip() + "..."
            (across, up), base = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, weight)
        plate = _free_place(label, across + 2 * pad, up + base + 2 * pad, pad, (width, height), placed, spots)
        placed.append(plate)
        cv2.rectangle(canvas, plate[:2], (plate[2] - 1, plate[3] - 1), dark, -1)
        origin = plate[0] + pad, plate[1] + pad + up
        cv2.putText(canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, size, label.colour, weight, cv2.LINE_AA)
    return tuple(placed)


def _free_place(
    label: Label, width: int, height: int, gap: int, size: tuple[int, int], placed: Sequence[Plate], points: Floats
) -> Plate:
    """Where a label of a width and height (px) covers least of the others; then fewest points; then next to its box."""
    x0, y0, x1, y1 = (float(np.clip(v, -20_000, 20_000)) for v in label.bbox)
    below, above = y1 + gap, y0 - gap - height
    rows = (below, above) if label.below else (above, below)
    places = [(x, y) for y in rows for x in (x0, x1 - width)] + [(x1 + gap, y0), (x0 - gap - width, y0)]
    for step in range(1, STEPS):
        places += [(x0, below + step * (height + 1)), (x0, above - step * (height + 1))]
    tried = [(int(max(0, min(x, size[0] - width))), int(max(0, min(y, size[1] - height)))) for x, y in places] + [
        (0, row) for row in range(0, max(1, size[1] - height), height + 1)
    ]

    def covered(plate: Plate) -> tuple[int, int]:
        """Pixels of other labels, and points."""
        left, top, right, bottom = plate
        pixels = sum(
            max(0, min(right, other[2]) - max(left, other[0])) * max(0, min(bottom, other[3]) - max(top, other[1]))
            for other in placed
        )
        return pixels, int(np.count_nonzero(((points >= plate[:2]) & (points < plate[2:])).all(axis=1)))

    return min(((left, top, left + width, top + height) for left, top in tried), key=covered)


OUTLINE, PATH, ARROW, LIGHT, DARK = (255, 196, 0), (0, 229, 255), (255, 64, 129), (255, 255, 255), (20, 20, 20)
PUSHED = (255, 150, 60)  # the paths of other bodies
ENCOUNTERS = {"touches": (255, 82, 82), "occludes": (190, 120, 255), "occluded-by": (120, 200, 255)}  # RGB
REMOVED = (255, 120, 120)  # what is taken away
PLACED = (130, 255, 130)  # what is put somewhere before the motion
HATCH, DASH = 9, 6  # line widths from one line of a hatching to the next, and of a dash
BAND_OPACITY, WIDE_BAND_OPACITY = 0.3, 0.06  # of a narrow band, and the minimum for a wide one
NARROW_BAND = 0.015  # share of the image up to which a box of a band is narrow
BAND_EDGE_OPACITY = 0.6  # of the line around a band
AT_REST = 0.25  # px per frame: what moves less rests
SUBPIXEL = 4  # binary places of the coordinates handed to OpenCV
FARTHEST = 20_000  # px: OpenCV draws no farther

Mask = NDArray[np.bool_]
Removed = tuple[str, BBox, Mask]
"""What is taken away: its name, box and mask [H, W]."""


@dataclass(frozen=True)
class Replaced:
    """What is put somewhere before the motion: its box and mask [H, W] there, and where the image shows it."""

    name: str
    place: str  # as in: next to the blue mug
    old_bbox: BBox
    old_mask: Mask
    bbox: BBox
    mask: Mask


def draw_overlay(
    image: Image,
    grounding: Grounding,
    motion: Motion,
    trajectory: Trajectory,
    mask: Mask | None = None,
    removed: Sequence[Removed] = (),
    placed: Sequence[Replaced] = (),
    max_side: int | None = None,
) -> Image:
    """A copy of the RGB image [H, W, 3], `max_side` px long at most, with the records drawn on it; sizes follow it.

    `mask` [H, W] is the mover's: its outline is drawn, and its box where there is none. What is `removed` is hatched;
    so is the old place of what is `placed`, whose outline is drawn at the new one.
    """
    canvas = fit_within(image, max_side).copy()
    ratio = np.array([canvas.shape[1] / image.shape[1], canvas.shape[0] / image.shape[0]])

    def moved(places: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
        """Points or boxes of the image, on the canvas."""
        return tuple(map(tuple, (np.array(places) * np.tile(ratio, len(places[0]) // 2)).tolist())) if places else ()

    def box(bbox: BBox) -> BBox:
        ((x0, y0, x1, y1),) = moved([bbox])
        return x0, y0, x1, y1

    def shrunk(mask: Mask) -> Mask:
        return fit_within(mask.astype(np.uint8) * np.uint8(255), max_side) >= 128

    def at(record: Any, **places: Any) -> Any:
        return record.model_copy(update=places)

    paths = tuple(at(path, points=moved(path.points), band=moved(path.band)) for path in trajectory.paths)
    contacts = tuple(at(each, point=moved([each.point])[0]) for each in trajectory.contacts)
    encounters = tuple(at(each, bbox=box(each.bbox)) for each in trajectory.encounters)
    removed = [(name, box(bbox), shrunk(gone)) for name, bbox, gone in removed]
    placed = [
        Replaced(each.name, each.place, box(each.old_bbox), shrunk(each.old_mask), box(each.bbox), shrunk(each.mask))
        for each in placed
    ]
    grounding = at(grounding, bbox=box(grounding.bbox), point=moved([grounding.point])[0])
    trajectory = at(trajectory, paths=paths, contacts=contacts, encounters=encounters)

    unit = max(1.0, max(canvas.shape[:2]) / 640)
    thin = max(1, round(unit))
    for _, _, gone in removed:
        _draw_removed(canvas, gone, REMOVED, thin)
    for each in placed:
        _draw_removed(canvas, each.old_mask, PLACED, thin)
        _draw_outline(canvas, each.mask, PLACED, thin)
    for number, path in reversed(list(enumerate(trajectory.paths))):
        _draw_band(canvas, path, PUSHED if number else PATH, thin)
    for encounter in trajectory.encounters:
        _rectangle(canvas, encounter.bbox, ENCOUNTERS[encounter.kind], thin)
    for number, path in reversed(list(enumerate(trajectory.paths))):
        _draw_path(canvas, path, trajectory.fps, PUSHED if number else PATH, thin)
    if mask is not None and (seen := shrunk(mask)).any():
        _draw_outline(canvas, seen, OUTLINE, thin)
    else:
        _rectangle(canvas, grounding.bbox, OUTLINE, 2 * thin)
    for contact in trajectory.contacts:
        _draw_contact(canvas, contact.point, thin, of_floor=contact.b is None)
    if motion.direction is not None:
        start = np.array(grounding.point)
        tip = start + np.array(motion.direction) * 0.14 * max(canvas.shape[:2])
        for colour, width in ((DARK, 4 * thin), (ARROW, 2 * thin)):
            cv2.arrowedLine(canvas, _fixed(start), _fixed(tip), colour, width, cv2.LINE_AA, SUBPIXEL, 0.28)
    _dot(canvas, grounding.point, unit, LIGHT)
    points = [grounding.point, *(contact.point for contact in trajectory.contacts)]
    for path in trajectory.paths:
        points += [point for point, visible in zip(path.points, path.visible, strict=True) if visible]
    draw_labels(canvas, _labels(grounding, trajectory, removed, placed), unit, DARK, points)
    return canvas


def _labels(
    grounding: Grounding, trajectory: Trajectory, removed: Sequence[Removed], placed: Sequence[Replaced]
) -> list[Label]:
    labels = [Label(grounding.object, grounding.bbox, OUTLINE, below=False)]
    for encounter in trajectory.encounters:  # as in: hits white cube 1.1 s, 93%
        sure = "" if encounter.probability is None else f", {round(100 * encounter.probability)}%"
        time = encounter.first_frame / trajectory.fps if encounter.time is None else encounter.time
        text = f"{MEETINGS[encounter.kind]} {encounter.object} {time:.1f} s{sure}"
        labels.append(Label(text, encounter.bbox, ENCOUNTERS[encounter.kind], below=True))
    labels += [Label(f"{name}, taken away", bbox, REMOVED, below=False) for name, bbox, _ in removed]
    labels += [Label(f"{each.name}, as it is", each.old_bbox, PLACED, below=False) for each in placed]
    return labels + [Label(f"{each.name}, put {each.place}", each.bbox, PLACED, below=False) for each in placed]


def _draw_removed(canvas: Image, mask: Mask, colour: Colour, thin: int) -> None:
    """Hatches a mask, with a dashed outline."""
    if not mask.any():
        return
    rows, columns = np.indices(mask.shape, np.int32)
    lines = mask & ((rows + columns) % (HATCH * thin) < thin)
    canvas[lines] = colour
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    edge = np.zeros(mask.shape, np.uint8)
    cv2.drawContours(edge, outlines, -1, 1, 2 * thin, cv2.LINE_8)
    dashed = (edge > 0) & ((rows // (DASH * thin) + columns // (DASH * thin)) % 2 == 0)
    canvas[edge > 0] = DARK
    canvas[dashed] = colour


def _draw_band(canvas: Image, path: Path, colour: Colour, thin: int) -> None:
    """The boxes between the 10th and 90th percentile, joined along the path until it rests, with a line around them.

    Translucent, and the more so the wider a box is: where worlds have gone different ways it covers much of the image,
    which must still be seen, and says little.
    """
    if not path.band:
        return
    height, width = canvas.shape[:2]
    steps = np.linalg.norm(np.diff(np.array(path.points), axis=0), axis=1)
    moving = int(np.flatnonzero(steps > AT_REST).max(initial=-1)) + 2
    boxes = np.clip(np.array(path.band[:moving], np.float64), -FARTHEST, FARTHEST)
    corners = boxes[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 4, 2)
    hulls: list[tuple[int, NDArray[np.int32]]] = []
    for before, after, seen in zip(corners, corners[1:], path.visible[1:], strict=False):
        if seen:
            hull = cv2.convexHull(np.concatenate([before, after]).astype(np.float32))
            share = cv2.contourArea(hull) / (height * width)
            opacity = max(WIDE_BAND_OPACITY, BAND_OPACITY * min(1.0, NARROW_BAND / max(share, 1e-9)))
            hulls.append((round(255 * opacity), np.rint(hull).astype(np.int32)))
    opacities = np.zeros((height, width), np.uint8)  # 255: opaque
    for opacity, hull in sorted(hulls, key=lambda each: each[0]):
        cv2.fillConvexPoly(opacities, hull, opacity)
    outlines, _ = cv2.findContours(opacities, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(opacities, outlines, -1, round(255 * BAND_EDGE_OPACITY), thin)
    rows, columns = (np.nonzero(opacities.any(axis=axis))[0] for axis in (1, 0))
    if len(rows):
        window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        part = canvas[window]
        part[:] = part + opacities[window][..., None] / np.float32(255) * (np.array(colour, np.float32) - part)


def _draw_path(canvas: Image, path: Path, fps: float, colour: Colour, thin: int) -> None:
    """The path as far as it is visible, with a dot every half second."""
    runs = groupby(zip(path.points, path.visible, strict=True), key=itemgetter(1))
    lines = [np.array([[_fixed(point)] for point, _ in run], np.int32) for visible, run in runs if visible]
    for shade, width in ((DARK, 3 * thin), (colour, thin)):
        cv2.polylines(canvas, lines, False, shade, width, cv2.LINE_AA, SUBPIXEL)
    step = max(1, round(fps / 2))
    for index in range(step, len(path.points), step):
        if path.visible[index]:
            _dot(canvas, path.points[index], 0.85 * thin, colour)


def _draw_outline(canvas: Image, mask: Mask, colour: Colour, thin: int) -> None:
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for shade, width in ((DARK, 3 * thin), (colour, thin + (thin + 1) // 2)):
        cv2.drawContours(canvas, outlines, -1, shade, width, cv2.LINE_AA)


def _draw_contact(canvas: Image, point: Sequence[float], thin: int, *, of_floor: bool) -> None:
    """A triangle that stands on the floor for a bounce, a ring with a cross for a meeting."""
    size = 5.5 * thin
    x, y = point
    if of_floor:
        corners = [_fixed((x, y)), _fixed((x - 0.8 * size, y + 1.4 * size)), _fixed((x + 0.8 * size, y + 1.4 * size))]
        line = np.array(corners, np.int32).reshape(-1, 1, 2)
        cv2.fillPoly(canvas, [line], LIGHT, cv2.LINE_AA, SUBPIXEL)
        cv2.polylines(canvas, [line], True, DARK, thin, cv2.LINE_AA, SUBPIXEL)
        return
    colour = ENCOUNTERS["touches"]
    for shade, width in ((DARK, 4 * thin), (colour, 2 * thin)):
        cv2.circle(canvas, _fixed(point), round(size * 2**SUBPIXEL), shade, width, cv2.LINE_AA, SUBPIXEL)
    for sign in (-1, 1):
        reach = 0.5 * size
        ends = _fixed((x - reach, y - sign * reach)), _fixed((x + reach, y + sign * reach))
        cv2.line(canvas, *ends, LIGHT, thin, cv2.LINE_AA, SUBPIXEL)


def _dot(canvas: Image, point: Sequence[float], unit: float, colour: Colour) -> None:
    for radius, shade in ((4.0, DARK), (3.0, colour)):
        cv2.circle(canvas, _fixed(point), round(radius * unit * 2**SUBPIXEL), shade, -1, cv2.LINE_AA, SUBPIXEL)


def _rectangle(canvas: Image, bbox: BBox, colour: Colour, width: int) -> None:
    corners = _fixed(bbox[:2]), _fixed(bbox[2:])
    cv2.rectangle(canvas, *corners, DARK, width + 2, cv2.LINE_AA, SUBPIXEL)
    cv2.rectangle(canvas, *corners, colour, width, cv2.LINE_AA, SUBPIXEL)


def _fixed(point: Sequence[float] | NDArray[np.float64]) -> tuple[int, int]:
    """Fixed-point pixel centres, bounded so that far points stay drawable."""
    x, y = (min(max(float(v), -FARTHEST), FARTHEST) for v in point[:2])
    return round((x - 0.5) * 2**SUBPIXEL), round((y - 0.5) * 2**SUBPIXEL)


PER_ROW = 3  # frames
GAP = 6  # px between frames
BAR = 26  # px above the frames for the name, in a picture whose unit is 1


def named_strip(frames: Sequence[Image], name: str) -> Image:
    """Frames [h, w, 3] of one size in their order, in rows from left to right, below a name."""
    height, width = frames[0].shape[:2]
    unit = max(1.0, max(height, width) / 640)
    sheet, bar = tiled(frames, PER_ROW, GAP, DARK[0]), round(BAR * unit)
    strip = np.concatenate([np.full((bar, *sheet.shape[1:]), DARK[0], np.uint8), sheet])
    draw_labels(strip, [Label(name, (0.0, bar, sheet.shape[1], bar), LIGHT, below=False)], unit, DARK)
    return strip
