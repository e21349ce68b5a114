"""Cars, trucks, trains, planes and boats."""

from dataclasses import replace

from .meshes import Part, Random, about_y, ball, blob, box, extrude, grounded, lathe, moved, rod, turned


def wheels(at: list[tuple[float, float]], radius: float, width: float) -> list[Part]:
    """Tyres and hubs at (x, y)."""
    parts: list[Part] = []
    for x, y in at:
        parts.append(rod(radius, width, (x, y, radius), 1, 2))
        parts.append(rod(radius * 0.55, width * 1.08, (x, y, radius), 1, 3))
    return parts


def car(random: Random) -> list[Part]:
    """A car, van, jeep, racing car or bus from a drawn outline."""
    length, jitter = 2.6, random.uniform(-0.04, 0.04, 8)
    width, floor = length * random.uniform(0.36, 0.5), random.uniform(0.06, 0.12)
    hood, roof = random.uniform(0.2, 0.3), random.uniform(0.36, 0.52)
    front, back = random.uniform(0.1, 0.42), random.uniform(-0.48, -0.15)
    outline = [
        (-0.5, floor), (-0.5, hood + jitter[0]), (back - 0.06, hood + 0.02), (back, roof),
        (front - 0.18, roof + jitter[1] * 0.3), (front, hood + 0.02), (0.47, hood - 0.03 + jitter[2]),
        (0.5, floor + 0.04), (0.5, floor),
    ]  # fmt: skip
    glass = [
        (back - 0.02, hood + 0.03),
        (back + 0.02, roof - 0.03),
        (front - 0.19, roof - 0.03),
        (front - 0.04, hood + 0.03),
    ]
    parts = [
        extrude([(x * length, z * length) for x, z in points], wide, slot)
        for slot, (points, wide) in enumerate(((outline, width), (glass, width * 1.015)))
    ]
    pane = turned(box((0.02, width * 0.82, 0.15 * length)), about_y(-0.7))
    parts.append(moved(replace(pane, slot=1), (front - 0.085) * length, 0, (hood + roof) / 2 * length))
    radius = random.uniform(0.075, 0.13) * length
    axles = (-0.3, random.uniform(0.26, 0.34))
    parts += wheels([(x * length, s * width * 0.48) for x in axles for s in (-1, 1)], radius, 0.09 * length)
    parts += [ball(0.04 * length, (0.485 * length, s * width * 0.33, 0.2 * length), 3, 8) for s in (-1, 1)]
    return parts


def truck(random: Random) -> list[Part]:
    """A truck, tractor, fire engine or pick-up."""
    length, width = 3.2, 3.2 * random.uniform(0.28, 0.42)
    tall, load = random.uniform(0.36, 0.52) * length, random.uniform(0.1, 0.42) * length
    cab = [(0.2, 0.1), (0.5, 0.1), (0.5, 0.27), (0.46, 0.3), (0.42, tall / length), (0.2, tall / length)]
    parts = [
        extrude([(x * length, z * length) for x, z in cab], width),
        box((0.98 * length, width * 0.8, 0.06 * length), (0, 0, 0.13 * length), 2),
    ]
    kind = random.integers(4)
    if kind == 0:
        parts.append(box((0.66 * length, width * 1.04, load), (-0.16 * length, 0, 0.15 * length + load / 2), 1))
    elif kind == 1:
        parts += [
            box((0.66 * length, 0.06, load * 0.5), (-0.16 * length, s * width * 0.5, 0.16 * length + load * 0.25), 1)
            for s in (-1, 1)
        ]
        parts.append(box((0.66 * length, width, 0.1), (-0.16 * length, 0, 0.17 * length), 1))
    elif kind == 2:
        parts.append(rod(width * 0.5, 0.6 * length, (-0.16 * length, 0, 0.17 * length + width * 0.5), 0, 1))
    else:
        tipped = turned(box((0.62 * length, width, load * 0.7)), about_y(random.uniform(0, 0.4)))
        parts.append(moved(replace(tipped, slot=1), -0.16 * length, 0, 0.3 * length))
    parts.append(box((0.02, width * 0.8, 0.1 * length), (0.445 * length, 0, 0.82 * tall), 3))
    return parts + wheels(
        [(x * length, s * width * 0.46) for x in (-0.36, -0.12, 0.33) for s in (-1, 1)], 0.095 * length, 0.09 * length
    )


def train(random: Random) -> list[Part]:
    """A locomotive or a coach on small wheels."""
    length, width = 2.6, random.uniform(0.8, 1.1)
    parts = [
        box((length, width, 0.2), (0, 0, 0.4), 2),
        rod(width * 0.42, length * 0.62, (length * 0.16, 0, 0.95), 0, 0),
    ]
    parts += [
        box((length * 0.32, width, random.uniform(0.9, 1.4)), (-length * 0.33, 0, 1.05), 1),
        rod(0.16, 0.6, (length * 0.36, 0, 1.6), 2, 3, 0.25),
    ]
    return parts + wheels([(x, s * width * 0.45) for x in (-0.9, 0.0, 0.9) for s in (-1, 1)], 0.3, 0.12)


def plane(random: Random) -> list[Part]:
    """A plane, rocket, boat or submarine."""
    kind = random.integers(3)
    if kind == 0:
        span = random.uniform(2.2, 3.4)
        return grounded([
            blob((1.3, 0.33, 0.33), (0, 0, 0.7)), box((0.6, span, 0.08), (0.15, 0, 0.7), 1),
            box((0.4, 1.1, 0.07), (-1.05, 0, 0.8), 1),
            box((0.4, 0.07, 0.6), (-1.05, 0, 1.1), 2), *(rod(0.15, 0.12, (0.3, s * 0.4, 0.2), 1, 2) for s in (-1, 1)),
        ])  # fmt: skip
    if kind == 1:
        fins = [box((0.9, 0.08, 0.8), (0, 0, 0.4), 1), box((0.08, 2.0, 0.8), (0, 0, 0.4), 1)]
        return [
            lathe([(0, 0), (0.5, 0.1), (0.6, 1.2), (0.5, 2.2), (0.2, 3), (0, 3.2)], 0),
            *fins,
            rod(0.25, 0.1, (0.5, 0, 1.7), 0, 2),
        ]
    hull = extrude([(-1.3, 0.6), (-1.1, 0), (1.0, 0), (1.6, 0.65)], 0.9, 0)
    sail = extrude([(-0.1, 0.8), (1.1, 0.8), (0.0, 2.6)], 0.05, 1)
    return [
        hull,
        box((1.0, 0.6, 0.5), (-0.3, 0, 0.85), 2),
        *([sail, rod(0.05, 2.2, (-0.1, 0, 1.6), 2, 3)] if random.random() < 0.6 else []),
    ]
