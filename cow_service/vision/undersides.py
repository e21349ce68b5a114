"""Tells the dark lower end of a thing, such as a car's wheels and the shade between them, from another black thing."""

from __future__ import annotations

from cow_service.records import BBox

INSIDE = 0.8  # of a dark part's box that lies in the thing's, grown by `BESIDE` and by `LOW`
BESIDE = 0.08  # of the thing's height
LOW = 0.22  # of the thing's height: so far from its lower end the dark part ends at most
FLAT = 1.5  # width of a dark part over its height, at least


def is_underside(part: BBox, thing: BBox) -> bool:
    """Whether the box [x0, y0, x1, y1] of a dark part lies at the lower end of a thing's, not before or beside it."""
    height = thing[3] - thing[1]
    width = min(part[2], thing[2] + BESIDE * height) - max(part[0], thing[0] - BESIDE * height)
    inside = width * (min(part[3], thing[3] + LOW * height) - max(part[1], thing[1]))
    low = abs(part[3] - thing[3]) <= LOW * height and part[1] + part[3] > thing[1] + thing[3]
    wide, high = part[2] - part[0], part[3] - part[1]
    return low and width > 0 and wide >= FLAT * high and inside >= INSIDE * wide * high
