"""The objects of the second family, in their real sizes: what is drawn of each, and its convex pieces for MuJoCo."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from ..meshes import Part, Profile, box, lathe, sphere
from ..world import Thing

SIDES = 24
Sizes = tuple[float, float]
Primitive = tuple[str, tuple[float, ...]]
"""MuJoCo's own `sphere` (radius) or `box` (half sides), about the centre."""


@dataclass(frozen=True)
class Shape:
    """One kind of object at scale 1, in metres, standing on z = 0.

    `pieces` are the corners (n, 3) of each convex piece; a `primitive` has none. `density` (kg/m3) fills them. `table`
    and `floor` are the least and largest scale in scenes on a table top and on a floor; (0, 0) where it does not occur.
    Without `colours` it may have any. `opening` is the inner width of a container.
    """

    parts: tuple[Part, ...]
    pieces: tuple[np.ndarray, ...]
    density: float
    table: Sizes = (0.0, 0.0)
    floor: Sizes = (0.0, 0.0)
    colours: tuple[str, ...] = ()
    opening: float = 0.0
    primitive: Primitive | None = None

    @property
    def height(self) -> float:
        """Metres."""
        return float(max(p.vertices[:, 2].max() for p in self.parts))

    @property
    def radius(self) -> float:
        """Metres: the circle around the footprint."""
        return float(max(np.hypot(*p.vertices[:, :2].T).max() for p in self.parts))


def moved(part: Part, *by: float) -> Part:
    """A part at another place."""
    return replace(part, vertices=part.vertices + np.array(by))


def turned(profile: Profile) -> np.ndarray:
    """Corners (n, 3) of the convex solid that a profile encloses when it is turned about z."""
    angle = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full(SIDES, z)], 1) for r, z in profile]
    return np.concatenate(rings)


