"""What is known about the bodies of a scene before they are placed: boxes, shapes, and which stands on which."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from cow_service.media.masks import CroppedMask
from cow_service.media.types import Floats, Mask
from cow_service.records import FALLING_KINDS, BBox, Motion, ObjectPrior, Point, Shape, Source

ON_TOP = 0.72  # of a support's height in the image, from its upper edge: a foot below that stands before it
SHOWN = 0.1  # of a body's width: how much of its support's top is visible next to it, above its foot
BESIDE = 3.0  # px next to a body's box where the support's upper edge is searched
ENDS = 0.2  # of the height, at the upper and at the lower end, where a vessel has no handle
HANDLE, BARE = 0.12, 0.05  # of the width: so far a handle reaches at least, and the other side at most
WIDER = 1.15  # a support is so much wider than what stands on it
RIM = 0.9  # of half the width of its upper edge: what lies further out rises too steeply to be measured
LEAST_RIM = 12  # px across
RIM_SIGMA, RIM_OFF = 0.08, 0.08  # of half its width: its deviation at best, and that of what is no ellipse
LEAST_OVERLAP = 0.1  # of the narrower box: with less of it above the other, it is next to that
NOTHING_SAID = ObjectPrior()


def no_edges() -> Floats:
    """No straight edges [0, 4]."""
    return np.zeros((0, 4))


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


@dataclass(frozen=True)
class SeenBody:
    """An object of the image."""

    name: str
    bbox: BBox
    mask: CroppedMask
    shape: Shape
    source: Source = "embedded"
    confidence: float = 1.0
    prior: ObjectPrior = NOTHING_SAID
    elongated: bool = False  # a vehicle: longer along its heading than across
    equal_sided: bool = False  # a cube: as wide as high
    is_form_known: bool = True  # its shape was seen or said; else how deep it is, is not known
    stands_out: bool = True  # it is separate from its surroundings: nothing else is seen to carry it
    taper: float = 1.0  # its width at its lower end, of that at its upper end
    bbox_deviation: float = 0.0  # of the edges of its box, in its sides
    point: Point | None = None  # px: of the mover, the one it was grounded at
    edges: Floats = field(default_factory=no_edges)  # ends [S, 4] (px) of its straight edges, longest first

    @property
    def is_depth_known(self) -> bool:
        """Whether its shape determines its depth along the line of sight: that of bricks and boxes is unknown."""
        said = self.prior
        is_any_box = said.shape == "box" and not (said.equal_sided or said.elongated)
        return self.is_form_known and not is_any_box

    @property
    def start(self) -> Point:
        """Where its path begins, px: the point it was grounded at, else the middle of its box."""
        return self.point or self.middle_point

    @property
    def middle_point(self) -> Point:
        """The middle of its box, px."""
        return (self.bbox[0] + self.bbox[2]) / 2, (self.bbox[1] + self.bbox[3]) / 2

    @property
    def radius(self) -> float:
        """A quarter of its box's width and height together, px."""
        return (self.bbox[2] - self.bbox[0] + self.bbox[3] - self.bbox[1]) / 4

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
    def rim(self) -> tuple[float, float] | None:
        """Minor to major axis of its round top as the upper edge of its outline shows it, and its deviation.

        None if that edge is no half of an ellipse.
        """
        patch = self.mask.patch
        top = patch[: max(3, len(patch) // 6)]
        columns = np.nonzero(top.any(axis=0))[0]
        if not len(columns):
            return None
        middle, half = (columns[0] + columns[-1]) / 2, (columns[-1] + 1 - columns[0]) / 2
        inner = columns[np.abs(columns - middle) < RIM * half]
        if len(inner) < LEAST_RIM:
            return None
        arc = np.sqrt(1 - ((inner - middle) / half) ** 2)
        level = patch[:, inner].argmax(axis=0).astype(np.float64)
        height, _ = np.polyfit(arc, level, 1)
        off = float(np.std(level - height * arc)) / half
        return (float(-height / half), RIM_SIGMA + off) if off < RIM_OFF else None

    @cached_property
    def widths(self) -> Floats:
        """Widths of its outline per row [R] from the top, relative to the widest; a cylinder's if it has no outline."""
        widths = self.mask.patch.sum(axis=1)
        return widths / widths.max() if self.mask.area else np.ones(1)

    @cached_property
    def middle(self) -> float:
        """Height of the centre of mass of that body, of its height."""
        volumes = self.widths**2
        return float(1 - (np.arange(len(volumes)) + 0.5) @ volumes / volumes.sum() / len(volumes))

    def stance(self, sine: float) -> tuple[float, float]:
        """Width on which it stands, of its width, and the height up to which it is that narrow, of its height.

        `sine` is that of the angle at which it is looked down on: so far the near half of a round base reaches below
        its ends.
        """
        pixels = float(self.mask.patch.sum(axis=1).max()) if self.mask.area else 1.0
        base, row = 0.0, len(self.widths) - 1
        for _ in range(12):  # upwards: what is wider higher up is no part of the base
            row = min(row, max(0, len(self.widths) - 1 - round(base * pixels / 2 * sine)))
            base = float(self.widths[row])
        wide = np.nonzero(self.widths[: row + 1] > (1 + base) / 2)[0]
        return base, (row - float(wide[-1]) if len(wide) else 0.0) / len(self.widths)

    def is_above(self, other: SeenBody) -> bool:
        """Whether the picture shows it above another one."""
        (x0, y0, x1, y1), (left, top, right, bottom) = self.bbox, other.bbox
        overlap = min(x1, right) - max(x0, left)
        return overlap > LEAST_OVERLAP * min(x1 - x0, right - left) and y0 + y1 < top + bottom

    def carries(self, other: SeenBody) -> bool:
        """Whether the foot of another one lies on its top, and it is wider and lower than that.

        What stands behind a thing ends at its upper edge; what stands on it has some of its top to either side, and
        reaches above it, or has it beneath its foot, too, where what stands before it has floor.
        """
        x, y = other.foot
        (x0, y0, x1, y1), (left, top, right, _) = self.bbox, other.bbox
        if self.shape not in ("box", "cylinder") or x1 - x0 <= WIDER * (right - left):
            return False
        if not (x0 < x < x1 and y0 < y < y0 + ON_TOP * (y1 - y0)):
            return False
        above, below, mask = math.inf, math.inf, self.mask  # px of it next to the other one, above and below its foot
        for column in (left - BESIDE, right + BESIDE):
            at = int(column) - mask.columns.start
            rows = np.nonzero(mask.patch[:, at])[0] if 0 <= at < mask.patch.shape[1] else np.zeros(0)
            above = min(above, y - (float(rows[0] + mask.rows.start) if len(rows) else math.inf))
            below = min(below, (float(rows[-1] + mask.rows.start) if len(rows) else -math.inf) - y)
        return above > SHOWN * (right - left) and (top < y0 or below > SHOWN * (right - left))

    @property
    def is_flying(self) -> bool:
        """Said to be in the air."""
        return self.prior.stands_on == "air"

    def flies(self, motion: Motion) -> bool:
        """Whether it is in the air at the first frame, as far as is said, if it is what moves."""
        return motion.kind in FALLING_KINDS if self.prior.stands_on is None else self.is_flying


TOUCHING = 6  # px: so far apart are shapes of a drawing that touch
HANGS = -1  # in the place of a support: it is drawn above nothing


def _drawn_supports(bodies: Sequence[SeenBody], level: float) -> list[int | None]:
    """Of shapes of a drawing; `HANGS` for what is drawn above nothing."""
    found: list[int | None] = []
    for body in bodies:
        lower = np.pad(body.mask.full(), ((TOUCHING, 0), (0, 0)))[:-TOUCHING]
        shared = [0 if other is body else other.mask.shared_with(lower) for other in bodies]
        under = int(np.argmax(shared))
        floor = None if body.bbox[3] > level - TOUCHING else HANGS
        found.append(under if shared[under] else floor)
    return found


def supports_of(bodies: Sequence[SeenBody], level: float | None = None) -> list[int | None]:
    """For each body its support, as stated or by the place of its foot; None: the floor.

    `level` is the height in the image (px) of the floor of a drawing that is seen from the side.
    """
    if level is not None:
        return _drawn_supports(bodies, level)
    found: list[int | None] = []
    for body in bodies:
        said = body.prior.stands_on
        named = [i for i, other in enumerate(bodies) if other is not body and other.name == said]
        if said in ("floor", "air") or named:
            found.append(named[0] if said not in ("floor", "air") else None)
            continue
        under = [i for i, other in enumerate(bodies) if other is not body and other.carries(body)]
        found.append(min(under, key=lambda i: bodies[i].bbox[3]) if under else None)
    return found
