"""Furnishes a room: cupboards, shelves and benches, and what lies flat on the main support."""

import numpy as np

from .camera import View
from .meshes import Random, about_z
from .room import FIRST_FLAT, FIRST_SUPPORT, FIRST_WALL, UP, Room, Support, add_table, add_walls
from .stage import PROPS, Stage


def furnish(stage: Stage, view: View, random: Random) -> Room:
    """A room around the view."""
    room = Room(stage, view, random)
    has_table = random.random() < 0.5
    room.floor = -random.uniform(0.45, 0.9) if has_table else 0.0
    number = room.plane_id(FIRST_SUPPORT, FIRST_WALL, UP)
    room.put(
        "floor", np.array([0, 0, room.floor]), (20, 20, 0.4), np.eye(3), room.material("room", "room", "plain"), number
    )
    if has_table:
        add_table(room)
    else:
        room.supports.append(Support(np.array([0, 0, room.floor]), (20, 20), 0.0, 3.0))
    if random.random() < 0.78:
        add_walls(room, 0.9 if has_table else 0.5)
    if room.walls and random.random() < 0.7:
        add_furniture(room)
    if room.walls and random.random() < 0.25:
        add_shelf(room)
    if random.random() < 0.2:
        add_plinths(room)
    add_flats(room)
    return room


def add_furniture(room: Room) -> None:
    """Cupboards, sofas, radiators and crates along the walls: large, and no things."""
    random = room.random
    for _ in range(int(random.integers(1, 4))):
        wall, material = room.walls[random.integers(len(room.walls))], room.material("room", "plain", "plain")
        wide, deep, tall = random.uniform(0.2, 0.8), random.uniform(0.1, 0.35), random.uniform(0.15, 0.9)
        along, off = random.uniform(-2.0, 2.0), random.uniform(0.0, 0.3)
        turn, raised = wall.frame, random.choice((0.0, 0.0, 0.1, random.uniform(0.2, 1.2)))
        room.put("cupboard", wall.at(along, room.floor + raised + tall, deep + off), (wide, tall, deep), turn, material)
        kind = random.integers(3)
        if kind == 0:
            tall_back = tall * random.uniform(1.3, 1.9)
            room.put("cupboard", wall.at(along, room.floor + tall_back, 0.06), (wide, tall_back, 0.06), turn, material)
        elif kind == 1:
            door = (wide * 0.48, tall * 0.9, 0.005)
            for side in (-0.5, 0.5):
                middle = wall.at(along + side * wide, room.floor + raised + tall, 2 * deep + off)
                room.put("panel", middle, door, turn, material if random.random() < 0.5 else room.material("plain"))


def add_shelf(room: Room) -> None:
    """Boards on a wall, one above the other, on which things may stand."""
    random, wall = room.random, room.walls[0]
    wide, deep, material = random.uniform(0.25, 0.9), random.uniform(0.09, 0.2), room.material("room", "plain")
    along, up = random.uniform(-0.6, 0.6), room.floor + random.uniform(0.2, 0.8)
    yaw = float(np.arctan2(wall.frame[1, 0], wall.frame[0, 0]))
    for _ in range(int(random.integers(1, 4))):
        number = room.plane_id(FIRST_SUPPORT, FIRST_WALL, UP)
        centre = wall.at(along, up, deep)
        room.put("board", centre, (wide, deep, 0.012), about_z(yaw), material, number)
        room.supports.append(Support(centre + UP * 0.012, (wide, deep), yaw, 0.8))
        up += random.uniform(0.25, 0.45)


def add_plinths(room: Room) -> None:
    """Low benches or steps that stand on the main support."""
    random = room.random
    for _ in range(int(random.integers(1, 3))):
        spot = room.visible_spot(0.0, 0)
        if spot is None or np.linalg.norm(spot - room.view.eye) > 3 * room.view.distance or not room.is_free(spot, 0.3):
            continue
        if not room.supports[0].holds(spot):
            continue
        half, tall, yaw = (
            (random.uniform(0.15, 0.5), random.uniform(0.1, 0.35)),
            random.uniform(0.01, 0.1),
            random.uniform(0, 6.3),
        )
        number = room.plane_id(FIRST_SUPPORT, FIRST_WALL, UP)
        room.put("plinth", spot + UP * tall, (*half, tall), about_z(yaw), room.material("room", "plain"), number)
        room.supports.append(Support(spot + UP * 2 * tall, half, yaw, 1.0))


def add_flats(room: Room) -> None:
    """Rugs, papers, stripes and discs that lie on the main support, each a little above the one before."""
    random, support = room.random, room.supports[0]
    near, longest = room.view.distance, 0.6 * min(support.half)
    plans = (
        ("rug", 0.45, (0.12, 0.7), 0.002, ("room", "room", "plain")),
        ("paper", 0.45, (0.03, 0.22), 0.0012, ("skin", "plain")),
        ("stripe", 0.25, (0.2, 2.5), 0.0008, ("plain",)), ("disc", 0.3, (0.03, 0.3), 0.001, ("plain", "skin")),
    )  # fmt: skip
    for kind, chance, (low, high), thick, materials in plans:
        for _ in range(int(random.integers(1, PROPS[kind])) if random.random() < chance else 0):
            spot = room.visible_spot(support.centre[2], 60)
            if spot is None or np.linalg.norm(spot - room.view.eye) > 3.5 * near or not support.holds(spot):
                continue
            x, y = np.minimum(random.uniform(low, high, 2), longest)
            size = {"disc": (x, thick), "stripe": (x, random.uniform(0.004, 0.03), thick)}.get(kind, (x, y, thick))
            number = room.plane_id(FIRST_FLAT, FIRST_SUPPORT, UP)
            room.put(
                kind, spot + UP * room.lift, size, about_z(random.uniform(0, 6.3)), room.material(*materials), number
            )
            room.lift += 0.0012 * near
