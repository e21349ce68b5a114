"""Names of colours, from CIE Lab measured under shading: the hue angle decides, chroma and lightness refine."""

from __future__ import annotations

import math

CHROMATIC = 9.0  # Lab chroma from which a surface has a hue
BROWN_LIGHTNESS = 42.0  # below it and muted, orange is called brown
BROWN_CHROMA = 36.0
RED_CHROMA = 34.0  # a paler red is called pink

GREYS = (28.0, 70.0)  # lightness of what people may call grey: white in shade too

# Upper end of each name's hue range, degrees in the a*b* plane.
HUES = (
    (20.0, "pink"),
    (48.0, "red"),
    (77.0, "orange"),
    (110.0, "yellow"),
    (178.0, "green"),
    (245.0, "cyan"),
    (298.0, "blue"),
    (334.0, "purple"),
    (360.0, "pink"),
)

HUE_MARGIN, CHROMA_MARGIN, LIGHTNESS_MARGIN = 7.0, 2.5, 5.0  # degrees, Lab units: near a border both names are valid


def colour_name(lightness: float, a: float, b: float) -> str:
    """The name of a Lab colour (lightness 0..100; a, b in CIE units)."""
    chroma = math.hypot(a, b)
    if chroma < CHROMATIC:
        return "black" if lightness < 28 else "white" if lightness > 52 else "grey"
    hue = math.degrees(math.atan2(b, a)) % 360
    name = next(name for end, name in HUES if hue <= end)
    if name == "red" and chroma < RED_CHROMA and lightness > 50:
        return "pink"
    if name in ("orange", "red") and chroma < BROWN_CHROMA and lightness < BROWN_LIGHTNESS:
        return "brown"
    return name


def colour_names(lightness: float, a: float, b: float) -> frozenset[str]:
    """Every name that people may give a Lab colour: its own, and that across a border it lies next to."""
    chroma, hue = math.hypot(a, b), math.atan2(b, a)
    names: set[str] = {"grey"} if chroma < CHROMATIC and GREYS[0] < lightness < GREYS[1] else set()
    for turn in (-HUE_MARGIN, 0.0, HUE_MARGIN):
        for more in (-CHROMA_MARGIN, 0.0, CHROMA_MARGIN):
            for lift in (-LIGHTNESS_MARGIN, 0.0, LIGHTNESS_MARGIN):
                angle, radius = hue + math.radians(turn), max(0.0, chroma + more)
                names.add(colour_name(lightness + lift, radius * math.cos(angle), radius * math.sin(angle)))
    return frozenset(names)
