"""Gives the floors, tables and rugs of a drawn picture other patterns, in the right perspective and under its light.

Busy surfaces are what things are hardest to tell from, and patterns cost less than pictures.
"""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np

from .pictures import DRAWN, Picture
from .room import FIRST_FLAT, FIRST_WALL
from .textures import ROOM, bricks, checked, marble, ornament, parquet, planks, tiles

MAKERS = (checked, checked, checked, tiles, tiles, tiles, planks, planks, parquet, marble, marble, bricks, ornament)
POOL = 52
"""Patterns there are."""
PERIODS = (0.12, 1.2)
"""Metres after which a pattern repeats, at least and at most."""


@cache
def pattern(number: int) -> np.ndarray:
    """Factors (n, n, 3) float32 about 1 by which a pattern changes a surface's colour."""
    made = MAKERS[number % len(MAKERS)](np.random.default_rng((11, number))).astype(np.float32)
    return np.clip(made / max(float(made.mean()), 20), 0.15, 2.5)


def plane_points(picture: Picture, number: int, turn: float) -> np.ndarray | None:
    """Where (h, w, 2) in metres along two axes of a plane each pixel's ray meets it; None for planes seen edge on."""
    height, width = picture.ids.shape
    normal = picture.normals[number].astype(np.float32)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    rays = np.stack([(x - width / 2) / picture.focal, (y - height / 2) / picture.focal, np.ones_like(x)], -1)
    facing = rays @ normal
    step = height // picture.depth.shape[0]
    sparse = np.s_[step // 2 :: step, step // 2 :: step]
    seen = (picture.ids[sparse] == number) & (facing[sparse] < -0.02)
    if seen.sum() < 20:
        return None
    distance = float(np.median((facing[sparse] * picture.depth.astype(np.float32))[seen]))
    points = rays * (distance / np.minimum(facing, -0.02))[..., None]
    side = np.cross(normal, (np.cos(turn), np.sin(turn), 0.3))
    side = side / np.linalg.norm(side)
    return points @ np.stack([side, np.cross(normal, side)], 1).astype(np.float32)


def covered(picture: Picture, number: int, random: np.random.Generator) -> np.ndarray:
    """The image with a pattern on one plane; it fades where its repeats are finer than a few pixels."""
    points = plane_points(picture, number, random.uniform(0, np.pi))
    if points is None:
        return picture.image
    period = np.exp(random.uniform(*np.log(PERIODS)))
    across = (points / period * ROOM).astype(np.float32)
    columns, rows = (np.ascontiguousarray(across[..., k] % (ROOM - 1)) for k in range(2))
    factors = cv2.remap(
        pattern(int(random.integers(POOL))), columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    step = np.abs(np.diff(across[..., 1], axis=0, prepend=across[:1, :, 1])) + np.abs(
        np.diff(across[..., 0], axis=0, prepend=across[:1, :, 0])
    )
    strength = random.uniform(0.4, 1) * np.clip(2 - step / 24, 0, 1)
    strength *= (picture.ids == number) & (picture.marks & DRAWN == 0)
    changed = picture.image * (1 + strength[..., None] * (factors - 1))
    return np.clip(changed, 0, 255).astype(np.uint8)


def retextured(picture: Picture, random: np.random.Generator) -> Picture:
    """The picture with other patterns on its largest floors, tables or rugs."""
    count = np.bincount(picture.ids.ravel(), minlength=256)[FIRST_FLAT:FIRST_WALL]
    for number in np.argsort(-count)[: int(random.integers(1, 3))] + FIRST_FLAT:
        if count[number - FIRST_FLAT] > 2000 and picture.normals[number].any():
            picture = replace(picture, image=covered(picture, int(number), random))
    return picture
