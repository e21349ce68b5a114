"""Which drawn arrow belongs to an object, and at which object an arrow stands."""

from __future__ import annotations

import math
from collections.abc import Sequence

from cow_service.errors import CannotReadDirection
from cow_service.records import BBox, Grounding
from cow_service.vision.arrows import Arrow
from cow_service.vision.masks import iou
from cow_service.vision.regions import SAME_OBJECT_IOU, Region
from cow_service.vision.scene import Scene

REACH = 1.5  # sizes of an object: an arrow further away is not its own
RIVAL = 0.6  # of a rival's distance: what is nearer than that is clearly the nearest


def gap(arrow: Arrow, bbox: BBox) -> float:
    """Distance from a box to the nearer end of an arrow, in sizes of the box."""
    x0, y0, x1, y1 = bbox
    ends = (arrow.tail, arrow.tip)
    away = min(math.hypot(max(x0 - x, 0, x - x1), max(y0 - y, 0, y - y1)) for x, y in ends)
    return away / max(x1 - x0, y1 - y0)


def arrows_near(scene: Scene, bbox: BBox) -> list[Arrow]:
    """Arrows that start or end close to a box and at no other object, nearest first."""
    others = [region.bbox for region in scene.regions if iou(region.bbox, bbox) < SAME_OBJECT_IOU]
    near: list[Arrow] = []
    for arrow in scene.arrows:
        x, y = arrow.tail
        elsewhere = any(x0 <= x < x1 and y0 <= y < y1 for x0, y0, x1, y1 in others) and gap(arrow, bbox) > REACH / 4
        if gap(arrow, bbox) <= REACH and not elsewhere:
            near.append(arrow)
    return sorted(near, key=lambda arrow: gap(arrow, bbox))


def arrow_at(scene: Scene, bbox: BBox) -> Arrow | None:
    """The arrow of the object in a box: the only one near it, or the one clearly nearest; None where there is none."""
    near = arrows_near(scene, bbox)
    gaps = [gap(arrow, bbox) for arrow in near]
    return near[0] if len(near) == 1 or (near and gaps[0] <= RIVAL * gaps[1]) else None


def arrow_of(scene: Scene, grounding: Grounding, remedy: str) -> Arrow:
    """The mover's arrow. Raises `CannotReadDirection`, which ends with `remedy`, where it has none or several."""
    arrow = arrow_at(scene, grounding.bbox)
    if arrow is not None:
        return arrow
    if not scene.arrows:
        raise CannotReadDirection(
            "The question speaks of an arrow, but no drawn arrow was found: looked for one flat colour with a straight "
            f"shaft and a head. {remedy}"
        )
    near = arrows_near(scene, grounding.bbox)
    if not near:
        raise CannotReadDirection(
            f"The question speaks of an arrow, but what was found stands elsewhere than the {grounding.object}: "
            f"{_ends_of(scene.arrows)}. {remedy}"
        )
    raise CannotReadDirection(
        f"The question speaks of one arrow, but {len(near)} were found, and none is clearly that of the "
        f"{grounding.object}: {_ends_of(near)}. {remedy}"
    )


def at_arrow(scene: Scene, regions: Sequence[Region]) -> list[Region]:
    """Of several regions the one at which the only arrow stands, if it stands at one of them and clearly so."""
    if len(scene.arrows) != 1:
        return []
    arrow = scene.arrows[0]
    ranked = sorted(scene.regions, key=lambda region: gap(arrow, region.bbox))
    nearest = gap(arrow, ranked[0].bbox)
    alone = len(ranked) == 1 or nearest < RIVAL * gap(arrow, ranked[1].bbox)
    return [ranked[0]] if ranked[0] in regions and nearest <= REACH and alone else []


def _ends_of(arrows: Sequence[Arrow]) -> str:
    return "; ".join(f"from ({a.tail[0]:.0f}, {a.tail[1]:.0f}) to ({a.tip[0]:.0f}, {a.tip[1]:.0f})" for a in arrows)
