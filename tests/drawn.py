"""Draws arrows, boxes and simple scenes for tests, with known truth."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


def floor(width: int = 640, height: int = 400, grey: int = 150, seed: int = 0) -> Image:
    """A plain floor with a little texture and a soft gradient, RGB."""
    rng = np.random.default_rng(seed)
    noise = cv2.GaussianBlur(rng.normal(0, 6, (height, width)).astype(np.float32), (0, 0), 1.2)
    ramp = np.linspace(-10, 10, width, dtype=np.float32)[None]
    value = np.clip(grey + noise + ramp, 0, 255)
    return np.repeat(value[..., None], 3, axis=2).astype(np.uint8)


def clutter(width: int, height: int, seed: int = 0) -> Image:
    """Coloured texture full of edges, as a photograph of a workshop has it: its objects cannot be told apart."""
    rng = np.random.default_rng(seed)
    patches = cv2.resize(rng.integers(30, 220, (15, 20, 3), np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)
    image = np.clip(patches + rng.normal(0, 25, (height, width, 3)), 0, 255).astype(np.uint8)
    for _ in range(60):
        middle, axes = rng.integers(0, (width, height)).tolist(), rng.integers(5, 70, 2).tolist()
        colour, thickness = rng.integers(0, 255, 3).tolist(), int(rng.choice([cv2.FILLED, 2, 3]))
        cv2.ellipse(image, middle, axes, float(rng.uniform(0, 180)), 0, 360, colour, thickness)
    return image


def ball(image: Image, centre: tuple[float, float], radius: float, rgb: tuple[int, int, int]) -> Image:
    """A shaded ball."""
    ys, xs = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    dx, dy = (xs - centre[0]) / radius, (ys - centre[1]) / radius
    inside = dx * dx + dy * dy <= 1
    light = np.clip(1.05 - 0.35 * (dx + dy + 1) / 2, 0.5, 1.1)[..., None]
    shaded = np.clip(np.array(rgb) * light, 0, 255)
    return np.where(inside[..., None], shaded, image).astype(np.uint8)


def block(image: Image, bbox: tuple[int, int, int, int], rgb: tuple[int, int, int]) -> Image:
    """A cube seen from the front: a lit top and a darker face."""
    x0, y0, x1, y1 = bbox
    edge = y0 + (y1 - y0) // 4
    result = image.copy()
    result[y0:edge, x0:x1] = np.clip(np.array(rgb) * 1.1, 0, 255)
    result[edge:y1, x0:x1] = np.clip(np.array(rgb) * 0.8, 0, 255)
    return result


def bowl(
    image: Image, middle: tuple[float, float], half: float, height: float, rgb: tuple[int, int, int], base: float = 0.5
) -> Image:
    """A round open bowl seen from above at 30 degrees: `middle` is that of its rim, `base` its floor's share of it."""
    x, y = middle
    tall = half / 2
    result = np.ascontiguousarray(image).copy()
    angles = np.linspace(0, 2 * np.pi, 80)
    foot = np.stack([x + base * half * np.cos(angles), y + height + base * tall * np.sin(angles)], axis=1)
    rim = np.stack([x + half * np.cos(angles), y + tall * np.sin(angles)], axis=1)
    outer = cv2.convexHull(np.concatenate([foot, rim]).astype(np.float32)).round().astype(np.int32)
    cv2.fillConvexPoly(result, outer, tuple(int(0.75 * part) for part in rgb), cv2.LINE_AA)
    for share, light in ((1.0, 1.15), (0.9, 0.5)):
        shown = tuple(int(min(255, light * part)) for part in rgb)
        axes = (round(share * half), round(share * tall))
        cv2.ellipse(result, (round(x), round(y)), axes, 0, 0, 360, shown, -1, cv2.LINE_AA)
    return result


@dataclass(frozen=True)
class DrawnArrow:
    tail: tuple[float, float]
    angle: float  # radians
    length: float
    thickness: int
    rgb: tuple[int, int, int]
    style: str  # open, filled or outlined

    @property
    def direction(self) -> tuple[float, float]:
        return float(np.cos(self.angle)), float(np.sin(self.angle))

    @property
    def tip(self) -> tuple[float, float]:
        dx, dy = self.direction
        return self.tail[0] + dx * self.length, self.tail[1] + dy * self.length

    def on(self, image: Image) -> Image:
        """The image with the arrow drawn over it."""
        result = np.ascontiguousarray(image).copy()
        if self.style == "outlined":
            self._paint(result, (255, 255, 255), 4)
        self._paint(result, self.rgb, 0)
        return result

    def _paint(self, image: Image, rgb: tuple[int, int, int], grow: int) -> None:
        along = np.array(self.direction)
        across = np.array([-along[1], along[0]])
        tail, tip = np.array(self.tail), np.array(self.tip)
        head = max(3.2 * self.thickness, 14.0)
        if self.style == "open":
            cv2.arrowedLine(
                image, _whole(tail), _whole(tip), rgb, self.thickness, cv2.LINE_AA, tipLength=head / self.length
            )
            return
        base = tip - along * head
        cv2.line(image, _whole(tail), _whole(base), rgb, self.thickness + grow, cv2.LINE_AA)
        corners = np.array([tip, base + across * head * 0.56, base - across * head * 0.56]).round().astype(np.int32)
        if grow:
            cv2.polylines(image, [corners], True, rgb, grow, cv2.LINE_AA)
        cv2.fillPoly(image, [corners], rgb, cv2.LINE_AA)


def jpeg(image: Image, quality: int = 90) -> Image:
    """The image after JPEG compression."""
    return np.ascontiguousarray(cv2.imdecode(encoded(image, ".jpg", quality), cv2.IMREAD_COLOR)[..., ::-1])


def png_bytes(image: Image) -> bytes:
    return encoded(image, ".png").tobytes()


def encoded(image: Image, extension: str, quality: int = 90) -> Image:
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality] if extension == ".jpg" else []
    return cv2.imencode(extension, np.ascontiguousarray(image[..., ::-1]), parameters)[1]


def angle_between(a: tuple[float, float], b: tuple[float, float]) -> float:
    """Degrees."""
    return float(abs(np.degrees(np.arctan2(a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]))))


def _whole(point: NDArray[np.float64]) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))


def thrown_past(
    start: tuple[float, float], velocity: tuple[float, float], gravity: float, count: int, step: float = 1.0
) -> list[tuple[float, float]]:
    """Places of a ball at equal times up to the present, the oldest first: where it is now comes last."""
    times = [step * (i - count + 1) for i in range(count)]
    return [(start[0] + velocity[0] * t, start[1] + velocity[1] * t + gravity * t * t / 2) for t in times]


def trail(
    image: Image,
    places: list[tuple[float, float]],
    radii: list[float],
    rgb: tuple[int, int, int],
    opacities: list[float],
) -> Image:
    """A ball at places, the last on top, each so opaque over the image (1: as a multiple exposure shows it)."""
    result = image
    for place, radius, opacity in zip(places, radii, opacities, strict=True):
        solid = ball(result, place, radius, rgb)
        result = np.round(opacity * solid.astype(float) + (1 - opacity) * result).astype(np.uint8)
    return result
