"""How fast and how far a motion goes, in pixels and seconds: what a reader or a request says, or what is assumed."""

from __future__ import annotations

import math
from dataclasses import dataclass

from cow_service.physics.dynamics import DEFAULT_SPEED, GRAVITY
from cow_service.readers.base import Quantity, SpeedWord
from cow_service.records import DIRECTED_KINDS, BBox, Law, MetresPerPixel, MotionKind

THROW_SPEED, THROW_RADIUS = 1.8, 0.15  # m/s, m: of a toy that is thrown, where no speed is given
SPEED_DEVIATIONS: dict[MotionKind, float] = {"linear": 0.25, "projectile": 0.28}  # of the logarithm of a default speed
SPEED_FACTORS: dict[SpeedWord, float] = {"slow": 0.5, "normal": 1.0, "fast": 2.0}  # of the default speed
SCALE_DEVIATION = 0.25  # of the logarithm of metres per pixel, where nobody gave them


@dataclass(frozen=True)
class Measures:
    """What turns numbers with units into pixels."""

    image_width: int  # px
    scale: MetresPerPixel
    law: Law

    def pixels(self, quantity: Quantity) -> float:
        """px, or px/s."""
        match quantity.unit:
            case "px" | "px/s":
                return quantity.value
            case "m" | "m/s":
                return quantity.value / self.scale.value
            case "widths" | "widths/s":
                return quantity.value * self.image_width

    def speed(self, kind: MotionKind, bbox: BBox, said: SpeedWord | Quantity | None) -> float:
        """px/s of an object in a box; 0 for kinds of motion that have no speed."""
        if kind not in DIRECTED_KINDS:
            return 0.0
        if isinstance(said, Quantity):
            return self.pixels(said)
        thrown = kind == "projectile" and self.law == "contact"
        usual = throw_speed(bbox, self.scale) if thrown else DEFAULT_SPEED * self.image_width
        return usual if said is None else SPEED_FACTORS[said] * usual

    def speed_deviation(self, kind: MotionKind, said: SpeedWord | Quantity | None) -> float:
        """Of the speed's natural logarithm: 0 for a number in pixels, else that of what is assumed."""
        if not isinstance(said, Quantity):
            return SPEED_DEVIATIONS.get(kind, 0.0)
        assumed = said.unit == "m/s" and self.scale.source == "default"
        return SCALE_DEVIATION if assumed else 0.0


def throw_speed(bbox: BBox, scale: MetresPerPixel) -> float:
    """px/s of a throw whose speed nobody gave: v^2 / (g R) as of a toy of radius 0.15 m thrown at 1.8 m/s.

    How far it gets in the image, in its own radii, does then not depend on the scale, which is uncertain.
    """
    x0, y0, x1, y1 = bbox
    radius = (x1 - x0 + y1 - y0) / 4  # px
    return math.sqrt(THROW_SPEED**2 / (GRAVITY * THROW_RADIUS) * (GRAVITY / scale.value) * radius)
