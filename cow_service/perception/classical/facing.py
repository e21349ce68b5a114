"""Which way a vehicle faces: the turn of a model car that shows paint, tyres, glass and lamps where the image does."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cow_service.media.masks import bbox_of, eroded, lab_of, mask_iou, resized_mask, scaled, without_holes
from cow_service.media.types import Floats, Floats32, Image, Mask
from cow_service.physics.camera import FOCAL_WIDTHS, FloorCamera
from cow_service.records import BBox, Vector

PAINT, DARK, OTHER = 1, 2, 3  # labels of pixels, 0 beside it: the body's colour, tyres, and glass and lamps
Labels = NDArray[np.uint8]

_SUBPIXEL_BITS = 4  # of the coordinates that OpenCV draws
_FOOT = 0.65  # of the box's height: where the middle of its foot is taken to be
_FITS = 2  # rounds in which the model's size is fitted to the box


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Floats:
    """Corners [8, 3]."""
    return np.array([[(low, high)[i >> axis & 1][axis] for axis in range(3)] for i in range(8)], np.float64)


def _wheel(x: float, y: float) -> Floats:
    """Both rims [24, 3] of a wheel that stands on the floor."""
    turns, radius = np.linspace(0, 2 * np.pi, 12, endpoint=False), 0.078
    rim = np.column_stack([x + radius * np.cos(turns), np.full(12, y), radius + radius * np.sin(turns)])
    return np.concatenate([rim + np.array([0.0, side, 0.0]) for side in (-0.03, 0.03)])


_BODY = _box((-0.29, -0.15, 0.05), (0.29, 0.15, 0.20))
_CABIN = _box((-0.21, -0.13, 0.20), (0.10, 0.13, 0.34))
_WHEELS = {side: tuple(_wheel(x, 0.14 * side) for x in (-0.17, 0.17)) for side in (-1, 1)}
_WINDSCREEN = _box((0.10, -0.115, 0.215), (0.10, 0.115, 0.32))
_WINDOWS = {side: _box((-0.17, 0.13 * side, 0.225), (0.06, 0.13 * side, 0.315)) for side in (-1, 1)}
_LAMPS = tuple(_box((0.29, y - 0.03, 0.12), (0.29, y + 0.03, 0.17)) for y in (-0.10, 0.10))
_ALL = np.concatenate([_BODY, _CABIN, *_WHEELS[-1], *_WHEELS[1]])
_AXIS = np.array([[-0.05, 0.0, 0.17], [0.05, 0.0, 0.17]])  # about its middle


@dataclass(frozen=True)
class VehicleModel:
    """The car before a camera: it stands at a floor point (m), is as large as the box it is fitted to, and turned."""

    camera: FloorCamera
    foot: Floats  # [3] right, up and ahead
    yaw: float  # radians from right towards ahead
    scale: float
    shift: Floats  # [2] px: what centres it in its box

    @staticmethod
    def fitted(camera: FloorCamera, bbox: BBox, yaw: float) -> VehicleModel | None:
        """The car that is turned so and fills a box [x0, y0, x1, y1] (px) best; None if there is no floor."""
        x0, y0, x1, y1 = bbox
        points = camera.floor_points(np.array([[(x0 + x1) / 2, y0 + _FOOT * (y1 - y0)]]))
        if np.isnan(points).any():
            return None
        foot = camera.to_floor(points)[0]
        size = float(np.hypot(foot[0], foot[2])) * (x1 - x0) / camera.focal
        model = VehicleModel(camera, foot, yaw, size, np.zeros(2))
        for _ in range(_FITS):
            low, high = model._extent()
            factor = math.sqrt((x1 - x0) * (y1 - y0) / max(1e-6, float(np.prod(high - low))))
            model = replace(model, scale=model.scale * factor)
        low, high = model._extent()
        return replace(model, shift=np.array([x0 + x1, y0 + y1]) / 2 - (low + high) / 2)

    @property
    def ahead(self) -> Floats:
        """Unit vector [2] (px) in the image of the way that it faces."""
        start, end = self._project(_AXIS)
        return (end - start) / max(1e-9, float(np.linalg.norm(end - start)))

    def drawn(self, corner: tuple[int, int], scale: float, shape: tuple[int, int]) -> Labels:
        """Labels [h, w] of a window of the image from a corner [x, y] (px) on, resized by a scale."""
        labels = np.zeros(shape, np.uint8)
        # Where the camera is in the car's frame: ahead of and to the left of its middle.
        (right, _, depth), cosine, sine = -self.foot, math.cos(self.yaw), math.sin(self.yaw)
        ahead, left = (cosine * right + sine * depth) / self.scale, (cosine * depth - sine * right) / self.scale
        near = 1 if left > 0 else -1
        parts = [(part, DARK) for part in _WHEELS[-near]] + [(_BODY, PAINT)]
        parts += [(part, OTHER) for part in _LAMPS if ahead > _BODY[:, 0].max()]
        parts.append((_CABIN, PAINT))
        if ahead > _CABIN[:, 0].max():
            parts.append((_WINDSCREEN, OTHER))
        parts += [(part, OTHER) for side, part in _WINDOWS.items() if side * left > _CABIN[:, 1].max()]
        parts += [(part, DARK) for part in _WHEELS[near]]
        for part, label in parts:
            points = (self._project(part) - np.array(corner)) * scale * 2**_SUBPIXEL_BITS
            hull = cv2.convexHull(points.astype(np.int32))
            cv2.fillConvexPoly(labels, hull, label, shift=_SUBPIXEL_BITS)
        return labels

    def _extent(self) -> tuple[Floats, Floats]:
        points = self._project(_ALL)
        return points.min(axis=0), points.max(axis=0)

    def _project(self, points: Floats) -> Floats:
        """Image points [N, 2] (px) of points [N, 3] of the car."""
        ahead, left, up = (points * self.scale).T
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        floor = np.column_stack([cosine * ahead - sine * left, up, sine * ahead + cosine * left])
        return self.camera.project(self.camera.from_floor(floor + self.foot)) + self.shift


class FacingRules(NamedTuple):
    """When a vehicle is said to face a way, and what of it is paint, tyre or glass.

    Set by hand on rendered toy cars. As a whole: of 141 scenes with such cars 115 were answered right, 1 wrong. No
    single number has a measurement of its own.
    """

    working_side: int = 80  # px: the vehicle is compared at this size
    elsewhere: float = math.cos(math.radians(72))  # of the angle from which two headings differ
    min_score: float = 1.2  # of 2.2: what fits worse is no such vehicle, or is hidden in part
    min_parts: float = 0.03  # of the outline's area that are tyres, glass or lamps: paint alone tells no front
    min_lead: float = 0.03  # of the best score before that of another heading
    tyres: float = 0.6  # what agreement in tyres counts, against 1 for the outline
    glass: float = 0.6  # the same
    smoothing: float = 0.03  # of the outline's area: parts smaller than this count little
    margin: float = 0.06  # of the box, looked at around it
    margin_below: float = 0.25  # the same below it: tyres may lie lower than what was found by colour
    tyre_lightness: float = 28.0  # Lab, at most
    tyre_chroma: float = 18.0  # Lab, at most
    tyre_share: float = 0.45  # of the floor's lightness, at most
    low_part: float = 0.6  # of the height: below it, what is darker than the paint is shade
    high_part: float = 0.45  # of the height: above it, what is dark is glass and no tyre
    other_step: float = 14.0  # Lab units from the paint's colour
    other_share: float = 0.55  # of the paint's chroma: the same
    slit: int = 5  # px at the working size
    neutral: float = 12.0  # chroma below which paint is recognized only by its lightness
    black: float = 32.0  # lightness below which paint hides the tyres
    tinted: float = 2.5  # Lab units of glass from black paint
    darker: float = 0.55  # of white paint's lightness: glass in it


FACING = FacingRules()


PITCHES = tuple(math.radians(degrees) for degrees in (20, 28, 36))  # cameras that are tried
TURNS = np.radians(np.arange(0, 360, 10))
FINE_TURNS = np.radians(np.arange(-9, 9.1, 1.5))  # about the best of them


@dataclass(frozen=True)
class _Seen:
    """The vehicle as labels [h, w], its box (px of the image), and where the window lies."""

    labels: Labels
    bbox: BBox
    corner: tuple[int, int]
    scale: float


def facing(image: Image, mask: Mask, bbox: BBox) -> Vector | None:
    """The way [x, y] (unit vector, px) that the vehicle under a mask [H, W], in a box of an image, faces.

    None if no way fits clearly better than every other.
    """
    seen = _seen(image, mask, bbox)
    if seen is None or np.isin(seen.labels, (DARK, OTHER)).sum() < FACING.min_parts * (seen.labels > 0).sum():
        return None
    fits = list(_fits(image, seen, PITCHES, TURNS))
    if not fits:
        return None
    score, first = max(fits, key=lambda fit: fit[0])
    rival = max((other for other, model in fits if math.cos(model.yaw - first.yaw) < FACING.elsewhere), default=0.0)
    fine = _fits(image, seen, (first.camera.pitch,), first.yaw + FINE_TURNS)
    score, best = max(((score, first), *fine), key=lambda fit: fit[0])
    if score < FACING.min_score or score - rival < FACING.min_lead:
        return None
    x, y = best.ahead.tolist()
    return x, y


def _fits(image: Image, seen: _Seen, pitches: Iterable[float], turns: Floats) -> Iterable[tuple[float, VehicleModel]]:
    """The models of these cameras and turns with their scores."""
    (height, width), inside = image.shape[:2], seen.labels > 0
    least = FACING.smoothing * float(inside.sum())
    for pitch in pitches:
        camera = FloorCamera(width, height, FOCAL_WIDTHS * width, pitch, 0.0, 1.0)
        for yaw in turns.tolist():
            model = VehicleModel.fitted(camera, seen.bbox, yaw)
            if model is not None:
                # Intersection over union of the outlines, and the weighted agreement of the parts.
                drawn = model.drawn(seen.corner, seen.scale, seen.labels.shape[:2])
                whole = mask_iou(inside, drawn > 0)
                pairs = ((seen.labels == label, drawn == label) for label in (DARK, OTHER))
                # Sørensen-Dice coefficients, smoothed: 1 where both are empty.
                tyres, glass = ((2 * (a & b).sum() + least) / (a.sum() + b.sum() + least) for a, b in pairs)
                yield whole + FACING.tyres * tyres + FACING.glass * glass, model


def _seen(image: Image, mask: Mask, bbox: BBox) -> _Seen | None:
    x0, y0, x1, y1 = bbox
    margin, below = FACING.margin * max(x1 - x0, y1 - y0), FACING.margin_below * (y1 - y0)
    left, top = max(0, int(x0 - margin)), max(0, int(y0 - margin))
    window = slice(top, math.ceil(y1 + below)), slice(left, math.ceil(x1 + margin))
    scale = min(1.0, FACING.working_side / max(mask[window].shape))
    small = scaled(image[window], scale)
    own = resized_mask(np.ascontiguousarray(mask[window]), (small.shape[1], small.shape[0]))
    if not own.any():
        return None
    near = (x0 - left) * scale, (y0 - top) * scale, (x1 - left) * scale, (y1 - top) * scale
    labels = _labels(lab_of(small), own, near)
    x0, y0, x1, y1 = (side / scale for side in bbox_of(labels > 0))
    return _Seen(labels, (left + x0, top + y0, left + x1, top + y1), (left, top), scale)


def _labels(lab: Floats32, own: Mask, near: BBox) -> Labels:
    """Labels [h, w] of a window whose pixels have these Lab colours, for a mask and a box."""
    lightness, chroma = lab[..., 0], np.hypot(lab[..., 1], lab[..., 2])
    inner = eroded(own) if eroded(own).any() else own
    paint, colour = float(np.median(lightness[inner])), np.median(lab[..., 1:][inner], axis=0)
    floor = float(np.median(lightness[~own])) if not own.all() else 100.0
    dark = (
        (lightness < min(FACING.tyre_share * floor, FACING.tyre_lightness))
        & (chroma < FACING.tyre_chroma)
        & (paint > FACING.black)
    )
    # Tyres are what is dark, touches it and lies in the lower half of the box or below.
    x0, y0, x1, y1 = near
    beside = 0.05 * (x1 - x0)
    columns, rows = np.arange(own.shape[1])[None], np.arange(own.shape[0])[:, None]
    tyres = dark & (rows > (y0 + y1) / 2) & (columns > x0 - beside) & (columns < x1 + beside)
    count, parts = cv2.connectedComponents((own | tyres).astype(np.uint8))
    whole = parts == int(np.argmax(np.bincount(parts[own], minlength=count)))
    slits = np.ones((FACING.slit, FACING.slit), np.uint8)  # narrow ones are closed
    filled = without_holes(cv2.morphologyEx(whole.astype(np.uint8), cv2.MORPH_CLOSE, slits) > 0)
    away = np.hypot(*(lab[..., 1:] - colour).transpose(2, 0, 1))
    tint = float(np.hypot(*colour))
    other = away > max(FACING.other_step, FACING.other_share * tint)
    if tint < FACING.neutral:
        other |= away > FACING.tinted if paint < FACING.black else lightness < FACING.darker * paint
    _, top, _, bottom = bbox_of(filled)
    down = (rows - top) / max(1.0, bottom - 1 - top)
    other &= (down <= FACING.low_part) | (lightness > paint)
    labels = np.where(filled, np.uint8(PAINT), np.uint8(0))
    labels[eroded(filled) & other | filled & ~whole] = OTHER
    labels[filled & dark & (down > FACING.high_part)] = DARK
    labels[filled & dark & (down <= FACING.high_part)] = OTHER
    return labels
