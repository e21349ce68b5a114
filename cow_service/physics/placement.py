"""What becomes of a body that was put somewhere: in, on, over, beside, or fallen off, in each world of an ensemble.

The rule for `into`, by where things come to rest. What is wider than the opening, or whose lower end lies no more than
a tenth of the container's depth below the rim, is `on-the-rim`: it is held up there. What has gone through the opening
`sticks-out` where its upper end is higher above the rim than the container is deep, and else is `inside`. A thing fits
in the worlds in which it ends as it was meant to: inside; on top; or, beside others, without overlapping them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cow_service.physics.carrying import Put
from cow_service.physics.containers import BOX_SIDES, Hollow
from cow_service.physics.engine import WorldRun
from cow_service.physics.rigid import RigidShape
from cow_service.records import PlacementResult, PlaceRelation
from cow_service.vision.types import Floats, Mask

STICKS_OUT = 1.0  # of the container's depth: how far the upper end is above the rim
GONE_IN = 0.1  # of the container's depth: how far below the rim the lower end of what is inside is
TIPPED = math.cos(math.radians(45))  # upright component of an axis that was upright
SUNK = 0.1  # of the smaller half height: how far below a top the lower end of what lies on it may seem to be
OVERLAPPING = 0.02  # of the half width: so much too close, bodies are taken to touch, not to overlap

STAYING: tuple[PlacementResult, ...] = ("inside", "sticks-out", "on-the-rim", "on-top", "beside")
Turn = Floats  # [4] quaternion x, y, z, w


@dataclass(frozen=True)
class Placements:
    """Per draw [K], how a body ends where it was put."""

    relation: PlaceRelation
    results: tuple[PlacementResult, ...]
    clearance: Floats  # [K]: width of the opening or gap less that of the body, as a share of it; nan without one
    above_rim: Floats  # [K]: share of the body's height above the rim; nan but for `into` a container
    let_go: float  # s

    @property
    def fits(self) -> Mask:
        """[K]: whether it ends as it was meant to."""
        return np.array([result == meant(self.relation) for result in self.results])

    @property
    def stays(self) -> Mask:
        """[K]: whether it comes to rest where it was put, if not as it was meant to."""
        return np.array([result in STAYING for result in self.results])

    @property
    def times(self) -> Floats:
        """[K] s: when it is let go where it stays as it was meant to; infinite where it does not."""
        return np.where(self.fits, self.let_go, math.inf)


def meant(relation: PlaceRelation) -> PlacementResult:
    """The result that a body is put somewhere for."""
    return "inside" if relation == "into" else "on-top" if relation == "onto" else "beside"


def classify(
    put: Put, let_go: Sequence[RigidShape], run: WorldRun, lying: Sequence[RigidShape]
) -> tuple[PlacementResult, float, float]:
    """Result, clearance and share above the rim in one world.

    `let_go` are its bodies as one is let go, `lying` as they were before; `run` is what they did from then on.
    """
    target, body = put.targets[0], put.body
    if put.relation in ("into", "onto"):
        tipped = _upright(run.turns[target, -1]) < TIPPED
        if let_go[target].hollow is not None and put.relation == "into":
            return _into(put, let_go, run, tipped)
        return _onto(put, let_go, run, tipped), math.nan, math.nan
    clearance = gap(put, let_go) if put.relation == "between" else math.nan
    overlaps = (not math.isnan(clearance) and clearance < 0) or _overlaps_any(body, let_go, lying)
    tips = let_go[body].shape != "sphere" and _upright(run.turns[body, -1]) < TIPPED
    return ("overlaps" if overlaps else "tips" if tips else "beside"), clearance, math.nan


def _into(put: Put, let_go: Sequence[RigidShape], run: WorldRun, tipped: bool) -> tuple[PlacementResult, float, float]:
    body, container = let_go[put.body], let_go[put.targets[0]]
    hollow = container.hollow
    assert hollow is not None  # the caller has looked
    clearance = 1 - width_through(body, hollow) / hollow.opening
    there, middle = run.positions[put.body, -1], run.positions[put.targets[0], -1]
    rim, tall = middle[1] + container.half_height, extent(body, run.turns[put.body, -1])
    low, high = there[1] - tall, there[1] + tall
    above = float(np.clip((high - rim) / max(high - low, 1e-9), 0.0, 1.0))
    off = math.hypot(there[0] - middle[0], there[2] - middle[2])
    if off > container.half_width and low < rim:
        return ("tips" if tipped else "falls-off"), clearance, above
    if tipped:
        return "tips", clearance, above
    if clearance <= 0 or rim - low < GONE_IN * hollow.depth:
        return "on-the-rim", clearance, above
    return ("sticks-out" if high - rim > STICKS_OUT * hollow.depth else "inside"), clearance, above


def _onto(put: Put, let_go: Sequence[RigidShape], run: WorldRun, tipped: bool) -> PlacementResult:
    index = put.targets[0]
    body, target = let_go[put.body], let_go[index]
    there, middle, turn = run.positions[put.body, -1], run.positions[index, -1], run.turns[put.body, -1]
    low = there[1] - extent(body, turn)
    top = middle[1] + extent(target, run.turns[index, -1])
    off = math.hypot(there[0] - middle[0], there[2] - middle[2])
    if low < top - SUNK * min(body.half_height, target.half_height) or off > target.half_width + body.half_width:
        return "tips" if tipped and target.shape != "sphere" else "falls-off"
    if (tipped and target.shape != "sphere") or (body.shape != "sphere" and _upright(turn) < TIPPED):
        return "tips"
    return "on-top"


def width_through(body: RigidShape, hollow: Hollow) -> float:
    """Half of the width (m) with which a body goes through an opening: of a box through a round one, its diagonal."""
    if body.shape != "box":
        return body.half_width
    return (
        max(body.half_width, body.half_depth)
        if hollow.sides == BOX_SIDES
        else math.hypot(body.half_width, body.half_depth)
    )


def gap(put: Put, bodies: Sequence[RigidShape]) -> float:
    """How much of the gap between two bodies another leaves, as a share of it; negative where it is too wide."""
    first, second = (bodies[i] for i in put.targets)
    way = np.array(second.position) - np.array(first.position)
    free = math.hypot(way[0], way[2]) - first.half_width - second.half_width
    half = bodies[put.body].half_width
    return (free - 2 * half) / max(free, 1e-3 * half)


def extent(body: RigidShape, turn: Turn) -> float:
    """Half the height (m) of a body turned by a quaternion [4]."""
    if body.shape == "sphere":
        return body.half_width
    upright = abs(_upright(turn))
    if body.shape == "box":
        x, y, z, w = (float(v) for v in turn)
        across, along = 2 * (x * y + w * z), 2 * (y * z - w * x)  # how far the other two axes point up
        return upright * body.half_height + abs(across) * body.half_width + abs(along) * body.half_depth
    return upright * body.half_height + math.sqrt(max(0.0, 1 - upright**2)) * body.half_width


def _upright(turn: Turn) -> float:
    """Upright component of a body's axis."""
    x, _, z, _ = (float(v) for v in turn)
    return 1 - 2 * (x * x + z * z)


def _overlaps_any(body: int, bodies: Sequence[RigidShape], lying: Sequence[RigidShape]) -> bool:
    """Whether a body is put where another one is."""
    mover = bodies[body]
    for other in (*lying[:body], *lying[body + 1 :]):
        away = math.hypot(*(mover.position[i] - other.position[i] for i in (0, 2)))
        level = abs(mover.position[1] - other.position[1]) < mover.half_height + other.half_height
        if level and away < mover.half_width + other.half_width - OVERLAPPING * mover.half_width:
            return True
    return False
