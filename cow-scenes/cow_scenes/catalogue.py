"""The objects' shapes and colours, by the names that questions use."""

COLOURS: dict[str, tuple[float, float, float]] = {
    "red": (0.62, 0.02, 0.015),
    "green": (0.03, 0.30, 0.03),
    "blue": (0.025, 0.11, 0.62),
    "yellow": (0.74, 0.51, 0.015),
    "orange": (0.80, 0.19, 0.01),
    "purple": (0.19, 0.04, 0.42),
    "pink": (0.80, 0.22, 0.34),
    "cyan": (0.04, 0.42, 0.50),
    "white": (0.80, 0.80, 0.78),
    "black": (0.012, 0.012, 0.013),
}
"""Linear RGB base colours, 0 to 1."""

ACCENTS: dict[str, tuple[float, float, float]] = {
    "dark": (0.012, 0.012, 0.013),
    "glass": (0.10, 0.13, 0.16),
    "cream": (0.75, 0.62, 0.40),
    "lamp": (0.85, 0.75, 0.45),
    "table": (0.52, 0.51, 0.49),
}

HEIGHT: dict[str, float] = {
    "ball": 0.30,
    "cube": 0.30,
    "mug": 0.30,
    "bottle": 0.54,
    "vase": 0.50,
    "candle": 0.42,
    "cylinder": 0.40,
    "cone": 0.44,
    "bowl": 0.20,
    "toy car": 0.34,
}
"""Metres at scale 1; an object's centre is at half of its height."""

RADIUS: dict[str, float] = {
    "ball": 0.15,
    "cube": 0.212,
    "mug": 0.20,
    "bottle": 0.095,
    "vase": 0.15,
    "candle": 0.115,
    "cylinder": 0.14,
    "cone": 0.19,
    "bowl": 0.25,
    "toy car": 0.33,
}
"""Metres at scale 1: the circle around the footprint, used to place objects apart."""

BOWL_OPENING = 0.22
"""Metres at scale 1: inner radius of the bowl at its rim."""

STANDING = ("cube", "mug", "bottle", "vase", "candle", "cylinder", "cone")
"""What may stand about in a scene as target or as one more object."""

SLIDING = ("ball", "cube", "mug", "bottle", "candle", "cylinder")
"""What may be set sliding."""
