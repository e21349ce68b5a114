"""Colours, noise, and textures of floors, cloths and walls that tempt an eye to see things where there are none."""

from collections.abc import Sequence

import cv2
import numpy as np

from .meshes import Random

ROOM, SKIN = 512, 128
"""Texels of a side: of what surrounds things, and of things."""
WOODS = ((150, 104, 64), (96, 60, 38), (196, 156, 108), (84, 64, 52), (176, 112, 66), (216, 190, 154), (128, 122, 116))


def noise(
    random: Random, size: int, octaves: int = 5, stretch: Sequence[float] | np.ndarray = (1.0, 1.0), first: int = 2
) -> np.ndarray:
    """Cloudy noise (size, size) with mean 0 and deviation 1; `stretch` are the cells' counts down and across."""
    made = np.zeros((size, size), np.float32)
    for k in range(octaves):
        cells = [int(np.clip(2 ** (k + first) * s, 2, size)) for s in stretch]
        layer = random.standard_normal(cells, dtype=np.float32)
        made += cv2.resize(layer, (size, size), interpolation=cv2.INTER_CUBIC) / 1.8**k
    return (made - made.mean()) / (made.std() + 1e-6)


def colour(random: Random, *, is_bright: bool = False) -> np.ndarray:
    """A colour (3,) of 0 to 255 of any hue: few are garish, or many if it is to be a bright one."""
    hue, value = 180 * random.random(), 255 * random.beta(2.4, 1.2)
    saturation = 255 * (random.beta(1.3, 1.0) if is_bright else random.beta(1.0, 2.0))
    return cv2.cvtColor(np.array([[[hue, saturation, value]]], np.uint8), cv2.COLOR_HSV2RGB)[0, 0].astype(np.float32)


def two_colours(random: Random) -> tuple[np.ndarray, np.ndarray]:
    """Two colours, often shades of one or one with white or black."""
    first, kind = colour(random, is_bright=random.random() < 0.4), random.random()
    if kind < 0.35:
        return first, np.clip(first * random.uniform(0.4, 1.6), 0, 255)
    if kind < 0.6:
        return first, np.full(3, random.choice((15.0, 235.0)), np.float32)
    return first, colour(random)


def mixed(random: Random, share: np.ndarray, grain: float = 0.0) -> np.ndarray:
    """Two colours mixed by a map (n, n) of 0 to 1, as uint8 (n, n, 3)."""
    first, second = two_colours(random)
    made = first * share[..., None] + second * (1 - share[..., None])
    return finished(made * (1 + grain * noise(random, len(share))[..., None]))


def finished(values: np.ndarray) -> np.ndarray:
    """Values as a texture (n, n, 3) uint8."""
    return np.clip(values, 0, 255).astype(np.uint8)


def grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (size, size) of 0 to 1."""
    return tuple(np.mgrid[:size, :size].astype(np.float32) / size)  # type: ignore[return-value]


def wood_colour(random: Random) -> np.ndarray:
    """A wood's colour, seldom painted."""
    if random.random() < 0.15:
        return colour(random)
    return np.array(WOODS[random.integers(len(WOODS))], np.float32) * random.uniform(0.7, 1.15)


def planks(random: Random) -> np.ndarray:
    """Boards with grain and gaps; their shades differ little or much."""
    y, x = grid(ROOM)
    rows = int(random.integers(3, 12))
    row = np.minimum((y * rows).astype(int), rows - 1)
    length, spread = random.uniform(0.25, 1.2), random.uniform(0.03, 0.4)
    shift = random.uniform(0, 1, rows)[row]
    board = ((x + shift) / length).astype(int) % 16
    tone = np.exp(random.normal(0, spread, (rows, 16)))[row, board]
    warm = random.normal(0, spread * 0.15, (rows, 16))[row, board]
    grain = 1 + random.uniform(0.03, 0.14) * noise(random, ROOM, 5, (4, 0.4), 3)
    gap = ((y * rows) % 1 < random.uniform(0, 0.03)) | ((x + shift) % length < 0.004)
    light = np.where(gap, random.uniform(0.3, 0.8), tone * grain)
    return finished(wood_colour(random) * light[..., None] * (1 + warm[..., None] * np.array([1, 0, -1])))


def grained(random: Random) -> np.ndarray:
    """One broad board: a table top of wood."""
    y, _ = grid(ROOM)
    waves = np.sin((y * random.uniform(4, 25) + noise(random, ROOM, 4, (2, 0.3)) * random.uniform(0.1, 0.6)) * 6.28)
    light = 1 + random.uniform(0.02, 0.2) * waves + 0.05 * noise(random, ROOM, 5, (5, 0.3), 3)
    return finished(wood_colour(random) * light[..., None])


def parquet(random: Random) -> np.ndarray:
    """Short blocks in a basket weave."""
    y, x = grid(ROOM)
    cells, strips = int(random.integers(3, 8)), int(random.integers(3, 7))
    cell_y, cell_x = (y * cells).astype(int), (x * cells).astype(int)
    across = (cell_y + cell_x) % 2 == 0
    strip = np.where(across, (y * cells * strips) % strips, (x * cells * strips) % strips).astype(int)
    tone = np.exp(random.normal(0, random.uniform(0.05, 0.3), (cells, cells, strips)))[cell_y, cell_x, strip]
    return finished(wood_colour(random) * (tone * (1 + 0.06 * noise(random, ROOM)))[..., None])


