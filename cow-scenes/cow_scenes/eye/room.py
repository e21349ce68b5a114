"""The room of a picture: floor or table, walls with what hangs on them, furniture, shelves, and what lies flat."""

from dataclasses import dataclass, field

import numpy as np

from .camera import View
from .meshes import Random, about_z
from .stage import HEIGHT, PROPS, WIDTH, Stage

UP = np.array([0.0, 0.0, 1.0])
FIRST_THING, FIRST_FLAT, FIRST_SUPPORT, FIRST_WALL, IGNORED = 1, 150, 200, 230, 255
"""Ids of a picture: things and flat things by instance, supports and walls by plane; 0 is anything else."""


@dataclass(frozen=True)
class Support:
    """A horizontal rectangle on which things stand: centre, half sizes and yaw, in metres and radians."""

    centre: np.ndarray
    half: tuple[float, float]
    yaw: float
    often: float = 1.0

    def holds(self, point: np.ndarray, margin: float = 0.0) -> bool:
        """Whether a point above or below it is inside by `margin`."""
        inside = about_z(-self.yaw) @ (point - self.centre)
        return bool(np.all(np.abs(inside[:2]) < np.array(self.half) - margin))


@dataclass(frozen=True)
class Wall:
    """A vertical plane: direction away from the camera, distance from the origin along it, frame (3, 3)."""

    outward: np.ndarray
    distance: float
    frame: np.ndarray

    def at(self, along: float, up: float, off: float) -> np.ndarray:
        """A point on the wall, `off` metres in front of it."""
        return self.outward * (self.distance - off) + self.frame[:, 0] * along + UP * up


@dataclass
class Room:
    """What a picture's room consists of while it is furnished; `ids` and `normals` by geom and by id."""

    stage: Stage
    view: View
    random: Random
    floor: float = 0.0
    supports: list[Support] = field(default_factory=list)
    walls: list[Wall] = field(default_factory=list)
    ids: dict[int, int] = field(default_factory=dict)
    normals: np.ndarray = field(default_factory=lambda: np.zeros((256, 3), np.float32))
    counts: dict[str, int] = field(default_factory=dict)
    lift: float = 0.0006

    def material(self, *kinds: str, bright: float = 0.15) -> int:
        """A material of one of the kinds; a plain one is of the brighter half with a probability of `bright`."""
        kind = kinds[self.random.integers(len(kinds))]
        choice, half = self.stage.materials[kind], len(self.stage.materials[kind]) // 2
        if kind == "plain":
            choice = choice[:half] if self.random.random() < bright else choice[half:]
        return int(choice[self.random.integers(len(choice))])

    def put(self, kind: str, at: np.ndarray, size: tuple, turn: np.ndarray, material: int, number: int = 0) -> None:
        """Show the next prop of a kind, if one is left, under an id."""
        used = self.counts.get(kind, 0)
        if used >= PROPS[kind]:
            return
        self.counts[kind] = used + 1
        self.stage.put(f"{kind}{used}", at, size, turn, material)
        self.ids[self.stage.props[f"{kind}{used}"]] = number

    def plane_id(self, first: int, limit: int, normal: np.ndarray) -> int:
        """A new id from `first` on, below `limit`, for a plane with this normal in the world."""
        taken = {*self.ids.values()}
        number = next((k for k in range(first, limit) if k not in taken), 0)
        self.normals[number] = self.view.axes @ normal
        return number

    def visible_spot(self, level: float, margin: float) -> np.ndarray | None:
        """A random point of a level that is in the picture, or up to `margin` pixels outside."""
        x = self.random.uniform(-margin, WIDTH + margin)
        return self.view.on_level(x, self.random.uniform(-margin, HEIGHT + 2 * margin), level)

    def is_free(self, point: np.ndarray, margin: float) -> bool:
        """Whether a point is on this side of all walls."""
        return all(wall.outward @ point < wall.distance - margin for wall in self.walls)


