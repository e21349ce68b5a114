"""Things with corners: cartons, books, parcels, houses, stools, chairs, tools and heaps of simple solids."""

import numpy as np

from .meshes import (
    Part,
    Random,
    about_y,
    about_z,
    any_turn,
    ball,
    blob,
    box,
    extrude,
    grounded,
    lathe,
    moved,
    rod,
    tube,
    turned,
)


def carton(random: Random) -> list[Part]:
    """A box: a cube, brick, slab, or carton with a label, a lid, tape or a print on every face."""
    size = (
        random.uniform(1.4, 2.2, 3) if random.random() < 0.4 else np.exp(random.uniform(np.log(0.35), np.log(2.8), 3))
    )
    x, y, z = (float(v) for v in size)
    parts = [box(size, (0, 0, z / 2), 0, int(random.integers(1, 4)))]
    kind = random.integers(6)
    if kind == 0:
        parts.append(box((x * 1.01, y * random.uniform(0.1, 0.3), z * 1.01), (0, 0, z / 2), 1))
    elif kind == 1:
        label = (x * random.uniform(0.4, 0.9), y * 1.012, z * random.uniform(0.3, 0.8))
        parts.append(box(label, (0, 0, z * random.uniform(0.4, 0.6)), 1))
    elif kind == 2:
        lid = z * random.uniform(0.1, 0.35)
        parts.append(box((x * 1.05, y * 1.05, lid), (0, 0, z - lid * 0.4), 1))
    elif kind == 3:
        low, high = np.sort(random.uniform(0.05, 0.95, 2)) * z
        parts.append(box((x * 1.01, y * 1.01, high - low + 0.05), (0, 0, (low + high) / 2), 1))
    return parts


def milk_carton(random: Random) -> list[Part]:
    """A tall carton with a roof, a band and perhaps a cap."""
    height, roof = random.uniform(2.2, 3.6), random.uniform(0.4, 0.9)
    gable = moved(
        extrude([(-0.75, 0), (0.75, 0), (0.05, roof), (-0.05, roof)], 1.5, int(random.integers(0, 3))), 0, 0, height
    )
    parts = [box((1.5, 1.5, height), (0, 0, height / 2)), gable, box((0.1, 1.5, 0.35), (0, 0, height + roof + 0.1), 1)]
    low, high = np.sort(random.uniform(0.1, 0.9, 2)) * height
    parts.append(box((1.52, 1.52, high - low + 0.2), (0, 0, (low + high) / 2), 1))
    if random.random() < 0.4:
        parts.append(rod(0.22, 0.3, (0.45, 0, height + roof * 0.6), 2, 2))
    return parts


def one_book(random: Random, width: float, depth: float, thick: float, slots: tuple[int, int]) -> list[Part]:
    """A closed book that lies on z = 0: two covers, a spine and pages."""
    cover, pages = slots
    board = min(0.06, thick * 0.15)
    parts = [box((width, depth, board), (0, 0, z), cover) for z in (board / 2, thick - board / 2)]
    parts.append(box((board, depth, thick), (-width / 2, 0, thick / 2), cover))
    parts.append(box((width * 0.95, depth * 0.96, thick * 0.9), (-0.01 * width, 0, thick / 2), pages))
    if random.random() < 0.4:
        parts.append(box((width * 0.6, depth * 0.5, thick * 1.01), (0, 0, thick / 2 + 0.005), 2))
    return parts


def book(random: Random) -> list[Part]:
    """A book lying, standing or in a pile of several."""
    count = int(random.choice((1, 1, 1, 2, 3, 4)))
    parts: list[Part] = []
    top, slots = 0.0, ((0, 3), (1, 3), (2, 3), (0, 3))
    for k in range(count):
        width, depth, thick = random.uniform(1.2, 1.8), random.uniform(1.7, 2.4), random.uniform(0.15, 0.55)
        turn = about_z(random.normal(0, 0.12 if count > 1 else 0.0))
        parts += [moved(turned(part, turn), 0, 0, top) for part in one_book(random, width, depth, thick, slots[k])]
        top += thick
    if count == 1 and random.random() < 0.3:
        parts = grounded([turned(part, about_y(np.pi / 2)) for part in parts])
    return parts


