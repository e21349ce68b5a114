"""Bodies as they are to be seen when the motion begins: what was put elsewhere is seen there, larger or smaller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cow_service.physics.bodies import SeenBody
from cow_service.physics.occlusion import shares
from cow_service.physics.projection import rotation_where_put, seen_paths
from cow_service.physics.world import Worlds
from cow_service.records import BBox
from cow_service.vision.masks import CroppedMask, turning
from cow_service.vision.types import Floats

PUSHED = 2.0  # px: what something is put to stays where it is seen if it is pushed less
UPRIGHT = 1.0  # degrees: with less, the box of what leans stays that of what stands upright


def shown_bodies(bodies: Sequence[SeenBody], worlds: Worlds) -> tuple[SeenBody, ...]:
    """Bodies of the image as the first draw has them when the motion begins."""
    return tuple(shown_body(body, index, worlds) for index, body in enumerate(bodies))


def shown_body(body: SeenBody, index: int, worlds: Worlds) -> SeenBody:
    """A body of the image with its box and mask where the first draw has it when the motion begins."""
    if not was_put(index, worlds):
        return body
    path, degrees = seen_paths(worlds, index), rotation_where_put(worlds, index)
    start, to, scale = path.seen[0], path.points[0, 0], float(path.scale[0, 0])
    bbox = _moved_box(body, start, to, turning(scale, degrees), leans=abs(degrees) > UPRIGHT)
    return replace(body, bbox=bbox, mask=body.mask.moved(start, to, scale, degrees))


def was_put(index: int, worlds: Worlds) -> bool:
    """Whether a body of the first draw is not where the image shows it: put elsewhere, or pushed away by that."""
    if worlds.seen is None:
        return False
    path = seen_paths(worlds, index)
    away = float(np.linalg.norm(path.points[0, 0] - path.seen[0]))
    led = worlds.shapes[0][index].follows is not None
    return index in worlds.scene.put or (away > PUSHED and not led)


def visible_share(bodies: Sequence[SeenBody], index: int, worlds: Worlds, size: tuple[int, int]) -> float:
    """Share of a body that is seen at the first frame of the first draw, in an image of a size (width, height; px).

    `bodies` are as the image shows them.
    """
    path = seen_paths(worlds, index)
    x0, y0, x1, y1 = shown_body(bodies[index], index, worlds).bbox
    inside = max(0.0, min(x1, size[0]) - max(x0, 0)) * max(0.0, min(y1, size[1]) - max(y0, 0))
    hidden = [
        float(shares(bodies[index].mask, path, other.mask, seen_paths(worlds, i)).covered[0, 0])
        for i, other in enumerate(bodies)
        if i != index and worlds.scene.supports[index] != i
    ]
    within = inside / max((x1 - x0) * (y1 - y0), 1e-9)
    return 0.0 if bool(path.passed[0, 0]) else within * max(0.0, 1 - max(hidden, default=0.0))


def _moved_box(body: SeenBody, start: Floats, to: Floats, turn: Floats, *, leans: bool) -> BBox:
    """The box of a body whose point `start` has gone `to`: of its outline where it leans."""
    points = _outline(body.mask) if leans else np.array(body.bbox).reshape(2, 2)
    moved = to + (points - start) @ turn.T
    (x0, y0), (x1, y1) = moved.min(axis=0).tolist(), moved.max(axis=0).tolist()
    return x0, y0, x1, y1


def _outline(mask: CroppedMask) -> Floats:
    """Corners [N, 2] (px) of the first and last pixel in each row of a mask."""
    rows = np.nonzero(mask.patch.any(axis=1))[0]
    if not len(rows):
        return np.array(mask.bbox).reshape(2, 2)
    first = mask.patch[rows].argmax(axis=1)
    last = mask.patch.shape[1] - mask.patch[rows, ::-1].argmax(axis=1)
    x, y = np.concatenate([first, last]), np.concatenate([rows, rows])
    corners = np.concatenate([np.stack([x, y], axis=1), np.stack([x, y + 1], axis=1)])
    return corners + np.array([mask.columns.start, mask.rows.start], np.float64)
