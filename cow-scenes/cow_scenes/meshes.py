"""Triangle meshes of the objects, built from profiles; units metres, origin at half height, z up, front along +x."""

import itertools
from dataclasses import dataclass
from functools import cache

import numpy as np

from .catalogue import HEIGHT

SEGMENTS = 32
Profile = list[tuple[float, float]]

PROFILES: dict[str, Profile] = {
    "cylinder": [(0, 0), (0.14, 0), (0.14, 0.40), (0, 0.40)],
    "cone": [(0, 0), (0.19, 0), (0, 0.44)],
    "bottle": [(0, 0), (0.095, 0), (0.095, 0.33), (0.04, 0.42), (0.04, 0.44), (0, 0.44)],
    "cap": [(0, 0.44), (0.042, 0.44), (0.042, 0.54), (0, 0.54)],
    "candle": [(0, 0), (0.115, 0), (0.115, 0.34), (0, 0.34)],
    "flame": [(0, 0.34), (0.022, 0.345), (0.018, 0.37), (0, 0.42)],
    "mug": [(0, 0), (0.12, 0), (0.12, 0.30), (0.105, 0.30), (0.105, 0.04), (0, 0.04)],
    "vase": [
        (0, 0), (0.08, 0), (0.125, 0.06), (0.15, 0.15), (0.125, 0.24), (0.06, 0.31), (0.06, 0.38),
        (0.14, 0.50), (0.125, 0.50), (0.045, 0.38), (0, 0.37),
    ],
    "bowl": [
        (0, 0), (0.12, 0), (0.13, 0.04), (0.20, 0.10), (0.25, 0.20), (0.22, 0.20), (0.17, 0.115), (0.11, 0.06),
        (0, 0.05),
    ],
}  # fmt: skip
"""(radius, height above the ground) from the axis at the bottom, around the outside, to the axis again."""


@dataclass(frozen=True)
class Part:
    """One closed surface: vertices (n, 3) in metres, triangles (m, 3), the name of its material."""

    vertices: np.ndarray
    triangles: np.ndarray
    material: str
    smooth: bool


def lathe(profile: Profile, material: str = "main", height: float = 0.0) -> Part:
    """Turn a profile about z and lower it by half of `height`."""
    turn = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    rings, vertices = [], []
    for r, z in profile:
        count = 1 if r == 0 else SEGMENTS
        rings.append(np.arange(count) + sum(len(v) for v in vertices))
        angle = turn[:count]
        vertices.append(np.stack([r * np.cos(angle), r * np.sin(angle), np.full(count, z - height / 2)], 1))
    triangles = []
    for low, high in itertools.pairwise(rings):
        for i in range(SEGMENTS):
            j = (i + 1) % SEGMENTS
            a, b, c, d = (ring[k % len(ring)] for ring, k in ((low, i), (low, j), (high, j), (high, i)))
            triangles += [t for t in ((a, b, c), (a, c, d)) if len(set(t)) == 3]
    return Part(np.concatenate(vertices), np.array(triangles), material, True)


def box(low: tuple[float, float, float], high: tuple[float, float, float], material: str = "main") -> Part:
    """An axis-aligned box from corner to corner."""
    corners = np.array([[(low, high)[i >> k & 1][k] for k in range(3)] for i in range(8)], float)
    quads = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
    triangles = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    return Part(corners, np.array(triangles), material, False)


def sphere(radius: float) -> Part:
    """A ball about the origin."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 21)
    profile = [(0.0 if i in {0, 20} else radius * np.cos(a), radius * np.sin(a)) for i, a in enumerate(angle)]
    return lathe(profile)


def wheel(x: float, y: float) -> Part:
    """A wheel of the toy car with its axle along y."""
    part = lathe([(0, -0.03), (0.075, -0.03), (0.075, 0.03), (0, 0.03)], "dark")
    v = part.vertices
    turned = np.stack([v[:, 0] + x, v[:, 2] + y, -v[:, 1] + 0.075 - HEIGHT["toy car"] / 2], 1)
    return Part(turned, part.triangles, "dark", True)


def handle() -> Part:
    """The mug's handle: half a ring of tube in the x-z plane."""
    around, along = np.linspace(0, 2 * np.pi, 10, endpoint=False), np.linspace(-np.pi / 2, np.pi / 2, 13)
    vertices = [
        (0.115 + (0.075 + 0.017 * np.cos(t)) * np.cos(a), 0.017 * np.sin(t), (0.085 + 0.017 * np.cos(t)) * np.sin(a))
        for a in along
        for t in around
    ]
    triangles = []
    for i in range(12):
        for j in range(10):
            a, b = i * 10 + j, i * 10 + (j + 1) % 10
            triangles += [(a, b, b + 10), (a, b + 10, a + 10)]
    return Part(np.array(vertices), np.array(triangles), "main", True)


def car() -> tuple[Part, ...]:
    """Body, cabin, windows, head lamps at the front (+x) and four wheels."""
    z = HEIGHT["toy car"] / 2
    return (
        box((-0.29, -0.15, 0.06 - z), (0.29, 0.15, 0.20 - z)),
        box((-0.22, -0.13, 0.20 - z), (0.10, 0.13, 0.34 - z)),
        box((0.10, -0.115, 0.215 - z), (0.108, 0.115, 0.32 - z), "glass"),
        *(box((-0.17, y - 0.004, 0.225 - z), (0.06, y + 0.004, 0.315 - z), "glass") for y in (-0.13, 0.13)),
        *(box((0.288, y - 0.03, 0.12 - z), (0.30, y + 0.03, 0.17 - z), "lamp") for y in (-0.10, 0.10)),
        *(wheel(x, y) for x in (-0.17, 0.17) for y in (-0.14, 0.14)),
    )


@cache
def parts_of(shape: str) -> tuple[Part, ...]:
    """All parts of a shape at scale 1."""
    height = HEIGHT[shape]
    if shape == "ball":
        return (sphere(0.15),)
    if shape == "cube":
        return (box((-0.15, -0.15, -0.15), (0.15, 0.15, 0.15)),)
    if shape == "toy car":
        return car()
    main = lathe(PROFILES[shape], "main", height)
    more = {
        "bottle": lambda: (lathe(PROFILES["cap"], "dark", height),),
        "candle": lambda: (lathe(PROFILES["flame"], "cream", height),),
        "mug": lambda: (handle(),),
    }
    return (main, *more.get(shape, lambda: ())())


@cache
def surface_of(shape: str) -> tuple[np.ndarray, np.ndarray]:
    """All parts of a shape at scale 1 as one mesh: vertices (n, 3) and triangles (m, 3)."""
    vertices, triangles, count = [], [], 0
    for part in parts_of(shape):
        vertices.append(part.vertices)
        triangles.append(part.triangles + count)
        count += len(part.vertices)
    return np.concatenate(vertices), np.concatenate(triangles)