def parcel(random: Random) -> list[Part]:
    """A present with ribbons and a bow."""
    x, y, z = (float(v) for v in random.uniform(0.9, 2.2, 3))
    band = random.uniform(0.08, 0.22)
    parts = [box((x, y, z), (0, 0, z / 2)), box((x * 1.01, y * band, z * 1.01), (0, 0, z / 2), 1)]
    parts.append(box((x * band, y * 1.01, z * 1.01), (0, 0, z / 2), 1))
    if random.random() < 0.8:
        loop = random.uniform(0.1, 0.25) * x
        parts += [blob((loop * 1.3, loop * 0.6, loop * 0.7), (s * loop, 0, z + loop * 0.5), 1, 12) for s in (-1, 1)]
    return parts


def house(random: Random) -> list[Part]:
    """A toy house or a bird house."""
    x, y, z = random.uniform(1, 2), random.uniform(1, 2), random.uniform(0.8, 1.8)
    roof = extrude([(-x * 0.6, 0), (x * 0.6, 0), (0, random.uniform(0.5, 1.4))], y * 1.15, 1)
    door = box((x * 0.3, y * 1.02, z * 0.5), (0, 0, z * 0.25), 2)
    return [box((x, y, z), (0, 0, z / 2)), moved(roof, 0, 0, z), door]


def prism(random: Random) -> list[Part]:
    """A prism, star, letter-like block, ramp or arch, lying or upright."""
    kind, width = random.integers(4), random.uniform(0.4, 2)
    if kind == 0:
        outline = [(-1.3, 0), (1.3, 0), (1.3, random.uniform(0.6, 1.6))]
    elif kind == 1:
        outline = [(-1, 0), (-0.5, 0), (-0.5, 0.8), (0.5, 0.8), (0.5, 0), (1, 0), (1, 1.5), (-1, 1.5)]
    else:
        count = int(random.integers(3, 8))
        radii = np.ones(count) if kind == 2 else np.where(np.arange(2 * count) % 2, random.uniform(0.35, 0.7), 1.0)
        angle = np.linspace(0, 2 * np.pi, len(radii), endpoint=False) + random.uniform(0, 1)
        outline = np.c_[radii * np.cos(angle), radii * np.sin(angle)].tolist()
    made = extrude(outline, width, 0)
    if random.random() < 0.5:
        quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        made = turned(made, quarter)
    return grounded([made])


def pyramid(random: Random) -> list[Part]:
    """A pyramid, cone, traffic cone or spinning top."""
    sides, height, tip = (
        int(random.choice((3, 4, 5, 28, 28))),
        random.uniform(1, 3),
        random.choice((0.0, 0.0, random.uniform(0, 0.6))),
    )
    parts = [lathe([(0, 0), (1, 0), (tip, height), (0, height)], 0, sides, (int(random.integers(1, 4)), 1))]
    if random.random() < 0.3:
        parts.append(box((2.3, 2.3, 0.14), (0, 0, 0.07), 1))
    if random.random() < 0.3:
        low, high = 0.35, 0.6
        band = [(1 + (tip - 1) * t + 0.015, height * t) for t in (low, high)]
        parts.append(lathe(band, 2, sides))
    return parts


