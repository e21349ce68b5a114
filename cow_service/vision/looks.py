"""How circles of an image look inside and about them, and whether they may be one ball, more or less opaque."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.vision.circles import BINS, Circle
from cow_service.vision.types import Floats, Image, Mask

LOOKS, LEAST_CONTRAST = 0.3, 12.0  # difference of the looks over the contrast, at most; grey levels of that contrast
LEAST_OPACITY = 0.08
MOST_UNREST = 12.0  # grey levels of a background's variation that are allowed for
# Radii: offsets from the centre at which looks are compared.
OFFSETS = np.array([(r * math.cos(t), r * math.sin(t)) for r in (0.25, 0.5, 0.7, 0.85)
                    for t in np.linspace(0, 2 * math.pi, 24, endpoint=False)])  # fmt: skip


@dataclass(frozen=True, eq=False)
class Looks:
    """How circles of an RGB image [H, W, 3] look inside and about them, in grey levels."""

    image: Image

    def contrast(self, circle: Circle) -> float:
        """Lower quartile of the steps from inside to outside over the edges on a circle."""
        turns = (np.array(sorted(circle.on_edges)) + 0.5) * 2 * math.pi / BINS
        rim = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        inside, outside = (self._at(circle, factor * rim) for factor in (0.85, 1.15))
        return float(np.percentile(np.linalg.norm(inside - outside, axis=1), 25))

    def alike(self, chain: Sequence[Circle]) -> bool:
        """Whether all look like the first or the last, faded or not."""
        return self.opacities(chain) is not None

    def opacities(self, chain: Sequence[Circle], compared: bool = True) -> Floats | None:
        """Opacity [N] of each circle against one that is the most opaque; None where they do not look alike.

        Without `compared` they are known to.
        """
        rings = [self._ring(i, chain) for i in range(len(chain))]
        about = [np.median(ring, axis=0) for ring in rings]
        unrest = [float(np.median(np.linalg.norm(r - a, axis=1))) for r, a in zip(rings, about, strict=True)]
        inner = [self._at(circle, OFFSETS) for circle in chain]
        free = [self._free(i, chain) for i in range(len(chain))]
        strength = [float(np.abs(v[f] - b).mean()) if f.any() else 0.0
                    for v, b, f in zip(inner, about, free, strict=True)]  # fmt: skip
        model = max((0, len(chain) - 1), key=lambda i: strength[i])
        shares: list[float] = []
        for i in range(len(chain)):
            both = free[i] & free[model]
            if np.count_nonzero(both) < 6:
                both = free[i] | free[model]
            seen, wanted = inner[i][both], inner[model][both]
            share = _opacity(seen - about[i], wanted - about[model], seen - wanted, unrest[i] if compared else math.inf)
            if share is None:
                return None
            shares.append(share)
        return np.array(shares)

    def _at(self, circle: Circle, offsets: Floats) -> Floats:
        """Colours [N, 3] at offsets [N, 2] (radii) from a circle's centre."""
        xs = np.clip(circle.x + circle.radius * offsets[:, 0], 0, self.image.shape[1] - 1).astype(int)
        ys = np.clip(circle.y + circle.radius * offsets[:, 1], 0, self.image.shape[0] - 1).astype(int)
        return self.image[ys, xs].astype(np.float64)

    def _free(self, i: int, chain: Sequence[Circle]) -> Mask:
        """Which of `OFFSETS` of a circle lie in no other."""
        circle = chain[i]
        points = np.array([circle.x, circle.y]) + circle.radius * OFFSETS
        return ~inside_any(points, [other for j, other in enumerate(chain) if j != i], 1.05)

    def _ring(self, i: int, chain: Sequence[Circle]) -> Floats:
        """Colours [N, 3] around a circle, others left out."""
        circle = chain[i]
        turns = np.linspace(0, 2 * math.pi, 48, endpoint=False)
        ring = np.concatenate([f * np.stack([np.cos(turns), np.sin(turns)], axis=1) for f in (1.15, 1.3)])
        points = np.array([circle.x, circle.y]) + circle.radius * ring
        free = ~inside_any(points, [other for j, other in enumerate(chain) if j != i], 1.1)
        return self._at(circle, ring[free] if free.sum() > 8 else ring)


def _opacity(seen: Floats, model: Floats, plain: Floats, unrest: float) -> float | None:
    """The share of a model's contrast [N, 3] that is seen [N, 3]; None where what is seen is no share of it.

    `plain` [N, 3] are the differences of the colours themselves, which do not depend on the background; `unrest`
    is how much that varies (grey levels), infinite where they are known to be alike.
    """
    contrast = float(np.median(np.linalg.norm(model, axis=1)))
    if contrast < LEAST_CONTRAST:
        return None
    if float(np.median(np.linalg.norm(plain, axis=1))) < LOOKS * contrast / 2:
        return 1.0
    share = float((seen * model).sum() / (model**2).sum())
    rest = float(np.median(np.linalg.norm(seen - share * model, axis=1)))
    if math.isinf(unrest):
        return min(max(share, LEAST_OPACITY), 1.0)
    allowed = min(unrest, MOST_UNREST)
    if not LEAST_OPACITY < share < 1.15 or rest > LOOKS * contrast * share + allowed:
        return None
    return min(share, 1.0)


def inside_any(points: Floats, circles: Sequence[Circle], factor: float) -> Mask:
    """Which points [N, 2] (px) lie inside any of circles, their radii multiplied."""
    inside = np.zeros(len(points), bool)
    for circle in circles:
        inside |= np.hypot(points[:, 0] - circle.x, points[:, 1] - circle.y) < factor * circle.radius
    return inside
