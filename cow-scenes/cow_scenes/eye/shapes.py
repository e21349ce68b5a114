"""All kinds of shapes that a picture may show, and how often each is drawn."""

from collections.abc import Callable

import numpy as np

from . import goods, kitchen, toys, vehicles, vessels
from .meshes import Part, Random

MAKERS: dict[str, tuple[Callable[[Random], list[Part]], float]] = {
    "cup": (vessels.cup, 3), "bowl": (vessels.bowl, 3), "vase": (vessels.vase, 3), "bottle": (vessels.bottle, 3),
    "can": (vessels.can, 3), "pail": (vessels.pail, 1.5), "pot": (kitchen.pot, 1), "teapot": (kitchen.teapot, 1),
    "goblet": (kitchen.goblet, 1), "fruit": (kitchen.fruit, 4), "banana": (kitchen.banana, 1),
    "plant": (kitchen.plant, 2), "lamp": (kitchen.lamp, 0.7), "carton": (goods.carton, 6),
    "milk carton": (goods.milk_carton, 1.5), "book": (goods.book, 3), "parcel": (goods.parcel, 1.5),
    "house": (goods.house, 1), "prism": (goods.prism, 1.5), "pyramid": (goods.pyramid, 2), "stool": (goods.stool, 1.5),
    "tool": (goods.tool, 1.5), "ring": (goods.ring, 1), "heap": (goods.heap, 2.5), "tower": (goods.tower, 1),
    "ball": (toys.round_ball, 7), "car": (vehicles.car, 4), "truck": (vehicles.truck, 2.5),
    "train": (vehicles.train, 0.7), "plane": (vehicles.plane, 1), "bird": (toys.bird, 2), "figure": (toys.figure, 1.5),
    "animal": (toys.animal, 1.5), "fish": (toys.fish, 1), "headwear": (toys.headwear, 0.7),
}  # fmt: skip
NAMES = tuple(MAKERS)
CHANCES = np.array([often for _, often in MAKERS.values()]) / sum(often for _, often in MAKERS.values())


def any_shape(random: Random) -> list[Part]:
    """A shape of some kind, stretched a little; about one unit large, on z = 0."""
    make = MAKERS[NAMES[random.choice(len(NAMES), p=CHANCES)]][0]
    stretch = np.exp(random.normal(0, 0.1, 3))
    return [Part(part.vertices * stretch, part.faces, part.texture, part.slot) for part in make(random)]