def stool(random: Random) -> list[Part]:
    """A stool, small table or chair with three, four or one legs."""
    height, is_round = random.uniform(1.2, 3), random.random() < 0.5
    thick = random.uniform(0.12, 0.35)
    seat = rod(1, thick, (0, 0, height)) if is_round else box((2, random.uniform(1.2, 2.4), thick), (0, 0, height))
    parts, legs, reach = [seat], int(random.choice((1, 3, 4, 4, 4))), 0.62 if is_round else 0.82
    if legs == 1:
        parts += [rod(0.15, height, (0, 0, height / 2), 2, 1), rod(0.75, 0.12, (0, 0, 0.06), 2, 1)]
    for k in range(legs if legs > 1 else 0):
        angle = 2 * np.pi * (k + 0.5) / legs
        way = np.array([np.cos(angle), np.sin(angle)])
        x, y = reach * (way if is_round else np.sign(way))
        splay = random.uniform(1.0, 1.25)
        parts.append(tube([(x * splay, y * splay * 0.7, 0), (x, y * 0.7, height)], random.uniform(0.07, 0.12), 1, 8))
    if random.random() < 0.35:
        back = random.uniform(0.5, 1.4)
        parts.append(box((0.14, 1.7, back * 0.6), (-0.85, 0, height + back), 0))
        parts += [box((0.14, 0.14, back + 0.6), (-0.85, y, height + back / 2), 1) for y in (-0.7, 0.7)]
    return parts


def tool(random: Random) -> list[Part]:
    """Something long that lies: a hammer, brush, spoon, pen, torch or bat."""
    length, thick = random.uniform(2, 4), random.uniform(0.08, 0.25)
    parts = [rod(thick, length, (0, 0, 0), 0, 0, thick * random.uniform(0.6, 1.2))]
    end, kind = length / 2, random.integers(4)
    if kind == 0:
        parts.append(box((0.5, random.uniform(0.8, 1.6), 0.4), (end, 0, 0), 1))
    elif kind == 1:
        parts.append(blob((0.6, 0.4, 0.15), (end + 0.3, 0, 0), 1, 14))
    elif kind == 2:
        parts.append(rod(thick * 1.6, length * 0.35, (end, 0, 0), 0, 1, thick * 2.4))
    else:
        parts.append(rod(thick * 1.02, length * 0.3, (end, 0, 0), 0, 1, 0.01))
    return grounded(parts)


def ring(random: Random) -> list[Part]:
    """A ring, tyre, wheel or horseshoe, lying or upright."""
    thick, angle = random.uniform(0.12, 0.42), np.linspace(0, 2 * np.pi if random.random() < 0.8 else 4.4, 28)
    made = tube(np.c_[np.cos(angle), np.sin(angle), 0 * angle], thick, 0, 10)
    if random.random() < 0.4:
        made = Part(made.vertices[:, [0, 2, 1]] * (1, -1, 1), made.faces, made.texture, 0)
    return grounded([made])


def heap(random: Random) -> list[Part]:
    """Simple solids put together: a thing of no name."""
    parts: list[Part] = []
    for k in range(int(random.integers(2, 6))):
        x, y, z = random.uniform(-0.7, 0.7), random.uniform(-0.7, 0.7), random.uniform(0.2, 1.6)
        size, kind, slot = random.uniform(0.3, 0.9), random.integers(4), k % 4
        if kind == 0:
            parts.append(blob(tuple(size * random.uniform(0.6, 1.3, 3)), (x, y, z), slot))
        elif kind == 1:
            parts.append(moved(turned(box(random.uniform(0.4, 1.6, 3), (0, 0, 0), slot), any_turn(random)), x, y, z))
        elif kind == 2:
            parts.append(rod(size * 0.7, random.uniform(0.4, 2), (x, y, z), int(random.integers(3)), slot))
        else:
            parts.append(ball(size, (x, y, z), slot))
    return grounded(parts)


def tower(random: Random) -> list[Part]:
    """Blocks, discs or cups on top of each other, seen as one thing."""
    parts: list[Part] = []
    top, size = 0.0, 1.0
    for k in range(int(random.integers(2, 6))):
        height = random.uniform(0.3, 0.8)
        middle = (random.normal(0, 0.06), random.normal(0, 0.06), top + height / 2)
        parts.append(
            rod(size, height, middle, 2, k % 4)
            if random.random() < 0.6
            else box((size * 1.7, size * 1.7, height), middle, k % 4)
        )
        top, size = top + height, size * random.uniform(0.7, 1.0)
    return parts