def tiles(random: Random) -> np.ndarray:
    """Square or oblong tiles with joints, of one colour or two by turns."""
    y, x = grid(ROOM)
    rows = int(random.integers(1, 5)) * 2
    columns = rows if random.random() < 0.7 else max(2, rows // 2)
    cell_y, cell_x = (y * rows).astype(int), (x * columns).astype(int)
    first, second = two_colours(random)
    if random.random() < 0.5:
        second = first
    tone = np.exp(random.normal(0, random.uniform(0.01, 0.15), (rows, columns)))[cell_y, cell_x]
    base = np.where(((cell_y + cell_x) % 2 == 0)[..., None], first, second)
    joint = ((y * rows) % 1 < 0.03) | ((x * columns) % 1 < 0.03)
    light = tone * (1 + random.uniform(0, 0.12) * noise(random, ROOM))
    return finished(np.where(joint[..., None], colour(random), base * light[..., None]))


def marble(random: Random) -> np.ndarray:
    """Stone with veins or clouds."""
    first, second = two_colours(random)
    if random.random() < 0.6:
        first, second = (
            np.full(3, random.uniform(150, 240)) * random.uniform(0.92, 1.0, 3),
            np.full(3, random.uniform(40, 150)),
        )
    veins = np.zeros((ROOM, ROOM), np.float32)
    for _ in range(int(random.integers(1, 4))):
        cloud = noise(random, ROOM, int(random.integers(3, 6)), random.uniform(0.5, 2, 2), int(random.integers(1, 3)))
        veins = np.maximum(veins, np.exp(-np.abs(cloud) / random.uniform(0.02, 0.3)))
    share = veins * random.uniform(0.2, 0.9)
    stone = first * (1 - share[..., None]) + second * share[..., None]
    return finished(stone * (1 + 0.03 * noise(random, ROOM)[..., None]))


def checked(random: Random) -> np.ndarray:
    """A gingham, tartan or chess-board cloth."""
    y, x = grid(ROOM)
    count, kind = int(random.integers(2, 9)), random.integers(3)
    down, across = ((v * count) % 1 < 0.5 for v in (y, x))
    if kind == 0:
        share = (down.astype(np.float32) + across) / 2
    elif kind == 1:
        share = (down ^ across).astype(np.float32)
    else:
        bands = np.repeat(random.uniform(0, 1, 12), ROOM // 12 + 1)[:ROOM]
        share = (bands[:, None] + bands[None]) / 2
    if random.random() < 0.5:
        share = share * (0.95 + 0.05 * np.sin(x * ROOM * 1.6) * np.sin(y * ROOM * 1.6))
    return mixed(random, share, 0.02)


def carpet(random: Random) -> np.ndarray:
    """Pile, felt, sand, grass, concrete or plaster: grain and large clouds."""
    fine = random.standard_normal((ROOM, ROOM)).astype(np.float32) * random.uniform(0, 0.2)
    light = 1 + fine + random.uniform(0, 0.2) * noise(random, ROOM, 6, random.uniform(0.5, 2, 2), 1)
    return finished(colour(random) * light[..., None])


def ornament(random: Random) -> np.ndarray:
    """A rug or wallpaper: a border and repeated figures."""
    made = finished(np.broadcast_to(colour(random), (ROOM, ROOM, 3)))
    count, ink = int(random.integers(3, 10)), [colour(random).tolist() for _ in range(3)]
    step, kind = ROOM // count, random.integers(4)
    for i in range(count):
        for j in range(count):
            middle, r = (step * i + step // 2, step * j + step // 2), int(step * random.uniform(0.2, 0.45))
            if kind == 0:
                cv2.circle(made, middle, r, ink[(i + j) % 3], -1, cv2.LINE_AA)
            elif kind == 1:
                cv2.ellipse(made, middle, (r, r // 3 + 1), 45 * (i + j), 0, 360, ink[(i + j) % 2], -1, cv2.LINE_AA)
            elif kind == 2:
                cv2.rectangle(made, (middle[0] - r, middle[1] - r), (middle[0] + r, middle[1] + r), ink[(i * j) % 3], 4)
            else:
                cv2.drawMarker(made, middle, ink[i % 3], int(random.integers(0, 6)), r, 5)
    if random.random() < 0.6:
        cv2.rectangle(made, (20, 20), (ROOM - 20, ROOM - 20), ink[0], int(random.integers(4, 40)))
    return made


def bricks(random: Random) -> np.ndarray:
    """Courses of bricks or shingles."""
    y, x = grid(ROOM)
    rows, columns = 2 * int(random.integers(3, 10)), int(random.integers(2, 8))
    row = (y * rows).astype(int)
    shift = x * columns + 0.5 * (row % 2)
    tone = np.exp(random.normal(0, random.uniform(0.03, 0.25), (rows, columns + 1)))[row, shift.astype(int)]
    joint = ((y * rows) % 1 < 0.12) | (shift % 1 < 0.05)
    light = tone * (1 + 0.12 * noise(random, ROOM, 6, (1, 1), 3))
    return finished(np.where(joint[..., None], colour(random), colour(random) * light[..., None]))
