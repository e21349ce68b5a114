"""Things turned on a lathe: cups, bowls, bottles, tins, pots, and what has handles, labels or liquid."""

import numpy as np

from .meshes import Part, Random, about_z, arc, ball, blob, lathe, rod, tube, turned


def wraps(random: Random) -> tuple[int, int]:
    """How often a texture goes around and along."""
    return int(random.integers(1, 5)), int(random.integers(1, 4))


def smooth_profile(random: Random, height: float, knots: int, least: float = 0.3) -> np.ndarray:
    """A wavy outline (26, 2) of radius about 1 from the ground to `height`."""
    radii = np.clip(1 + np.cumsum(random.normal(0, 0.33, knots)), least, 1.6)
    at = np.sort(np.r_[0, random.uniform(0, 1, knots - 2), 1]) * height
    z = np.linspace(0, height, 26)
    bent = np.interp(z, at, radii)
    return np.c_[np.convolve(np.pad(bent, 2, "edge"), np.ones(5) / 5, "valid"), z]


def handle(random: Random, at: float, middle: float, height: float, slot: int) -> Part:
    """An ear on the side of a vessel of radius `at`."""
    reach, thick = random.uniform(0.4, 0.75), random.uniform(0.07, 0.16)
    if random.random() < 0.3:
        x = at + reach
        path = [
            (at - 0.1, 0, middle + height),
            (x, 0, middle + height),
            (x, 0, middle - height),
            (at - 0.1, 0, middle - height),
        ]
        return tube(path, thick, slot)
    return tube(arc((at - 0.08, 0, middle), (reach, height), -1.4, 1.4), thick, slot)


def cup(random: Random) -> list[Part]:
    """A cup, mug, tankard or jug, with a handle or none, empty or full."""
    height, foot = random.uniform(1.2, 3.0), random.uniform(0.5, 1.0)
    belly = random.uniform(0.9, 1.15)
    outside = [(0, 0), (foot, 0), (max(foot, 0.5 * (foot + 1) * belly), height * 0.45), (1, height)]
    parts = [lathe([*outside, (0.9, height), (foot * 0.88, 0.12), (0, 0.12)], 0, 28, wraps(random))]
    if random.random() < 0.7:
        parts.append(
            handle(
                random,
                outside[2][0],
                height * random.uniform(0.42, 0.6),
                height * random.uniform(0.22, 0.36),
                int(random.integers(0, 2)),
            )
        )
    if random.random() < 0.4:
        parts.append(lathe([(0, height * 0.85), (0.93, height * 0.85)], 2))
    if random.random() < 0.2:
        parts.append(lathe([(0, 0), (1.7, 0.1), (1.75, 0.16), (0, 0.05)], 0))
    return parts


def bowl(random: Random) -> list[Part]:
    """A bowl, dish or plate, perhaps with fruit in it."""
    depth, foot = np.exp(random.uniform(np.log(0.12), np.log(0.95))), random.uniform(0.3, 0.6)
    rim = random.uniform(1.0, 1.08)
    outside = [(0, 0), (foot, 0), (0.75, 0.25 * depth), (0.93, 0.6 * depth), (rim, depth)]
    inside = [(rim - 0.07, depth), (0.85, 0.6 * depth), (0.65, 0.32 * depth), (0, 0.14 * depth)]
    parts = [lathe(outside + inside, 0, 32, wraps(random))]
    if random.random() < 0.2:
        for _ in range(int(random.integers(2, 7))):
            x, y = random.uniform(-0.45, 0.45, 2)
            parts.append(
                ball(
                    random.uniform(0.2, 0.38),
                    (x, y, depth * 0.5 + random.uniform(0.3, 0.5)),
                    int(random.integers(1, 4)),
                    12,
                )
            )
    return parts


def vase(random: Random) -> list[Part]:
    """A vase, urn or jar with a wavy outline, perhaps with bands, ears or flowers."""
    height = random.uniform(1.6, 4)
    outline = smooth_profile(random, height, int(random.integers(4, 9)))
    lip = [(outline[-1, 0] * 0.85, height), (outline[-5, 0] * 0.8, outline[-5, 1])]
    parts = [lathe([(0, 0), *outline.tolist(), *lip], 0, 28, wraps(random))]
    if random.random() < 0.35:
        k = int(random.integers(3, 18))
        band = outline[k : k + int(random.integers(2, 8))]
        parts.append(lathe((band * (1.02, 1)).tolist(), 1, 28, wraps(random)))
    if random.random() < 0.2:
        k = int(random.integers(9, 17))
        ear = handle(random, outline[k, 0], outline[k, 1], height * 0.14, 0)
        parts += [ear, turned(ear, about_z(np.pi))]
    if random.random() < 0.2:
        parts += stalks(random, height * 0.9, 0.3)
    return parts


