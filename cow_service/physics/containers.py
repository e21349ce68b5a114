"""Hollow bodies: an open container as a floor and wall segments around the space inside.

Coordinates are those of the body: metres right, up and ahead from its middle, its axis upright.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cow_service.physics.draws import COLUMN
from cow_service.vision.openings import SeenOpening
from cow_service.vision.types import Floats

ROUND_SIDES = 16  # wall segments of a round container: the opening is wider by at most 2% at their joints
BOX_SIDES = 4
THINNEST = 0.03  # of the half width: a thinner wall would let fast things through
LEAST_OPENING = 0.3  # of the half width
FLOOR_SHARE = 0.08  # of the height: how thick the floor of a container is
NARROWEST = 0.3  # of the opening: its floor


@dataclass(frozen=True)
class Hollow:
    """The space inside a body. Its outer sizes are those of the body, at its rim."""

    opening: float  # m: inner radius at the rim; of a box half the inner side
    bottom: float  # m: the same at the floor
    depth: float  # m: from the rim down to the floor
    sides: int = ROUND_SIDES


def hollow_of(seen: SeenOpening, half_width: float, half_height: float, row: Floats) -> Hollow:
    """The space inside a body of outer half width and height (m), as a draw [P] has the width of the opening."""
    drawn = seen.inner * math.exp(seen.deviation * float(row[COLUMN["opening"]]))
    opening = half_width * min(max(drawn, LEAST_OPENING), 1 - THINNEST)
    wall = half_width - opening
    bottom = min(opening, max(NARROWEST * opening, seen.bottom * half_width - wall))
    sides = BOX_SIDES if seen.square else ROUND_SIDES
    return Hollow(opening, bottom, 2 * half_height * (1 - FLOOR_SHARE), sides)


def wall_segments(hollow: Hollow, half_width: float, half_height: float) -> list[Floats]:
    """The corners [8, 3] of each convex segment of the wall, which stands on the floor of the container."""
    turn = math.pi / hollow.sides
    angles = turn + 2 * turn * np.arange(hollow.sides + 1)
    circle = np.stack([np.cos(angles), np.zeros_like(angles), np.sin(angles)], axis=1)
    around = np.asarray(circle / math.cos(turn), np.float64)
    levels = ((half_width, hollow.opening, half_height), (floor_radius(hollow, half_width), hollow.bottom, 0.0))
    corners: list[Floats] = []
    for outer, inner, height in levels:
        level = np.array([0.0, height if height else half_height - hollow.depth, 0.0])
        corners += [around * outer + level, around * inner + level]
    return [np.concatenate([ring[i : i + 2] for ring in corners]) for i in range(hollow.sides)]


def floor_radius(hollow: Hollow, half_width: float) -> float:
    """Outer radius (m) of the floor of a container, or half its side."""
    return hollow.bottom + half_width - hollow.opening


def floor_thickness(hollow: Hollow, half_height: float) -> float:
    """Metres."""
    return 2 * half_height - hollow.depth


def relative_density(hollow: Hollow, half_width: float, half_height: float) -> float:
    """The density with which a container is as heavy as a solid body of its outline would be with a density of 1.

    Things that hold others are made of heavier stuff than balls and blocks of their size; the thickness of their walls
    is not seen, and must not decide what tips them.
    """
    low, high = floor_radius(hollow, half_width), half_width
    outline = 2 * half_height * (low**2 + low * high + high**2) / 3
    space = hollow.depth * (hollow.bottom**2 + hollow.bottom * hollow.opening + hollow.opening**2) / 3
    return outline / max(outline - space, 0.02 * outline)
