"""Textures of things: stripes, spots, labels and prints; and the choice among all textures."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np

from .meshes import Random
from .textures import (
    ROOM,
    SKIN,
    bricks,
    carpet,
    checked,
    colour,
    finished,
    grained,
    grid,
    marble,
    mixed,
    noise,
    ornament,
    parquet,
    planks,
    tiles,
)

PHOTOGRAPHS = ("camera.png", "cell.png", "hubble_deep_field.jpg", "ihc.png", "moon.png", "retina.jpg")
"""Files of scikit-image's wheel, CC0 or in the public domain; none is used by the second family of scenes."""


@cache
def photograph(name: str) -> np.ndarray:
    """One of scikit-image's pictures (h, w, 3)."""
    from skimage import data  # noqa: PLC0415 - slow to import, and not needed to look

    encoded = np.fromfile(f"{data.__path__[0]}/{name}", np.uint8)
    return np.ascontiguousarray(np.asarray(cv2.imdecode(encoded, cv2.IMREAD_COLOR))[..., ::-1])


def printed(random: Random, size: int = SKIN) -> np.ndarray:
    """A piece of a photograph in colours of its own."""
    whole = photograph(PHOTOGRAPHS[random.integers(len(PHOTOGRAPHS))])
    side = int(min(whole.shape[:2]) * random.uniform(0.2, 1))
    y, x = (int(random.integers(n - side + 1)) for n in whole.shape[:2])
    piece = cv2.resize(whole[y : y + side, x : x + side], (size, size), interpolation=cv2.INTER_AREA)
    return mixed(random, piece.mean(2) / 255) if random.random() < 0.5 else piece[..., random.permutation(3)]


def striped(random: Random) -> np.ndarray:
    """Stripes at some angle, dots, or a chess board."""
    y, x = grid(SKIN)
    count, kind = int(random.integers(1, 9)), random.integers(3)
    if kind == 0:
        angle = random.choice((0, np.pi / 2, random.uniform(0, np.pi)))
        share = ((x * np.cos(angle) + y * np.sin(angle)) * count) % 1 < random.uniform(0.2, 0.8)
    elif kind == 1:
        share = np.hypot((x * count) % 1 - 0.5, (y * count) % 1 - 0.5) < random.uniform(0.15, 0.42)
    else:
        share = ((x * count * 2).astype(int) + (y * count * 2).astype(int)) % 2 == 0
    return mixed(random, share.astype(np.float32), 0.02)


def mottled(random: Random) -> np.ndarray:
    """Spots, clouds or a peel."""
    cloud = noise(random, SKIN, int(random.integers(2, 6)), random.uniform(0.4, 2.5, 2), int(random.integers(1, 4)))
    return mixed(random, 1 / (1 + np.exp(-cloud * random.uniform(0.5, 6))))


def labelled(random: Random) -> np.ndarray:
    """A label: a ground, bars, figures and words that mean nothing."""
    made = finished(np.broadcast_to(colour(random, is_bright=True), (SKIN, SKIN, 3)))
    for _ in range(int(random.integers(1, 6))):
        ink, (x, y) = colour(random, is_bright=True).tolist(), random.integers(0, SKIN, 2).tolist()
        w, h, kind = int(random.integers(6, 90)), int(random.integers(4, 60)), random.integers(4)
        if kind == 0:
            cv2.rectangle(made, (0, y), (SKIN, y + h), ink, -1)
        elif kind == 1:
            cv2.ellipse(made, (x, y), (w // 2, h // 2), 0, 0, 360, ink, -1, cv2.LINE_AA)
        elif kind == 2:
            cv2.fillPoly(
                made, [random.integers(0, SKIN, (int(random.integers(3, 7)), 2)).astype(np.int32)], ink, cv2.LINE_AA
            )
        else:
            word = "".join(chr(c) for c in random.integers(65, 91, int(random.integers(2, 8))))
            cv2.putText(
                made,
                word,
                (x - 30, y),
                int(random.integers(0, 7)),
                random.uniform(0.5, 2.5),
                ink,
                int(random.integers(1, 5)),
                cv2.LINE_AA,
            )
    return made


ROOMS: tuple[tuple[Callable[[Random], np.ndarray], float], ...] = (
    (planks, 5), (grained, 2), (parquet, 1.5), (tiles, 4), (marble, 3), (checked, 3), (carpet, 5), (ornament, 1.5),
    (bricks, 1), (lambda random: printed(random, ROOM), 1),
)  # fmt: skip
SKINS: tuple[tuple[Callable[[Random], np.ndarray], float], ...] = (
    (striped, 3), (mottled, 3), (labelled, 4), (printed, 1.5),
    (lambda random: cv2.resize(grained(random), (SKIN, SKIN)), 1),
)  # fmt: skip


def drawn_from(random: Random, makers: tuple[tuple[Callable[[Random], np.ndarray], float], ...]) -> np.ndarray:
    """A texture by one of the makers, each as often as its weight says."""
    chances = np.array([often for _, often in makers])
    return makers[random.choice(len(makers), p=chances / chances.sum())][0](random)
