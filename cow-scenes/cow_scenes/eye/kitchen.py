"""More things turned on a lathe: pots, glasses and lamps, and what grows: fruit and plants."""

import numpy as np

from .meshes import Part, Random, about_y, arc, ball, blob, box, grounded, lathe, moved, rod, tube, turned
from .vessels import wraps


def pot(random: Random) -> list[Part]:
    """A cooking pot, pan or kettle."""
    height = random.uniform(0.35, 1.5)
    parts = [
        lathe([(0, 0), (0.95, 0), (1, 0.1), (1, height), (0.93, height), (0.9, 0.12), (0, 0.1)], 0, 28, wraps(random))
    ]
    kind = random.integers(3)
    if kind == 0:
        parts.append(tube([(0.95, 0, height * 0.8), (1.7, 0, height * 0.9), (2.5, 0, height)], 0.11, 1))
    elif kind == 1:
        parts += [tube(arc((0, 0, height * 0.75), (s * 1.28, 0.2), -0.9, 0.9), 0.08, 1) for s in (-1, 1)]
        parts += [
            lathe([(1.02, height), (0.5, height + 0.25), (0, height + 0.3)], 2),
            ball(0.14, (0, 0, height + 0.4), 1, 10),
        ]
    else:
        parts += [
            lathe([(1, height), (0.6, height + 0.35), (0, height + 0.45)], 0),
            tube(arc((0, 0, height), (0.8, 1.1), 0.4, 2.7), 0.09, 1),
        ]
        parts.append(tube([(0.9, 0, height * 0.4), (1.35, 0, height * 0.7), (1.6, 0, height * 1.05)], 0.14, 0))
    return parts


def teapot(random: Random) -> list[Part]:
    """A round pot with spout, handle and lid."""
    flat = random.uniform(0.65, 1.1)
    return [
        blob((1, 1, flat), (0, 0, flat)), ball(0.15, (0, 0, 2.05 * flat), 1, 10),
        lathe([(0.5, 1.85 * flat), (0, 2 * flat)], 1),
        tube([(0.8, 0, 0.75 * flat), (1.35, 0, flat), (1.65, 0, random.uniform(1.4, 1.9) * flat)], 0.16, 0),
        tube([(x, 0, z * flat) for x, z in ((-0.85, 1.4), (-1.45, 1.5), (-1.5, 0.9), (-0.9, 0.5))],
             0.1, int(random.integers(0, 2))),
    ]  # fmt: skip


def goblet(random: Random) -> list[Part]:
    """A glass, egg cup or trophy on a stem."""
    stem, cup_height = random.uniform(0.5, 1.8), random.uniform(0.8, 1.8)
    low, high = stem, stem + cup_height
    outline = [
        (0, 0),
        (0.75, 0),
        (0.7, 0.08),
        (0.1, 0.2),
        (0.1, low),
        (0.75, low + 0.3 * cup_height),
        (random.uniform(0.7, 1.1), high),
    ]
    parts = [
        lathe(
            [*outline, (outline[-1][0] - 0.06, high), (0.66, low + 0.35 * cup_height), (0, low + 0.12)],
            0,
            28,
            wraps(random),
        )
    ]
    if random.random() < 0.4:
        parts.append(lathe([(0, low + 0.6 * cup_height), (0.8, low + 0.6 * cup_height)], 1))
    return parts


