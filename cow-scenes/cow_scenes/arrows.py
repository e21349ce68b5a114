"""Draws an arrow over a picture."""

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

COLOURS = {
    "red": (226, 38, 32),
    "green": (26, 176, 60),
    "blue": (26, 66, 205),
    "yellow": (242, 222, 20),
    "black": (10, 10, 10),
}
STYLES = ("open", "filled", "double")
SCALE = 4
"""The arrow is drawn this many times larger and reduced, for smooth edges."""


@dataclass(frozen=True)
class Arrow:
    """Style, colour, thickness and length in pixels of a picture 832 wide; `along`: as the mover moves."""

    style: str
    colour: str
    thickness: int
    length: float
    gap: float
    along: bool


def draw_style(random: np.random.Generator, along: bool, avoid: str = "") -> Arrow:
    """A style of its own per item, not in the colour `avoid`; half of all arrows are red as most are elsewhere."""
    names = [name for name in COLOURS if name != avoid]
    colour = "red" if random.uniform() < 0.4 and avoid != "red" else names[int(random.integers(len(names)))]
    style = STYLES[int(random.integers(len(STYLES)))]
    thickness = (3, 5, 8)[int(random.integers(3))]
    gap = 0.0 if random.uniform() < 0.5 else 0.8
    return Arrow(style, colour, thickness, float(random.uniform(75, 120)), gap, along)


def ends_of(arrow: Arrow, point: np.ndarray, direction: np.ndarray, reach: float, width: int) -> np.ndarray:
    """Tail and tip (2, 2) in pixels: from the object's middle or its edge (`reach` pixels away)."""
    way = direction if arrow.along else -direction
    tail = point + way * reach * arrow.gap
    return np.stack([tail, tail + way * arrow.length * width / 832])


def outline(tail: np.ndarray, tip: np.ndarray, half: float, head: float) -> list[tuple[float, float]]:
    """Corners of a block arrow: shaft of twice `half` pixels and a head `head` pixels long."""
    way = (tip - tail) / np.linalg.norm(tip - tail)
    side = np.array([-way[1], way[0]])
    neck = tip - way * head
    corners = (
        tail + side * half, neck + side * half, neck + side * head * 0.55, tip,
        neck - side * head * 0.55, neck - side * half, tail - side * half,
    )  # fmt: skip
    return [(float(x), float(y)) for x, y in corners]


def draw_arrow(picture: Image.Image, arrow: Arrow, ends: np.ndarray) -> Image.Image:
    """The picture with the arrow on it."""
    unit = picture.width / 832
    layer = Image.new("RGBA", (picture.width * SCALE, picture.height * SCALE), (0, 0, 0, 0))
    pen, (tail, tip) = ImageDraw.Draw(layer), ends * SCALE
    half = (arrow.thickness / 2 + 0.5) * unit * SCALE
    head = (14 + 1.6 * arrow.thickness) * unit * SCALE
    colour = (*COLOURS[arrow.colour], 255)
    if arrow.style == "filled":
        pen.polygon(outline(tail, tip, half, head), fill=colour)
    elif arrow.style == "double":
        half += 2 * unit * SCALE
        corners = outline(tail, tip, half, head)
        pen.polygon(corners, fill=(255, 255, 255, 255))
        rim = max(1, round(2.4 * unit * SCALE))
        pen.line([*corners, corners[0], corners[1]], fill=colour, width=rim, joint="curve")
    else:
        way = (tip - tail) / np.linalg.norm(tip - tail)
        side, width = np.array([-way[1], way[0]]), max(1, round(2 * half))
        wings = [tuple(tip - way * head * 0.85 + s * side * head * 0.6) for s in (-1, 1)]
        pen.line([tuple(tail), tuple(tip)], fill=colour, width=width)
        pen.line([wings[0], tuple(tip), wings[1]], fill=colour, width=width, joint="curve")
    small = layer.resize(picture.size, Image.Resampling.BOX)
    return Image.alpha_composite(picture.convert("RGBA"), small).convert("RGB")
