"""Convex pieces of the objects for Bullet; the same profiles as the drawn meshes, with fewer sides."""

import itertools
from functools import cache

import numpy as np

from .catalogue import HEIGHT
from .meshes import PROFILES, box, handle

SIDES = 20
STACKS: dict[str, tuple[tuple[str, int, int], ...]] = {
    "cylinder": (("cylinder", 1, 2),),
    "cone": (("cone", 1, 2),),
    "bottle": (("bottle", 1, 2), ("bottle", 2, 3), ("cap", 1, 2)),
    "candle": (("candle", 1, 2), ("flame", 1, 3)),
    "mug": (("mug", 1, 2),),
    "vase": (("vase", 1, 3), ("vase", 3, 5), ("vase", 5, 6), ("vase", 6, 7)),
}
"""Profile, first and last point of each convex stretch."""


def stretch(shape: str, profile: str, first: int, last: int) -> np.ndarray:
    """Corners (n, 3) of the solid between two points of a profile."""
    angle = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    rings = [
        np.stack([r * np.cos(angle), r * np.sin(angle), np.full(SIDES, z - HEIGHT[shape] / 2)], 1)
        for r, z in PROFILES[profile][first : last + 1]
    ]
    return np.concatenate(rings)


def bowl_walls() -> list[np.ndarray]:
    """The bowl's foot and its wall in wedges, so that its inside stays hollow."""
    low = HEIGHT["bowl"] / 2
    wedges = [stretch("bowl", "bowl", 1, 2)]
    turn = np.linspace(0, 2 * np.pi, SIDES + 1)
    for bottom_out, top_out, top_in, bottom_in in ((2, 3, 6, 7), (3, 4, 5, 6)):
        ring = [PROFILES["bowl"][i] for i in (bottom_out, top_out, top_in, bottom_in)]
        for a, b in itertools.pairwise(turn):
            wedges.append(np.array([(r * np.cos(t), r * np.sin(t), z - low) for t in (a, b) for r, z in ring]))
    return wedges


@cache
def pieces_of(shape: str) -> tuple[np.ndarray, ...]:
    """Corners of each convex piece at scale 1; ball and cube are Bullet's own and not here."""
    if shape == "bowl":
        return tuple(bowl_walls())
    if shape == "toy car":
        z = HEIGHT[shape] / 2
        low, high = box((-0.30, -0.16, -z), (0.30, 0.16, 0.20 - z)), box((-0.22, -0.13, 0.20 - z), (0.11, 0.13, z))
        return (low.vertices, high.vertices)
    stacks = tuple(stretch(shape, *stack) for stack in STACKS[shape])
    return (*stacks, handle().vertices) if shape == "mug" else stacks
