"""Where a picture's things stand, lie, are stacked or hang in the air, and what they are made of."""

from dataclasses import dataclass

import numpy as np

from .meshes import about_y, about_z, any_turn
from .room import UP, Room
from .stage import THINGS, Extent
from .textures import colour

COUNTS = (0, 1, 2, 3, 3, 4, 4, 5, 5, 6, 7, 8, 10, 13)
"""Things of a picture, each as likely."""


@dataclass(frozen=True)
class Placed:
    """A thing of the stage that a picture shows: its number there, the point below it, and how large it is."""

    number: int
    foot: np.ndarray
    extent: Extent
    is_raised: bool


def place_things(room: Room) -> list[Placed]:
    """Put things on the supports, some on other things and some in the air."""
    random, placed = room.random, []
    wanted, is_tight = int(random.choice(COUNTS)), random.random() < 0.3
    for number in random.permutation(THINGS):
        if len(placed) >= wanted:
            break
        extent = room.stage.extents[number]
        foot = find_foot(room, extent, placed, 1.0 if is_tight else 1.2)
        if foot is None:
            continue
        base = placed[random.integers(len(placed))] if placed and random.random() < 0.1 else None
        is_raised = False
        if base is not None and not base.is_raised and extent.radius < base.extent.radius * 0.9:
            foot, is_raised = base.foot + UP * base.extent.height, True
        elif random.random() < 0.1:
            foot, is_raised = foot + UP * random.uniform(0.05, 0.6) * room.view.distance * 0.5, True
        turn, lift = pose_of(room, extent, is_raised and base is None)
        room.stage.stand(int(number), foot + UP * (lift + 0.0006), turn)
        placed.append(Placed(int(number), foot, extent, is_raised))
    return placed


def find_foot(room: Room, extent: Extent, placed: list[Placed], distance: float) -> np.ndarray | None:
    """A point of some support that is in the picture and free; None if two dozen tries find none."""
    random = room.random
    chances = np.array([support.often for support in room.supports])
    for _ in range(24):
        support = room.supports[random.choice(len(chances), p=chances / chances.sum())]
        spot = room.visible_spot(float(support.centre[2]), 12)
        if spot is None or np.linalg.norm(spot - room.view.eye) > 3.2 * room.view.distance:
            continue
        margin = min(extent.radius * 0.6, min(support.half) * 0.5)
        if not support.holds(spot, margin) or not room.is_free(
            spot, min(extent.radius, 0.06) if len(support.half) else 0
        ):
            continue
        near = distance * random.uniform(0.85, 1.1)
        level = [other for other in placed if abs(other.foot[2] - spot[2]) < 0.3]
        if all(np.hypot(*(spot - other.foot)[:2]) > (extent.radius + other.extent.radius) * near for other in level):
            return spot
    return None


def pose_of(room: Room, extent: Extent, in_air: bool) -> tuple[np.ndarray, float]:
    """A rotation, and how far to lift the thing so that it does not sink in."""
    random = room.random
    turn = about_z(random.uniform(0, 2 * np.pi))
    if random.random() > (0.6 if in_air else 0.1):
        return turn, 0.0
    turn = turn @ (any_turn(random) if in_air else about_y(np.pi / 2) @ about_z(random.choice((0, np.pi / 2))))
    corners = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    points = (extent.low + corners * (extent.high - extent.low)) @ turn.T
    return turn, -float(points[:, 2].min())


def dress(room: Room, placed: list[Placed]) -> None:
    """Give every material a colour and a shine, and every part of a thing a material."""
    random, model, kinds = room.random, room.stage.model, room.stage.materials
    glossy = random.random() < 0.3
    for kind, numbers in kinds.items():
        for k in numbers:
            # The first half of the plain materials is for things, which are brighter than rooms.
            tint = colour(random, is_bright=kind == "plain" and k in numbers[: len(numbers) // 2]) / 255
            if kind != "plain" and random.random() < 0.85:
                tint = 1 - (1 - tint) * 0.15
            model.mat_rgba[k] = [*tint, 1]
            model.mat_specular[k], model.mat_shininess[k] = random.uniform(0, 1) ** 2, random.uniform(0, 1)
            model.mat_emission[k] = random.uniform(0, 0.25) if random.random() < 0.12 else 0
            model.mat_reflectance[k] = random.uniform(0.03, 0.4) if glossy and kind == "room" else 0
            model.mat_texrepeat[k] = random.uniform(0.5, 4) if kind == "room" else random.integers(1, 3)
    for thing in placed:
        body = room.stage.bodies[thing.number]
        first, parts = model.body_geomadr[body], model.body_geomnum[body]
        chosen = [
            room.material("skin") if random.random() < 0.35 else room.material("plain", bright=0.75)
            for _ in range(parts)
        ]
        if random.random() < 0.25:
            chosen = [chosen[0]] * parts
        model.geom_matid[first : first + parts] = chosen


def cast_from_outside(room: Room, placed: list[Placed], towards_light: np.ndarray) -> None:
    """Hang things between the light and the support, mostly out of the picture, so that only a shadow is seen."""
    shown = {thing.number for thing in placed}
    for number in [k for k in range(THINGS) if k not in shown][: int(room.random.integers(1, 3))]:
        spot = room.visible_spot(float(room.supports[0].centre[2]), 0)
        if spot is not None:
            distance = room.view.distance * room.random.uniform(0.7, 1.2)
            room.stage.stand(number, spot + towards_light * distance + UP * 0.2, any_turn(room.random))
            placed.append(Placed(number, spot + towards_light * distance, room.stage.extents[number], True))
