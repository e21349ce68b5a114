"""What each pixel shows at t = 0, as `clean.jpg` does: which object, and how far away. No picture is rendered here."""

import numpy as np
from PIL import Image

from .accept import Accepted, still
from .raster import depths, id_picture
from .room import room_of

DEPTH_SCALE = 0.00025
"""Metres per unit of `depth.png`, which therefore reaches 16.38 m."""


def id_numbers(item: Accepted) -> dict[str, int]:
    """Values in `ids.png` by name: the objects in their order, then the table."""
    world = item.draft.world
    names = [*(t.name for t in world.things), *world.fixed]
    return {name: i + 1 for i, name in enumerate(names)}


def maps_of(item: Accepted) -> tuple[np.ndarray, np.ndarray]:
    """Ids (height, width) uint8, and depth (height, width) in metres along the optical axis, infinite for the sky."""
    world = item.draft.world
    layers = depths(item.camera, world.things, {t.name: still(t) for t in world.things}, world.table)
    nearest = np.minimum(room_of(item).depth(item.camera), np.min(list(layers.values()), 0))
    return id_picture(layers, id_numbers(item)), nearest


def depth_picture(depth: np.ndarray) -> Image.Image:
    """Depth in metres as a 16-bit grey picture in units of `DEPTH_SCALE`; 0 for the sky and beyond 16.38 m."""
    units = np.round(depth / DEPTH_SCALE)
    return Image.fromarray(np.where(units < 2**16, units, 0).astype(np.uint16))