def tube(path: np.ndarray, radii: Sequence[float], material: str = "main") -> tuple[Part, tuple[np.ndarray, ...]]:
    """A bent tube along a path (n, 3) in a vertical plane: what is drawn, and a convex piece per stretch."""
    along = np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    plane = np.cross(path[-1] - path[0], path[len(path) // 2] - path[0])
    side = plane / np.linalg.norm(plane) if np.linalg.norm(plane) > 1e-9 else np.array([0.0, 1.0, 0.0])
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)[:, None]
    rings = [
        p + r * (np.cos(angle) * side + np.sin(angle) * np.cross(t, side))
        for p, t, r in zip(path, along, radii, strict=True)
    ]
    triangles = []
    for i, j in itertools.product(range(len(path) - 1), range(12)):
        a, b = i * 12 + j, i * 12 + (j + 1) % 12
        triangles += [(a, b, b + 12), (a, b + 12, a + 12)]
    last = 12 * (len(path) - 1)
    triangles += [(0, j + 1, j) for j in range(1, 11)] + [(last, last + j, last + j + 1) for j in range(1, 11)]
    pieces = tuple(np.concatenate(two) for two in itertools.pairwise(rings))
    return Part(np.concatenate(rings), np.array(triangles), material, True), pieces


def arch(centre: tuple[float, float], half: Sizes, start: float, end: float) -> np.ndarray:
    """Part of an ellipse (9, 3) in the x-z plane, angles in degrees."""
    angle = np.radians(np.linspace(start, end, 9))
    return np.stack([centre[0] + half[0] * np.cos(angle), 0 * angle, centre[1] + half[1] * np.sin(angle)], 1)


def vessel(low: float, high: float, height: float, wall: float, handles: tuple, **more: Any) -> Shape:
    """An open vessel with a round floor, walls of `wall` metres and handles (pairs of path and thickness)."""
    outline = [(low, 0), (high, height), (high - wall, height), (low - wall, wall)]
    angle, wedges = np.linspace(0, 2 * np.pi, SIDES + 1), []
    for two in itertools.pairwise(angle):
        # Only the floor of the vessel rests on what it stands on: two dozen wedges would make a hundred contacts.
        wedges.append(np.array([(r * np.cos(t), r * np.sin(t), max(z, wall / 2)) for t in two for r, z in outline]))
    tubes = [tube(path, [thick] * len(path)) for path, thick in handles]
    return Shape(
        (lathe([(0, 0), *outline, (0, wall)]), *(part for part, _ in tubes)),
        (turned([(low, 0), (low, wall)]), *wedges, *(piece for _, pieces in tubes for piece in pieces)),
        opening=2 * (high - wall), **more,
    )  # fmt: skip


def solid(profile: Profile, stretches: tuple[Sizes, ...], stem: float = 0.0, **more: Any) -> Shape:
    """A body of rotation; `stretches` are the heights between which it is convex, `stem` the stem's length."""
    pieces = [turned([(r, z) for r, z in profile if low <= z <= high and r > 0]) for low, high in stretches]
    top = profile[-1][1]
    parts = (lathe(profile), *([moved(lathe(STEM, "dark"), 0, 0, top)] if stem else ()))
    return Shape(parts, tuple(pieces), **more)


STEM: Profile = [(0, 0), (0.003, 0), (0.002, 0.016), (0, 0.016)]
APPLE: Profile = [
    (0, 0.006), (0.012, 0), (0.026, 0.006), (0.036, 0.026), (0.038, 0.042), (0.033, 0.060), (0.022, 0.070),
    (0.010, 0.068), (0, 0.061),
]  # fmt: skip
PEAR: Profile = [
    (0, 0.003), (0.014, 0), (0.030, 0.012), (0.036, 0.032), (0.031, 0.054), (0.020, 0.076), (0.016, 0.092),
    (0.009, 0.101), (0, 0.103),
]  # fmt: skip
BOTTLE: Profile = [(0, 0), (0.036, 0), (0.036, 0.15), (0.014, 0.20), (0.014, 0.235), (0, 0.235)]


def globe(radius: float, density: float, **more: Any) -> Shape:
    """A ball."""
    return Shape((moved(sphere(radius), 0, 0, radius),), (), density, primitive=("sphere", (radius,)), **more)


def block(x: float, y: float, z: float, density: float, **more: Any) -> Shape:
    """A box by its half sides."""
    return Shape((box((-x, -y, 0), (x, y, 2 * z)),), (), density, primitive=("box", (x, y, z)), **more)


def blocks(corners: Sequence[tuple], density: float, **more: Any) -> Shape:
    """An object of boxes: (low corner, high corner, material) each, which are drawn and are its pieces."""
    parts = tuple(box(*corner) for corner in corners)
    return Shape(parts, tuple(p.vertices for p in parts), density, **more)


def banana() -> Shape:
    """A bent fruit that lies on its side."""
    path = arch((0, 0.02), (0.085, 0.085), 200, 340)[:, [0, 2, 1]]
    path[:, 1] -= path[:, 1].mean()
    path[:, 2] = 0.019
    part, pieces = tube(path, [0.006, 0.013, 0.017, 0.019, 0.019, 0.018, 0.016, 0.012, 0.006])
    return Shape((part,), pieces, 700, table=(0.9, 1.2), colours=("yellow",))


@cache
def shapes() -> dict[str, Shape]:
    """All kinds of object by the noun that questions use."""
    legs = [((x, y, 0), (x + 0.04, y + 0.04, 0.43), "main") for x in (-0.21, 0.17) for y in (-0.21, 0.17)]
    seat = [((-0.21, -0.21, 0.43), (0.21, 0.21, 0.47), "main"), ((-0.21, -0.21, 0.47), (-0.18, 0.21, 0.86), "main")]
    covers = [((-0.10, -0.075, z), (0.10, 0.075, z + 0.004), "main") for z in (0, 0.031)]
    pages = [
        ((-0.10, -0.075, 0.004), (-0.095, 0.075, 0.031), "main"),
        ((-0.095, -0.07, 0.004), (0.095, 0.07, 0.031), "cream"),
    ]
    ears = tuple((arch((0.11, 0.10), (0.035, 0.022), -90, 90) * (s, 1, 1), 0.007) for s in (1, -1))
    grips = tuple((arch((0.155, 0.16), (0.045, 0.025), -90, 90) * (s, 1, 1), 0.009) for s in (1, -1))
    stick = np.linspace((0.115, 0, 0.035), (0.30, 0, 0.038), 4)
    return {
        "ball": globe(0.08, 250, table=(0.44, 1.0), floor=(1.0, 1.5)),
        "cube": block(0.05, 0.05, 0.05, 400, table=(0.6, 1.3), floor=(1.5, 3.0)),
        "box": block(0.11, 0.07, 0.06, 200, table=(0.6, 1.0), floor=(1.2, 2.2)),
        "book": blocks([*covers, *pages], 600, table=(0.8, 1.3), floor=(1.2, 1.5)),
        "can": solid([(0, 0), (0.033, 0), (0.033, 0.115), (0, 0.115)], ((0, 1),), density=700, table=(0.9, 1.3)),
        "cylinder": solid(
            [(0, 0), (0.05, 0), (0.05, 0.14), (0, 0.14)], ((0, 1),), density=400, table=(0.6, 1.2), floor=(1.5, 2.4)
        ),
        "bottle": solid(BOTTLE, ((0, 0.15), (0.15, 0.2), (0.2, 0.24)), density=600, table=(0.8, 1.2), floor=(1.2, 1.4)),
        "apple": solid(APPLE, ((0, 0.042), (0.042, 1)), 1, density=800, table=(0.9, 1.2), colours=("red", "green")),
        "pear": solid(PEAR, ((0, 0.054), (0.054, 1)), 1, density=800, table=(0.9, 1.2), colours=("green", "yellow")),
        "orange": globe(0.038, 800, table=(0.9, 1.3), colours=("orange",)),
        "banana": banana(),
        "mug": vessel(0.040, 0.042, 0.095, 0.004, ((arch((0.040, 0.05), (0.032, 0.030), -90, 90), 0.006),),
                      density=1800, table=(0.9, 1.3)),
        "pan": vessel(0.105, 0.12, 0.05, 0.005, ((stick, 0.011),), density=2500, table=(0.8, 1.0), floor=(1.2, 1.6)),
        "pot": vessel(0.11, 0.11, 0.14, 0.005, ears, density=2500, table=(0.7, 1.0), floor=(1.1, 1.7)),
        "basket": vessel(0.14, 0.16, 0.20, 0.01, grips, density=300, table=(0.5, 0.7), floor=(0.9, 1.4)),
        "bowl": vessel(0.10, 0.125, 0.11, 0.008, (), density=1500, table=(0.6, 1.0), floor=(1.3, 1.8)),
        "chair": blocks([*legs, *seat], 500, floor=(0.85, 1.05)),
    }  # fmt: skip


@cache
def surface(shape: str) -> tuple[np.ndarray, np.ndarray]:
    """All parts of a shape at scale 1 as one mesh about its centre: vertices (n, 3) and triangles (m, 3)."""
    parts, vertices, triangles, count = shapes()[shape].parts, [], [], 0
    for part in parts:
        vertices.append(part.vertices - (0, 0, shapes()[shape].height / 2))
        triangles.append(part.triangles + count)
        count += len(part.vertices)
    return np.concatenate(vertices), np.concatenate(triangles)


@dataclass(frozen=True)
class Solid(Thing):
    """An object of the second family."""

    @property
    def name(self) -> str:
        """Colour and shape; an orange is called an orange."""
        return self.shape if self.shape == self.colour else f"{self.colour} {self.shape}"

    @property
    def radius(self) -> float:
        """Metres: the circle around the footprint."""
        return shapes()[self.shape].radius * self.scale

    @property
    def height(self) -> float:
        """Metres."""
        return shapes()[self.shape].height * self.scale

    @property
    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """The drawn mesh at scale 1: vertices (n, 3) about the centre, triangles (m, 3)."""
        return surface(self.shape)

    @property
    def width(self) -> float:
        """Metres: the narrowest round opening that it passes upright."""
        return 2 * self.radius

    @property
    def opening(self) -> float:
        """Metres: the width of a container's opening."""
        return shapes()[self.shape].opening * self.scale
