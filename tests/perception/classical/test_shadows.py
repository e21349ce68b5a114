"""The shadow of a ball in the air is found, and nothing else is taken for it: scenes traced ray by ray."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from conftest import example
from drawn import Image, ball, block
from drawn import floor as drawn_floor
from floors import TrueCamera, outline

from cow_service.perception.observation import look
from cow_service.physics.bodies import Shadow
from cow_service.records import BBox

WIDTH, HEIGHT = 512, 320


@dataclass(frozen=True)
class Throw:
    """A ball of radius 1 in the air over a floor, and a cube to its right. Lengths in radii, angles in degrees."""

    pitch: float = 28.0
    height: float = 4.0  # of the ball's centre
    light: tuple[float, float] = (0.45, 0.2)  # how far a shadow goes right and away per unit of height
    sideways: float = -5.0  # of the ball
    distance: float = 15.0  # of the ball's foot from the camera's, along the floor
    across: float = 8.0  # from the ball to the cube
    away: float = 0.0  # the same, in depth
    shade: float = 0.3
    softness: float = 0.12
    grey: int = 150
    floor_tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ball_rgb: tuple[int, int, int] = (225, 120, 30)
    cube_rgb: tuple[int, int, int] = (60, 90, 200)

    @property
    def camera(self) -> TrueCamera:
        height = 1.0 + self.distance * math.tan(math.radians(self.pitch))
        return TrueCamera(self.pitch, 0.0, 512.0, height, (WIDTH, HEIGHT))

    @property
    def ball(self) -> tuple[float, float, float]:
        return self.sideways, self.height, self.distance

    @property
    def ball_bbox(self) -> BBox:
        (x, y), radius = self.camera.seen([self.ball])[0], 512 / self.camera.positions([self.ball])[0, 2]
        return (float(x - radius), float(y - radius), float(x + radius), float(y + radius))

    @property
    def target(self) -> tuple[int, int, int, int]:
        foot = self.sideways + self.across, self.distance + self.away
        x0, y0, x1, y1 = self.camera.box(outline("box", foot, 1.0, 2.0))
        return int(x0), int(y0), int(x1), int(y1)

    def plain_floor(self) -> Image:
        image = drawn_floor(WIDTH, HEIGHT, self.grey)
        return np.clip(image * np.array(self.floor_tint), 0, 255).astype(np.uint8)

    def shaded(self, image: Image) -> Image:
        """Darkens the floor wherever the ball stands between it and the light."""
        to_light = np.array([-self.light[0], 1, -self.light[1]]) / math.hypot(1, *self.light)
        to_ball = np.array(self.ball) - self.camera.floor_places()
        along = to_ball @ to_light
        apart = np.sqrt(np.maximum((to_ball * to_ball).sum(axis=-1) - along * along, 0))
        covered = np.nan_to_num(np.clip((1 - apart) / (2 * self.softness) + 0.5, 0, 1))
        return np.clip(image * (1 - self.shade * covered)[..., None], 0, 255).astype(np.uint8)

    def with_things(self, image: Image, cube: bool = True) -> Image:
        if cube:
            image = block(image, self.target, self.cube_rgb)
        x0, y0, x1, y1 = self.ball_bbox
        return ball(image, ((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0) / 2, self.ball_rgb)

    def image(self) -> Image:
        return self.with_things(self.shaded(self.plain_floor()))

    def off(self, image: Image, scale: float = 1.0) -> float:
        """How far the shadow that is found is from the truth, in half axes; and it has about the right size."""
        x0, y0, x1, y1 = (scale * side for side in self.ball_bbox)
        shadow = look(image).shadow_below((x0, y0, x1, y1))
        assert shadow is not None
        rim = scale * self.camera.shadow_rim(self.ball, self.light)
        (x, y), (a, b) = rim.mean(axis=0), np.ptp(rim, axis=0) / 2
        assert 2 * np.sqrt(shadow.spread[:2]) == pytest.approx([a, b], rel=0.25)
        assert shadow.shade == pytest.approx(self.shade, rel=0.2)
        return math.hypot((shadow.centre[0] - x) / a, (shadow.centre[1] - y) / b)


PLAIN = Throw()
THROWS = {
    "plain": PLAIN,
    "steep camera": Throw(pitch=38, distance=12, sideways=-4, across=7, light=(-0.1, 0.3)),
    "flat camera": Throw(pitch=18, distance=17, height=4, light=(0.5, 0.0)),
    "light from behind": Throw(light=(-0.3, -0.15), sideways=-4),
    "dark floor, bright ball": Throw(grey=90, ball_rgb=(235, 200, 40)),
    "soft and faint": Throw(softness=0.2, shade=0.12),
    "of a thing high above the floor": Throw(softness=0.45, shade=0.3),
}


@pytest.mark.parametrize("name", THROWS)
def test_the_shadow_is_where_the_light_puts_it(name: str) -> None:
    assert THROWS[name].off(THROWS[name].image()) < 0.12


def found(image: Image, throw: Throw = PLAIN) -> Shadow | None:
    return look(image).shadow_below(throw.ball_bbox)


def test_nothing_else_is_taken_for_the_shadow() -> None:
    bare = PLAIN.with_things(PLAIN.plain_floor())
    assert found(bare) is None, "there is none"
    shadow = found(PLAIN.image())
    assert shadow is not None
    x0, y0, x1, y1 = (int(v) for v in shadow.bbox)
    for rgb in ((20, 20, 20), (70, 70, 70), (40, 60, 110)):
        assert found(block(bare, (x0, y0 - (x1 - x0) // 3, x1, y1), rgb)) is None, "a dark thing"
    other = replace(PLAIN, light=(-0.2, -0.1))
    assert found(other.shaded(PLAIN.image())) is None, "one of two patches that are alike"


def test_a_contact_shadow_is_of_another_thing() -> None:
    throw = Throw(across=1.5, away=-2.0)
    x0, _, x1, y1 = throw.target
    blot = np.zeros((HEIGHT, WIDTH), np.float32)
    cv2.ellipse(blot, (round((x0 + x1) / 2 + 12), y1), (round((x1 - x0) * 0.6), 12), 0, 0, 360, 1.0, -1)
    shaded = throw.plain_floor() * (1 - 0.35 * cv2.GaussianBlur(blot, (0, 0), 4))[..., None]
    assert found(throw.with_things(shaded.astype(np.uint8)), throw) is None


def test_what_stands_on_the_floor_has_no_shadow_apart() -> None:
    throw = Throw(height=1.0)
    assert found(throw.image(), throw) is None
    for name in ("ball-and-mug", "bottle-passes-cylinder"):
        scene = example(name)
        assert look(scene.pixels("image.jpg")).shadow_below(tuple(scene.meta["bbox"])) is None
