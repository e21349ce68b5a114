"""What perception measures for physics: shadows, openings of containers, and positions of one ball."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cow_service.media.types import Mask
from cow_service.records import BBox, Point


@dataclass(frozen=True)
class Shadow:
    """A shadow on the floor as an ellipse of the image. It does not say where the light is."""

    bbox: BBox  # [x0, y0, x1, y1], px
    centre: tuple[float, float]  # px
    spread: tuple[float, float, float]  # px^2: a quarter of the squared half width and height, and the covariance
    shade: float  # 0..1: how much of the floor's lightness it takes away


Rim = tuple[float, float, float, float]  # an ellipse: x, y, half width, half height, px


@dataclass(frozen=True)
class SeenOpening:
    """The opening of a container, in shares of half its width."""

    inner: float  # half the width of the opening
    deviation: float  # one standard deviation of its logarithm
    bottom: float  # half the outer width at its lower end
    square: bool = False  # four walls, not a round one
    rim: Rim | None = None  # its ellipse
    foot_hidden: bool = False  # something stands before its lower end: it is higher than it is seen


@dataclass(frozen=True)
class Position:
    """A ball where it was, or is."""

    x: float  # px
    y: float
    radius: float  # px
    opacity: float  # 0..1, against the most opaque position of its trail

    @property
    def centre(self) -> Point:
        """px."""
        return self.x, self.y

    @property
    def bbox(self) -> BBox:
        """[x0, y0, x1, y1], px."""
        return self.x - self.radius, self.y - self.radius, self.x + self.radius, self.y + self.radius

    def disc(self, shape: tuple[int, int], grown: float = 0.0) -> Mask:
        """Mask [H, W], its radius larger by a number of px."""
        ys, xs = np.ogrid[: shape[0], : shape[1]]
        return np.hypot(xs + 0.5 - self.x, ys + 0.5 - self.y) <= self.radius + grown