def fruit(random: Random) -> list[Part]:
    """An apple, pear, orange, lemon, egg, tomato, melon or onion, with a stalk and leaf or none."""
    t = np.linspace(0, np.pi, 18)
    pinch, stretch, dent = random.uniform(-0.35, 0.25), random.uniform(0.75, 1.35), random.uniform(0, 0.3)
    radius = np.sin(t) ** random.uniform(0.8, 1.1) * (1 - pinch * np.cos(t))
    height = -np.cos(t) * stretch - dent * np.exp(-((t - np.pi) ** 2) / 0.2) + dent * 0.5 * np.exp(-(t**2) / 0.2)
    parts = [lathe(np.c_[radius, height].tolist(), 0, 26, wraps(random))]
    top = float(height[-1])
    if random.random() < 0.55:
        parts.append(
            tube(
                [(0, 0, top - 0.05), (0.05, 0, top + 0.2), (random.uniform(0, 0.3), 0, top + 0.45)],
                random.uniform(0.04, 0.08),
                1,
                6,
            )
        )
        if random.random() < 0.5:
            parts.append(blob((0.4, 0.2, 0.04), (0.4, 0, top + 0.25), 2, 10))
    if random.random() < 0.3:
        parts = [turned(part, about_y(random.uniform(0.5, 1.6))) for part in parts]
    return grounded(parts)


def banana(random: Random) -> list[Part]:
    """A bent fruit, sausage or bean that lies on its side; perhaps several."""
    parts: list[Part] = []
    for k in range(int(random.choice((1, 1, 2, 4)))):
        bend = arc((0, 0, 0), (1.6, 1.6), random.uniform(0.4, 0.8), random.uniform(2.0, 2.7), 12)
        along = np.linspace(-1, 1, 12)
        made = tube(bend, 1.0, 0, 10)
        thick = 0.34 * np.sqrt(np.maximum(0.02, 1 - along**4)) + 0.02
        centre = np.repeat(bend, 10, axis=0)
        vertices = centre + (made.vertices - centre) * np.repeat(thick, 10)[:, None]
        lying = vertices[:, [0, 2, 1]] * (1, -1, 1) + (0, 0.28 * k, 0.1 * k)
        parts.append(Part(lying, made.faces, made.texture, 0))
    return grounded(parts)


def plant(random: Random) -> list[Part]:
    """A potted plant: leaves as blobs, blades or a crown on a stem."""
    height, kind = random.uniform(0.7, 1.4), random.integers(3)
    parts = [
        lathe(
            [(0, 0), (0.55, 0), (0.85, height), (0.92, height), (0.75, height), (0, height * 0.9)], 0, 24, wraps(random)
        )
    ]
    count = int(random.integers(6, 16))
    for _ in range(count):
        angle, lean, length = random.uniform(0, 2 * np.pi), random.uniform(0.1, 1.2), random.uniform(0.9, 2.2)
        out = np.array([np.cos(angle) * np.sin(lean), np.sin(angle) * np.sin(lean), np.cos(lean)])
        tip = out * length + (0, 0, height)
        if kind == 0:
            parts.append(blob(tuple(random.uniform(0.2, 0.6, 3)), tuple(tip * (0.6, 0.6, 0.8)), 1, 9))
        elif kind == 1:
            middle = out * length * 0.5 + (0, 0, height + 0.25)
            blade = tube(
                [(0, 0, height * 0.9), middle, tip], random.uniform(0.05, 0.13), 1 + int(random.integers(0, 2)), 5
            )
            parts.append(blade)
        else:
            parts.append(tube([(0, 0, height * 0.9), tip], 0.03, 2, 4))
            parts.append(blob((0.3, 0.22, 0.1), tuple(tip), 1, 8))
    if kind == 0 and random.random() < 0.4:
        parts = [*parts[:1], rod(0.1, 1.2, (0, 0, height + 0.4), 2, 2), *(moved(p, 0, 0, 0.8) for p in parts[1:])]
    return parts


def lamp(random: Random) -> list[Part]:
    """A table lamp, or an hourglass-like stand."""
    height = random.uniform(2, 3.5)
    return [
        rod(0.6, 0.15, (0, 0, 0.08), 2, 0), rod(0.08, height, (0, 0, height / 2), 2, 0),
        lathe([(1, height * 0.7), (random.uniform(0.4, 0.9), height), (0, height)], 1, 24, wraps(random)),
        *([box((0.4, 0.4, 0.7), (0, 0, 0.5), 2)] if random.random() < 0.3 else []),
    ]  # fmt: skip
