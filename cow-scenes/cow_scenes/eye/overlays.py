"""What is drawn over a picture and stands in no room: arrows, boxes, lines, words, trails of a moving thing."""

import itertools

import cv2
import numpy as np

from .meshes import Random
from .textures import colour

MARKERS = ((230, 40, 40), (60, 200, 60), (30, 120, 230), (0, 0, 0), (255, 255, 255), (250, 220, 0))
SUBPIXELS = 3
"""Bits of a pixel's fraction in which OpenCV takes coordinates."""


def fixed(point: np.ndarray) -> tuple[int, int]:
    """A point in the units of OpenCV's drawing."""
    x, y = np.round(point * 2**SUBPIXELS).astype(int).tolist()
    return x, y


class Sheet:
    """A picture (h, w, 3) uint8 that is drawn on; `mask` (h, w) bool says where."""

    def __init__(self, picture: np.ndarray) -> None:
        self.picture = np.ascontiguousarray(picture)
        self.ink = np.zeros(picture.shape[:2], np.uint8)

    @property
    def mask(self) -> np.ndarray:
        """Where at least a third of a pixel is covered."""
        return self.ink > 85

    def stroke(self, ends: list[np.ndarray], ink: tuple, thick: int) -> None:
        """A line from point to point."""
        for start, end in itertools.pairwise(ends):
            cv2.line(self.picture, fixed(start), fixed(end), ink, thick, cv2.LINE_AA, SUBPIXELS)
            cv2.line(self.ink, fixed(start), fixed(end), 255, thick, cv2.LINE_AA, SUBPIXELS)

    def area(self, corners: np.ndarray, ink: tuple) -> None:
        """A filled polygon."""
        points = [np.array([fixed(c) for c in corners], np.int32)]
        cv2.fillPoly(self.picture, points, ink, cv2.LINE_AA, SUBPIXELS)
        cv2.fillPoly(self.ink, points, 255, cv2.LINE_AA, SUBPIXELS)

    def write(self, word: str, at: tuple[int, int], font: int, scale: float, ink: tuple, thick: int) -> None:
        """A word whose left lower corner is at a pixel."""
        cv2.putText(self.picture, word, at, font, scale, ink, thick, cv2.LINE_AA)
        cv2.putText(self.ink, word, at, font, scale, 255, thick, cv2.LINE_AA)

    def ghost(self, region: np.ndarray, shift: tuple[int, int], strength: float) -> None:
        """A faint copy of what a region (h, w) bool shows, moved by pixels (right, down)."""
        matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]], np.float32)
        size = region.shape[::-1]
        share = cv2.warpAffine(region.astype(np.float32) * strength, matrix, size)[..., None]
        copy = cv2.warpAffine(self.picture, matrix, size)
        self.picture = (self.picture * (1 - share) + copy * share).astype(np.uint8)
        self.ink = np.maximum(self.ink, np.where(share[..., 0] > 0.05, 255, 0).astype(np.uint8))


def ink_of(random: Random) -> tuple:
    """A marker's colour, or any."""
    return MARKERS[random.integers(len(MARKERS))] if random.random() < 0.65 else tuple(colour(random).tolist())


def draw_arrow(sheet: Sheet, start: np.ndarray, random: Random) -> None:
    """An arrow with an open, filled, outlined or double head, straight or a little bent."""
    ink, thick, kind = ink_of(random), int(random.integers(1, 8)), random.integers(4)
    angle, length = random.uniform(0, 2 * np.pi), random.uniform(30, 190)
    along = np.array([np.cos(angle), np.sin(angle)])
    across, head = np.array([-along[1], along[0]]), 5 + random.uniform(1.5, 3.5) * thick
    end = start + along * length
    bend = across * length * (random.normal(0, 0.1) if random.random() < 0.15 else 0)
    t = np.linspace(0, 1, 10)[:, None]
    path = list(start + (end - along * head * 0.7 - start) * t + 4 * bend * t * (1 - t))
    wings = [end - along * head + across * head * s for s in (0.55, -0.55)]
    passes = [(ink, 0)] if kind != 2 else [(ink_of(random), 3), (ink, 0)]
    for paint, extra in passes:
        sheet.stroke(path, paint, thick + extra)
        if kind == 0:
            sheet.stroke([wings[0], end, wings[1]], paint, thick + extra)
        else:
            grown = np.array([end, *wings]) + np.array([along, across - along, -across - along]) * extra
            sheet.area(grown, paint)
    if kind == 3:
        sheet.area(np.array([start - along * head * 0.3, *(w - along * (length - 1.7 * head) for w in wings)]), ink)


