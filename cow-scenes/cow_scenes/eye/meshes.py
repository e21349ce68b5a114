"""Triangle meshes for looking: parts with texture coordinates, made from profiles, outlines and paths.

Everything is about one unit large, stands on z = 0 and is scaled when it is placed. No part is closed on purpose:
nothing here has a mass.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

Random = np.random.Generator
Point = tuple[float, float, float]
Path = np.ndarray | Sequence[Sequence[float] | np.ndarray]
"""Points (n, 3)."""


@dataclass(frozen=True)
class Part:
    """Vertices (n, 3), triangles (m, 3), texture coordinates (n, 2); parts with the same `slot` share a material."""

    vertices: np.ndarray
    faces: np.ndarray
    texture: np.ndarray
    slot: int = 0


def moved(part: Part, *by: float) -> Part:
    """The part at another place."""
    return replace(part, vertices=part.vertices + np.array(by))


def scaled(part: Part, *by: float) -> Part:
    """The part stretched along the axes; factors are positive."""
    return replace(part, vertices=part.vertices * np.array(by))


def turned(part: Part, matrix: np.ndarray) -> Part:
    """The part turned by a rotation matrix (3, 3)."""
    return replace(part, vertices=part.vertices @ matrix.T)


def about_z(angle: float) -> np.ndarray:
    """A rotation about the vertical axis, in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def about_y(angle: float) -> np.ndarray:
    """A rotation about the y axis, in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def any_turn(random: Random) -> np.ndarray:
    """A rotation drawn from all of them."""
    matrix, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return matrix * np.sign(np.linalg.det(matrix))


def grounded(parts: Sequence[Part]) -> list[Part]:
    """The parts lowered or raised together until they stand on z = 0."""
    low = min(part.vertices[:, 2].min() for part in parts)
    return [moved(part, 0, 0, -low) for part in parts]


def lathe(profile: Sequence[tuple[float, float]], slot: int = 0, sides: int = 28, wraps: tuple = (1, 1)) -> Part:
    """Turn (radius, height) pairs about z; a texture goes `wraps` times around and along the profile."""
    outline = np.array(profile, float)
    outline[:, 0] = np.maximum(outline[:, 0], 1e-5)
    count, angle = len(outline), np.linspace(0, 2 * np.pi, sides + 1)
    x, y = np.outer(np.cos(angle), outline[:, 0]), np.outer(np.sin(angle), outline[:, 0])
    vertices = np.stack([x, y, np.tile(outline[:, 1], (sides + 1, 1))], -1).reshape(-1, 3)
    along = np.r_[0, np.cumsum(np.hypot(*np.diff(outline, axis=0).T))]
    texture = np.stack(
        [
            np.repeat(np.arange(sides + 1) / sides * wraps[0], count),
            np.tile(along / along[-1] * wraps[1], sides + 1),
        ],
        -1,
    )
    i, j = np.meshgrid(np.arange(sides), np.arange(count - 1), indexing="ij")
    a = (i * count + j).ravel()
    faces = np.r_[np.c_[a, a + count, a + count + 1], np.c_[a, a + count + 1, a + 1]]
    return Part(vertices, faces, texture, slot)


def box(size: Sequence[float] | np.ndarray, centre: Point = (0, 0, 0), slot: int = 0, wraps: float = 1.0) -> Part:
    """A box by its sides; every face has the whole texture, `wraps` times."""
    vertices, faces, texture = [], [], []
    half = np.array(size, float) / 2
    for axis in range(3):
        for side in (-1, 1):
            u, v, first = (axis + 1) % 3, (axis + 2) % 3, len(vertices)
            for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                corner = np.zeros(3)
                corner[[axis, u, v]] = side, x, y
                vertices.append(corner * half + centre)
                texture.append(((x + 1) / 2 * wraps, (y + 1) / 2 * wraps))
            order = ((0, 1, 2), (0, 2, 3)) if side > 0 else ((0, 2, 1), (0, 3, 2))
            faces += [[first + k for k in face] for face in order]
    return Part(np.array(vertices), np.array(faces), np.array(texture), slot)


def ball(radius: float, centre: Point = (0, 0, 0), slot: int = 0, sides: int = 20, wraps: tuple = (2, 1)) -> Part:
    """A ball."""
    angle = np.linspace(0, np.pi, sides // 2 + 3)
    made = lathe(np.c_[radius * np.sin(angle), -radius * np.cos(angle)].tolist(), slot, sides, wraps)
    return moved(made, *centre)


def blob(radii: Point, centre: Point = (0, 0, 0), slot: int = 0, sides: int = 18) -> Part:
    """An ellipsoid by its three radii."""
    return moved(scaled(ball(1, (0, 0, 0), slot, sides), *radii), *centre)


def rod(
    radius: float, length: float, centre: Point = (0, 0, 0), axis: int = 2, slot: int = 0, tip: float | None = None
) -> Part:
    """A cylinder, or a cone frustum that ends with the radius `tip`, along an axis (0 x, 1 y, 2 z)."""
    end = radius if tip is None else tip
    made = lathe([(0, -length / 2), (radius, -length / 2), (end, length / 2), (0, length / 2)], slot, 20)
    order = {0: [2, 0, 1], 1: [1, 2, 0], 2: [0, 1, 2]}[axis]
    return moved(replace(made, vertices=made.vertices[:, order]), *centre)


def tube(path: Path, radius: float, slot: int = 0, sides: int = 8) -> Part:
    """A bent tube along points (n, 3)."""
    points = np.array(path, float)
    count, vertices, faces = len(points), [], []
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)[:, None]
    for k, point in enumerate(points):
        along = points[min(k + 1, count - 1)] - points[max(k - 1, 0)]
        along = along / (np.linalg.norm(along) + 1e-9)
        across = np.cross(along, (0.13, 1, 0.05))
        across /= np.linalg.norm(across)
        vertices.append(point + radius * (np.cos(angle) * across + np.sin(angle) * np.cross(along, across)))
    for i in range(count - 1):
        for j in range(sides):
            a, b = i * sides + j, i * sides + (j + 1) % sides
            faces += [(a, b, b + sides), (a, b + sides, a + sides)]
    k = np.arange(count * sides)
    return Part(
        np.concatenate(vertices), np.array(faces), np.c_[k % sides / sides, k // sides / count].astype(float), slot
    )


def arc(centre: Point, radii: tuple[float, float], start: float, end: float, count: int = 12) -> np.ndarray:
    """Points (count, 3) on an ellipse in the x-z plane, angles in radians."""
    angle = np.linspace(start, end, count)
    return np.array(centre) + np.c_[radii[0] * np.cos(angle), 0 * angle, radii[1] * np.sin(angle)]


def extrude(outline: Sequence[tuple[float, float]], width: float, slot: int = 0) -> Part:
    """A simple polygon in the x-z plane, made `width` thick along y."""
    points = np.array(outline, float)
    following = np.roll(points, -1, 0)
    if np.sum(points[:, 0] * following[:, 1] - following[:, 0] * points[:, 1]) < 0:
        points = points[::-1]
    count, triangles = len(points), np.array(cut_ears(points))
    near, far = (np.insert(points, 1, side * width / 2, axis=1) for side in (-1, 1))
    vertices, faces = [near, far], [triangles, triangles[:, [0, 2, 1]] + count]
    for i in range(count):
        j, first = (i + 1) % count, 2 * count + 4 * i
        vertices.append(np.array([near[i], near[j], far[j], far[i]]))
        faces.append(np.array([(first, first + 2, first + 1), (first, first + 3, first + 2)]))
    corners = np.concatenate(vertices)
    span = float(np.ptp(points[:, 0]))
    return Part(corners, np.concatenate(faces), np.c_[corners[:, 0] / span + 0.5, corners[:, 2] / span], slot)


def cut_ears(points: np.ndarray) -> list[tuple[int, int, int]]:
    """Triangles of a simple polygon (n, 2) that runs counter-clockwise."""

    def turn(a: int, b: int, c: int) -> float:
        (ax, ay), (bx, by), (cx, cy) = points[a], points[b], points[c]
        return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)

    def is_ear(a: int, b: int, c: int) -> bool:
        if turn(a, b, c) <= 0:
            return False
        others = (k for k in left if k not in {a, b, c})
        return not any(turn(a, b, k) >= 0 and turn(b, c, k) >= 0 and turn(c, a, k) >= 0 for k in others)

    left, made = list(range(len(points))), []
    while len(left) > 3:
        k = next((k for k in range(len(left)) if is_ear(left[k - 1], left[k], left[(k + 1) % len(left)])), 0)
        made.append((left[k - 1], left[k], left[(k + 1) % len(left)]))
        left.pop(k)
    return [*made, (left[0], left[1], left[2])]
