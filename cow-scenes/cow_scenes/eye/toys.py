"""Balls, animals, figures and hats."""

import numpy as np

from .meshes import Part, Random, any_turn, arc, ball, blob, box, extrude, lathe, moved, rod, tube, turned


def round_ball(random: Random) -> list[Part]:
    """A ball: plain, patterned, banded, or with patches."""
    wraps = (int(random.integers(1, 7)), int(random.integers(1, 5)))
    parts = [ball(1, (0, 0, 0), 0, 30, wraps)]
    kind = random.integers(5)
    if kind == 0:
        angle = random.uniform(0.08, 0.4)
        t = np.linspace(-angle, angle, 6)
        parts.append(lathe(np.c_[1.008 * np.cos(t), 1.008 * np.sin(t)].tolist(), 1))
    elif kind == 1:
        t = np.linspace(0, random.uniform(0.25, 0.6), 5)
        cap = lathe(np.c_[1.008 * np.sin(t), 1.008 * np.cos(t)].tolist(), 1, 8)
        parts += [turned(cap, any_turn(random)) for _ in range(int(random.integers(3, 9)))]
    elif kind == 2:
        t = np.linspace(0, 2 * np.pi, 40)
        seam = np.c_[np.cos(t), np.sin(t) * np.cos(0.4 * np.sin(2 * t)), np.sin(t) * np.sin(0.4 * np.sin(2 * t))]
        parts.append(tube(seam * 1.0, 0.03, 1, 5))
    turn = any_turn(random)
    return [moved(turned(part, turn), 0, 0, 1) for part in parts]


def bird(random: Random) -> list[Part]:
    """A duck, chick, hen or penguin."""
    tall, plump = random.uniform(0.6, 1.4), random.uniform(0.75, 1.0)
    head = random.uniform(0.4, 0.62)
    x, z = random.uniform(0.4, 0.85), tall * 1.55 + head * 0.7
    parts = [blob((1.2, plump, tall), (0, 0, tall)), ball(head, (x, 0, z), int(random.choice((0, 0, 1))))]
    beak = blob((head * 0.6, head * 0.45, head * random.uniform(0.15, 0.35)), (x + head * 1.1, 0, z - 0.05), 2, 10)
    parts += [beak, blob((0.5, plump * 0.5, 0.25), (-1.1, 0, tall * 1.25), 0, 12)]
    parts += [ball(head * 0.14, (x + head * 0.75, s * head * 0.5, z + head * 0.3), 3, 8) for s in (-1, 1)]
    if random.random() < 0.5:
        parts += [
            blob((0.7, 0.15, tall * 0.5), (-0.1, s * plump * 0.92, tall * 1.05), int(random.choice((0, 1))), 12)
            for s in (-1, 1)
        ]
    return parts


def figure(random: Random) -> list[Part]:
    """A doll, bear, robot, snowman or pawn."""
    kind, f = random.integers(3), random.uniform(0.8, 1.2)
    if kind == 0:
        sizes = np.sort(random.uniform(0.5, 1.0, int(random.integers(2, 4))))[::-1]
        parts, z = [], 0.0
        for k, size in enumerate(sizes):
            parts.append(ball(size, (0, 0, z + size), k % 2))
            z += size * 1.7
        return [
            *parts,
            rod(0.06, 0.5, (sizes[-1], 0, z - sizes[-1] * 0.6), 0, 2, 0.01),
            rod(sizes[-1] * 0.8, 0.35, (0, 0, z + 0.25), 2, 3),
        ]
    if kind == 1:
        body = [ball(0.55, (0, 0, 3.2 * f)), blob((0.75, 0.6, 1.0 * f), (0, 0, 1.9 * f), 1)]
        limbs = [rod(0.25, 1.3, (0, s * 0.35, 0.65), 2, 2) for s in (-1, 1)]
        arms = [
            tube(
                [(0, s * 0.6, 2.6 * f), (0.2, s * 1.0, 2.1 * f), (random.uniform(-0.2, 0.7), s * 1.0, 1.5 * f)],
                0.17,
                int(random.integers(0, 2)),
            )
            for s in (-1, 1)
        ]
        ears = [ball(0.22, (0, s * 0.45, 3.65 * f), 0, 10) for s in (-1, 1)] if random.random() < 0.5 else []
        return [*body, *limbs, *arms, *ears]
    robot = [
        box((0.9, 1.2, 1.2), (0, 0, 1.5), 0),
        box((0.7, 0.8, 0.7), (0, 0, 2.6), 1),
        *(box((0.35, 0.4, 0.9), (0, s * 0.35, 0.45), 2) for s in (-1, 1)),
    ]
    return [
        *robot,
        *(box((0.3, 0.3, 1.1), (0, s * 0.8, 1.5), 1) for s in (-1, 1)),
        *(ball(0.1, (0.36, s * 0.2, 2.7), 3, 8) for s in (-1, 1)),
    ]