def stalks(random: Random, base: float, spread: float) -> list[Part]:
    """Stems with blossoms above a vessel's mouth."""
    parts: list[Part] = []
    for _ in range(int(random.integers(2, 8))):
        lean = random.normal(0, 0.35, 2)
        top = np.array([*(lean * 1.6), base + random.uniform(0.8, 2.2)])
        start = np.array([*(lean * spread * 0.3), base - 0.2])
        parts.append(tube([start, (start + top) / 2 + (0, 0, 0.2), top], 0.04, 2, 5))
        parts.append(blob(tuple(random.uniform(0.12, 0.35, 3)), tuple(top), 3, 10))
    return parts


def bottle(random: Random) -> list[Part]:
    """A bottle of one, two or three colours: label, cap, liquid up to some height."""
    height, neck = random.uniform(2.6, 5.5), random.uniform(0.2, 0.5)
    shoulder, slope = random.uniform(0.45, 0.75) * height, random.uniform(0.03, 0.2) * height
    waist = random.uniform(0.75, 1.05) if random.random() < 0.3 else 1.0
    body = [(0, 0), (0.95, 0), (1, 0.04 * height), (waist, shoulder * 0.5), (1, shoulder)]
    neck_part = [(0.6 * (1 + neck), shoulder + slope * 0.5), (neck, shoulder + slope)]
    throat = [(neck, 0.95 * height), (neck + 0.05, 0.95 * height), (neck + 0.05, height), (0, height)]
    parts = [lathe([*body, *neck_part, *throat], 0, 28, wraps(random))]
    if random.random() < 0.65:
        low, high = np.sort(random.uniform(0.08, 0.95, 2)) * shoulder
        parts.append(lathe([(1.02, low), (1.02, max(high, low + 0.2))], 1, 28, (int(random.integers(1, 3)), 1)))
    if random.random() < 0.6:
        length = random.uniform(0.05, 0.2) * height
        parts.append(rod(neck + random.uniform(0.06, 0.2), length, (0, 0, height - length * 0.3), 2, 2))
    if random.random() < 0.25:
        level = random.uniform(0.2, 0.9) * shoulder
        parts.append(lathe([(1.008, 0.02), (1.008, level)], 3))
    return parts


def can(random: Random) -> list[Part]:
    """A tin, jar with a lid, glass with liquid, candle, or plain cylinder."""
    height = np.exp(random.uniform(np.log(0.35), np.log(3.6)))
    top = random.choice((1.0, 1.0, random.uniform(0.7, 1.2)))
    parts = [lathe([(0, 0), (1, 0), (top, height), (0, height)], 0, 28, wraps(random))]
    kind = random.integers(5)
    if kind == 0:
        parts += [lathe([(r, z), (r * 1.03, z + 0.05), (r, z + 0.1)], 2) for r, z in ((1, 0), (top, height - 0.1))]
    elif kind == 1:
        parts.append(rod(top * 1.04, height * 0.18 + 0.1, (0, 0, height), 2, 1))
        parts += [ball(0.18, (0, 0, height * 1.09 + 0.15), 1, 10)] if random.random() < 0.5 else []
    elif kind == 2:
        parts += [lathe([(1.01, height * 0.1), (1.01, height * 0.75)], 1), rod(0.04, 0.4, (0, 0, height + 0.1), 2, 2)]
    elif kind == 3:
        parts.append(
            lathe(
                [(1.01, height * random.uniform(0.1, 0.3)), (1.01, height * random.uniform(0.5, 0.9))],
                1,
                28,
                wraps(random),
            )
        )
    return parts


def pail(random: Random) -> list[Part]:
    """A bucket, waste bin, flower pot or basket, open at the top."""
    height, foot = random.uniform(1.2, 2.4), random.uniform(0.6, 0.95)
    parts = [
        lathe(
            [
                (0, 0),
                (foot, 0),
                (1, height),
                (1.05, height),
                (1.05, height * 0.9),
                (0.93, height * 0.9),
                (foot * 0.9, 0.1),
                (0, 0.1),
            ],
            0,
            28,
            wraps(random),
        )
    ]
    if random.random() < 0.6:
        parts.append(
            tube(
                arc((0, 0, height), (1.02, random.uniform(0.2, 1.0) * random.choice((-1, 1, 1))), 0, np.pi, 16), 0.05, 1
            )
        )
    if random.random() < 0.25:
        parts.append(lathe([(0, height * 0.85), (0.95, height * 0.85)], 2))
    return parts
