"""Depth and object ids of a world at one sample, by filling the projected triangles of the drawn meshes."""

import numpy as np

from .camera import Camera
from .meshes import box
from .world import Table, Thing


def turn_matrix(q: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of a quaternion x, y, z, w."""
    x, y, z, w = q / np.linalg.norm(q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def placed(thing: Thing, centre: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Vertices (n, 3) of an object in the world."""
    return thing.surface[0] * thing.scale @ turn_matrix(turn).T + centre


def depth_of(camera: Camera, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Depth (height, width) in metres of one mesh's front; infinite where it is not seen."""
    depth = np.full((camera.height, camera.width), np.inf)
    seen = camera.to_camera(vertices)
    if seen[:, 2].min() < 0.05:
        return depth
    pixels = camera.project(vertices)[triangles]
    inverse = (1 / seen[:, 2])[triangles]
    ab, ac = pixels[:, 1] - pixels[:, 0], pixels[:, 2] - pixels[:, 0]
    areas = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    low = np.maximum(np.ceil(pixels.min(1) - 0.5), 0).astype(int)
    high = np.minimum(np.floor(pixels.max(1) - 0.5), [camera.width - 1, camera.height - 1]).astype(int)
    for p, w, area, (x0, y0), (x1, y1) in zip(pixels, inverse, areas, low, high, strict=True):
        if x0 > x1 or y0 > y1 or abs(area) < 1e-9:
            continue
        x, y = np.arange(x0, x1 + 1) + 0.5 - p[0, 0], (np.arange(y0, y1 + 1) + 0.5 - p[0, 1])[:, None]
        b, c = p[1] - p[0], p[2] - p[0]
        s, t = (x * c[1] - y * c[0]) / area, (y * b[0] - x * b[1]) / area
        inside = (s >= 0) & (t >= 0) & (s + t <= 1)
        value = np.where(inside, 1 / (w[0] + s * (w[1] - w[0]) + t * (w[2] - w[0])), np.inf)
        part = depth[y0 : y1 + 1, x0 : x1 + 1]
        np.minimum(part, value, out=part)
    return depth


def table_mesh(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of the table in the world."""
    half = table.side / 2
    part = box((-half, -half, 0), (half, half, table.height))
    c, s = np.cos(table.yaw), np.sin(table.yaw)
    turned = part.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    return turned + np.array([*table.centre, 0]), part.triangles


def depths(
    camera: Camera, things: tuple[Thing, ...], poses: dict[str, tuple[np.ndarray, np.ndarray]], table: Table | None
) -> dict[str, np.ndarray]:
    """Depth of each object on its own, by name; the table's is under `table`."""
    found = {t.name: depth_of(camera, placed(t, *poses[t.name]), t.surface[1]) for t in things if t.name in poses}
    return found | ({"table": depth_of(camera, *table_mesh(table))} if table else {})


def id_picture(layers: dict[str, np.ndarray], id_of: dict[str, int]) -> np.ndarray:
    """Ids (height, width) uint8 of what is in front; 0 for the room and for what has no id."""
    stack = np.stack(list(layers.values()))
    numbers = np.array([id_of.get(name, 0) for name in layers], np.uint8)
    return np.where(np.isfinite(stack.min(0)), numbers[stack.argmin(0)], 0).astype(np.uint8)


def hidden_share(target: np.ndarray, cover: np.ndarray) -> float:
    """Share of the target's own silhouette with the cover nearer to the camera, 0 to 1."""
    silhouette = np.isfinite(target)
    count = int(silhouette.sum())
    return float((silhouette & (cover < target)).sum() / count) if count else 0.0
