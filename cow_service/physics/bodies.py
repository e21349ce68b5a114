"""What is known of the bodies of a scene before they are placed: boxes, shapes, and what stands on what."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cow_service.records import BBox, ObjectPrior, Shape, Source
from cow_service.vision.masks import CroppedMask

ON_TOP = 0.72  # of a support's height in the image, from its upper edge: a foot below that stands before it
SHOWN = 0.1  # of a body's width: so much of its support's top is seen beside it, above its foot
BESIDE = 3.0  # px beside a body's box where the support's upper edge is looked for
ENDS = 0.2  # of the height, at the upper and at the lower end, where a vessel has no handle
HANDLE, BARE = 0.12, 0.05  # of the width: so far a handle reaches at least, and the other side at most
WIDER = 1.15  # a support is so much wider than what stands on it
LEAST_OVERLAP = 0.1  # of the narrower box: with less of it above the other, it is seen beside that


@dataclass(frozen=True)
class SeenBody:
    """An object of the image."""

    name: str
    bbox: BBox
    mask: CroppedMask
    shape: Shape
    source: Source = "embedded"
    confidence: float = 1.0
    prior: ObjectPrior | None = None
    elongated: bool = False  # a vehicle: longer along its heading than across
    equal_sided: bool = False  # a cube: as wide as high
    taper: float = 1.0  # its width at its lower end, of that at its upper end

    @property
    def foot(self) -> tuple[float, float]:
        """Where it stands, px: the middle of its box's lower edge."""
        return (self.bbox[0] + self.bbox[2]) / 2, self.bbox[3]

    @cached_property
    def core(self) -> BBox:
        """Its box without a handle: without what reaches far out on one side alone, between its ends."""
        x0, y0, x1, y1 = self.bbox
        rows, columns = np.nonzero(self.mask.patch)
        if self.shape != "cylinder" or not len(rows):
            return self.bbox
        height, width = int(rows.max()) + 1, int(columns.max()) + 1
        ends = columns[(rows < ENDS * height) | (rows >= (1 - ENDS) * height)]
        left, right = int(ends.min()) - int(columns.min()), width - 1 - int(ends.max())
        if max(left, right) < HANDLE * width or min(left, right) > BARE * width:
            return self.bbox
        return (x0 + left, y0, x1, y1) if left > right else (x0, y0, x1 - right, y1)

    @cached_property
    def fullness(self) -> float:
        """Volume of the body that its outline would turn to about its axis, of that of the cylinder around it."""
        widths = self.mask.patch.sum(axis=1)
        return float(np.mean((widths / max(1, int(widths.max()))) ** 2)) if len(widths) else 1.0

    def is_above(self, other: SeenBody) -> bool:
        """Whether the picture shows it above another one."""
        (x0, y0, x1, y1), (left, top, right, bottom) = self.bbox, other.bbox
        overlap = min(x1, right) - max(x0, left)
        return overlap > LEAST_OVERLAP * min(x1 - x0, right - left) and y0 + y1 < top + bottom

    def carries(self, other: SeenBody) -> bool:
        """Whether the foot of another one lies on its top, and it is wider and lower than that.

        What stands behind a thing ends at its upper edge; what stands on it has some of its top to either side.
        """
        x, y = other.foot
        (x0, y0, x1, y1), (left, top, right, _) = self.bbox, other.bbox
        if self.shape not in ("box", "cylinder") or x1 - x0 <= WIDER * (right - left):
            return False
        if not (x0 < x < x1 and y0 < y < y0 + ON_TOP * (y1 - y0) and top < y0):
            return False
        shown, mask = math.inf, self.mask
        for column in (left - BESIDE, right + BESIDE):
            at = int(column) - mask.columns.start
            rows = np.nonzero(mask.patch[:, at])[0] if 0 <= at < mask.patch.shape[1] else np.zeros(0)
            shown = min(shown, y - (float(rows[0] + mask.rows.start) if len(rows) else math.inf))
        return shown > SHOWN * (right - left)

    @property
    def is_flying(self) -> bool:
        """Said to be in the air."""
        return self.prior is not None and self.prior.stands_on == "air"


def supports_of(bodies: Sequence[SeenBody]) -> list[int | None]:
    """For each body the one that it stands on, by what is said of it or by where its foot is; None: the floor."""
    found: list[int | None] = []
    for body in bodies:
        said = None if body.prior is None else body.prior.stands_on
        named = [i for i, other in enumerate(bodies) if other is not body and other.name == said]
        if said in ("floor", "air") or named:
            found.append(named[0] if said not in ("floor", "air") else None)
            continue
        under = [i for i, other in enumerate(bodies) if other is not body and other.carries(body)]
        found.append(min(under, key=lambda i: bodies[i].bbox[3]) if under else None)
    return found
