"""Standard normal draws for an ensemble of worlds: evenly spread, the same every time."""

from statistics import NormalDist

import numpy as np

from cow_service.media.types import Floats
from cow_service.records import Doubt

PARAMETERS: dict[str, Doubt] = {
    "pitch": "camera",
    "focal": "camera",
    "roll": "camera",
    "height": "place",
    "slant_right": "place",
    "slant_ahead": "place",
    "foot": "place",
    "speed": "speed",
    "depth": "heading",
    "turn": "heading",
    "size": "size",
    "yaw": "size",
    "outline": "size",
    "friction": "friction",
    "restitution": "friction",
    "other_speed": "speed",
    "opening": "size",
    "let_go_right": "place",
    "let_go_ahead": "place",
    "deep": "size",
    "base": "size",
    "middle": "size",
    "weight": "friction",
}  # what is uncertain in a world, and the kind of doubt that it belongs to
NAMES = tuple(PARAMETERS)
COLUMN = {name: place for place, name in enumerate(NAMES)}


def likeliest() -> Floats:
    """The one row [1, P] of the world in which nothing deviates."""
    return np.zeros((1, len(NAMES)))


def ensemble(count: int) -> Floats:
    """Rows [count, P] by Latin hypercube sampling: of each parameter every quantile occurs once.

    Their order is such that few rows stand for all: each next one brings the means over those before it, of the first
    two cosines of every parameter's quantiles, as near to those over all as can be (kernel herding).
    """
    normal = np.array([NormalDist().inv_cdf((i + 0.5) / count) for i in range(count)])
    rng = np.random.default_rng(0)  # the same request must give the same worlds
    ranks = np.stack([rng.permutation(count) for _ in NAMES], axis=1)
    features = np.concatenate([np.cos(np.pi * k * (ranks + 0.5) / count) / k for k in (1, 2)], axis=1)
    order, total, left = list[int](), np.zeros(features.shape[1]), np.arange(count)
    for _ in range(count):
        best = int(((total + features[left]) ** 2).sum(axis=1).argmin())
        order.append(int(left[best]))
        total, left = total + features[left[best]], np.delete(left, best)
    return normal[ranks[order]]


def quantiles(normal: Floats) -> Floats:
    """Shares 0..1 [K] of standard normal draws [K] that lie below each."""
    return np.array([NormalDist().cdf(z) for z in normal])