def animal(random: Random) -> list[Part]:
    """Something with four legs, a neck and a tail."""
    leg, length = random.uniform(0.5, 1.6), random.uniform(0.8, 1.6)
    lift = random.uniform(0.0, 1.2)
    head = (length + random.uniform(0.0, 0.4), 0, leg + 1.0 + lift)
    parts = [blob((length * 1.25, 0.75, random.uniform(0.6, 0.9)), (0, 0, leg + 0.5))]
    parts += [
        rod(random.uniform(0.13, 0.22), leg + 0.3, (x * length * 0.65, y * 0.38, leg / 2 + 0.1))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    parts += [
        blob((random.uniform(0.45, 0.65), 0.38, 0.4), head, int(random.integers(0, 2))),
        tube([(length * 0.6, 0, leg + 0.6), head], 0.3),
    ]
    parts.append(tube([(-length, 0, leg + 0.7), (-length * 1.4, 0, leg + random.uniform(0.2, 1.6))], 0.09, 1))
    parts += [
        blob((0.08, 0.12, random.uniform(0.15, 0.5)), (head[0] - 0.15, s * 0.25, head[2] + 0.4), 1, 8) for s in (-1, 1)
    ]
    return parts


def fish(random: Random) -> list[Part]:
    """A fish, whale, snail or tortoise, close to the ground."""
    tall = random.uniform(0.4, 0.9)
    parts = [
        blob((1.3, random.uniform(0.4, 0.9), tall), (0, 0, tall)),
        ball(0.07, (0.95, 0.3, tall * 1.2), 3, 8),
        ball(0.07, (0.95, -0.3, tall * 1.2), 3, 8),
    ]
    if random.random() < 0.5:
        return [
            *parts,
            extrude([(-1.0, tall), (-1.9, tall * 1.8), (-1.9, tall * 0.3)], 0.12, 1),
            extrude([(-0.4, tall * 1.8), (0.4, tall * 1.8), (-0.3, tall * 2.5)], 0.1, 1),
        ]
    return [
        *parts,
        *(blob((0.3, 0.2, 0.2), (x, s * 0.7, 0.18), 1, 10) for x in (-0.7, 0.7) for s in (-1, 1)),
        ball(0.4, (1.4, 0, tall), 1, 12),
    ]


def headwear(random: Random) -> list[Part]:
    """A hat, cap, helmet, bell or dome."""
    high, brim = random.uniform(0.5, 1.3), random.uniform(1.0, 1.8)
    t = np.linspace(0, np.pi / 2, 10)
    dome = (
        np.c_[np.cos(t) ** random.uniform(0.4, 1.0), high * np.sin(t)]
        if random.random() < 0.7
        else np.array([(0.9, 0), (0.8, high), (0, high)])
    )
    parts = [lathe([(0, 0), (brim, 0), (brim, 0.06), *(dome + np.array([0, 0.06])).tolist()], 0)]
    if random.random() < 0.6:
        parts.append(lathe([(1.01, 0.1), (1.0, 0.1 + 0.25 * high)], 1))
    if random.random() < 0.3:
        parts.append(tube(arc((0, 0, high), (0.3, 0.3), 0, np.pi), 0.07, 1))
    return parts