def draw_mark(sheet: Sheet, at: np.ndarray, random: Random) -> None:
    """A box, a word, a circle or a line."""
    ink, thick, kind = ink_of(random), int(random.integers(1, 5)), random.integers(4)
    size = random.uniform(10, 70, 2)
    if kind == 0:
        (x0, y0), (x1, y1) = at - size, at + size
        sheet.stroke([np.array(p) for p in ((x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0))], ink, thick)
    elif kind == 1:
        word = "".join(chr(c) for c in random.integers(48, 123, int(random.integers(1, 8))))
        sheet.write(
            word,
            fixed(at / 2**SUBPIXELS),
            int(random.integers(0, 5)),
            random.uniform(0.4, 1.4),
            ink,
            max(1, thick // 2),
        )
    elif kind == 2:
        angle = np.linspace(0, 2 * np.pi, 40)
        sheet.stroke(list(at + np.c_[np.cos(angle) * size[0], np.sin(angle) * size[1]]), ink, thick)
    else:
        sheet.stroke([at, at + random.normal(0, 90, 2)], ink, thick)


def draw_trail(sheet: Sheet, region: np.ndarray, random: Random) -> None:
    """Earlier places of a thing on a curve: ghosts of it, or dots joined by a line."""
    step, pull = random.normal(0, 1, 2), random.uniform(-3, 6)
    step *= random.uniform(16, 70) / (np.linalg.norm(step) + 1e-6)
    count = int(random.integers(1, 5))
    shifts = [step * k + np.array([0, pull * k * k]) for k in range(1, count + 1)]
    if random.random() < 0.65:
        strength = random.uniform(0.15, 0.6)
        for k, shift in enumerate(shifts):
            sheet.ghost(region, (int(shift[0]), int(shift[1])), strength * 0.8**k)
        if random.random() < 0.6:
            return
    middle, ink = np.argwhere(region).mean(0)[::-1], ink_of(random)
    sheet.stroke([middle + s for s in shifts], ink, int(random.integers(1, 4)))
    radius = random.uniform(2, 7)
    angle = np.linspace(0, 2 * np.pi, 16)
    for shift in shifts if random.random() < 0.6 else []:
        sheet.area(middle + shift + radius * np.c_[np.cos(angle), np.sin(angle)], ink)


def draw_over(picture: np.ndarray, regions: list[np.ndarray], random: Random) -> tuple[np.ndarray, np.ndarray]:
    """The picture with something drawn over it in half of the cases, and where; `regions` are masks of things."""
    sheet = Sheet(picture)
    if random.random() < 0.5:
        return sheet.picture, sheet.mask
    if regions and random.random() < 0.2:
        draw_trail(sheet, regions[random.integers(len(regions))], random)
    for _ in range(int(random.choice((0, 1, 1, 1, 2, 3)))):
        if regions and random.random() < 0.75:
            at = np.argwhere(regions[random.integers(len(regions))]).mean(0)[::-1] + random.normal(0, 25, 2)
        else:
            at = random.uniform(0, 1, 2) * picture.shape[1::-1]
        (draw_arrow if random.random() < 0.75 else draw_mark)(sheet, at, random)
    return sheet.picture, sheet.mask