def add_table(room: Room) -> None:
    """A table whose top is at height 0, with legs, perhaps an apron, rails or a cloth that hangs down."""
    random, yaw = room.random, room.random.uniform(0, 2 * np.pi)
    half, thick = (random.uniform(0.35, 1.1), random.uniform(0.28, 0.8)), random.uniform(0.01, 0.035)
    middle, turn = np.array([*random.uniform(-0.1, 0.1, 2), 0.0]), about_z(yaw)
    wood = room.material("room", "room", "plain")
    frame = wood if random.random() < 0.5 else room.material("room", "plain")
    number = room.plane_id(FIRST_SUPPORT, FIRST_WALL, UP)
    room.put("table", middle - UP * thick, (*half, thick), turn, wood, number)
    inset, leg = random.uniform(0.75, 0.98), random.uniform(0.015, 0.05)
    tall = (-room.floor - 2 * thick) / 2
    for sx, sy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        foot = turn @ np.array([sx * half[0] * inset, sy * half[1] * inset, -2 * thick - tall])
        room.put("leg", middle + foot, (leg, leg, tall), turn, frame)
    for kind, low, high, chance in (("apron", 0.03, 0.08, 0.6), ("rail", 0.012, 0.05, 0.15)):
        if random.random() < chance:
            tall, above = random.uniform(low, high), kind == "rail"
            for k in range(4):
                side = about_z(yaw + k * np.pi / 2)
                reach, wide = (half[0], half[1]) if k % 2 == 0 else (half[1], half[0])
                reach = reach * (1.0 if above else inset * 0.97)
                centre = side @ np.array([reach, 0, tall if above else -2 * thick - tall])
                room.put(kind, middle + centre, (0.03 if above else 0.008, wide + 0.03 * above, tall), side, frame)
    room.supports.append(Support(middle, half, yaw, 6.0))
    if random.random() < 0.3:
        add_cloth(room, middle, half, yaw, number)


def add_cloth(room: Room, middle: np.ndarray, half: tuple[float, float], yaw: float, number: int) -> None:
    """A cloth over a whole table, which hangs down at its sides."""
    material, drop = room.material("room", "room", "plain"), room.random.uniform(0.03, 0.3)
    wide = (half[0] + 0.006, half[1] + 0.006)
    room.put("cloth", middle + UP * 0.001, (*wide, 0.001), about_z(yaw), material, number)
    for k in range(4):
        side = about_z(yaw + k * np.pi / 2)
        reach, across = wide if k % 2 == 0 else wide[::-1]
        room.put("overhang", middle + side @ np.array([reach, 0, -drop]), (0.002, across, drop), side, material)


def add_walls(room: Room, nearest: float) -> None:
    """One or two walls with skirting boards, pictures and panels (doors, windows)."""
    random, ahead = room.random, room.view.axes[2, :2]
    facing = np.arctan2(ahead[1], ahead[0])
    for k in range(int(random.integers(1, 3))):
        angle = facing + (random.uniform(-0.6, 0.6) if k == 0 else random.choice((-1, 1)) * random.uniform(1.1, 1.9))
        outward = np.array([np.cos(angle), np.sin(angle), 0.0])
        along = np.array([-outward[1], outward[0], 0.0])
        wall = Wall(outward, random.uniform(nearest, 3.5), np.stack([along, UP, outward], 1))
        room.walls.append(wall)
        number = room.plane_id(FIRST_WALL, IGNORED, -outward)
        room.put(
            "wall",
            wall.at(0, room.floor + 5.9, -0.02),
            (18, 6, 0.02),
            wall.frame,
            room.material("room", "plain", "plain"),
            number,
        )
        if random.random() < 0.6:
            tall = random.uniform(0.02, 0.08)
            room.put(
                "skirting", wall.at(0, room.floor + tall, 0.01), (18, tall, 0.015), wall.frame, room.material("plain")
            )
    for kind, most, low in (("picture", 5, 0.12), ("panel", 4, 0.3)):
        for _ in range(int(random.integers(0, most + 1)) if random.random() < 0.6 else 0):
            wall = room.walls[random.integers(len(room.walls))]
            size = (random.uniform(low, 3 * low), random.uniform(low, 3 * low), 0.012)
            number = room.plane_id(FIRST_FLAT, FIRST_SUPPORT, -wall.outward) if kind == "picture" else 0
            up = room.floor + (random.uniform(0.2, 2.0) if kind == "picture" else size[1])
            room.put(
                kind,
                wall.at(random.uniform(-2, 2), up, 0.012),
                size,
                wall.frame,
                room.material("skin", "skin", "plain", "room"),
                number,
            )
