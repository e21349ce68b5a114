"""Names of colours, from CIE Lab measured under shading: the hue angle decides, chroma and lightness refine."""

from __future__ import annotations

import math

CHROMATIC = 9.0  # Lab chroma from which a surface has a hue
BROWN_LIGHTNESS = 42.0  # below it and muted, orange is called brown
BROWN_CHROMA = 36.0
RED_CHROMA = 34.0  # a paler red is called pink

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

NEIGHBOURS = frozenset(
    frozenset(pair)
    for pair in (
        ("red", "orange"),
        ("red", "pink"),
        ("orange", "yellow"),
        ("orange", "brown"),
        ("red", "brown"),
        ("yellow", "green"),
        ("green", "cyan"),
        ("cyan", "blue"),
        ("blue", "purple"),
        ("purple", "pink"),
        ("white", "grey"),
        ("grey", "black"),
    )
)


def name_of(lightness: float, a: float, b: float) -> str:
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


def agreement(wanted: str, seen: str) -> float:
    """1 for the same name, 0.5 for neighbours that people mix up, 0 otherwise."""
    return 1.0 if wanted == seen else 0.5 if frozenset((wanted, seen)) in NEIGHBOURS else 0.0
