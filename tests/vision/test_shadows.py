"""The shadow of a ball in the air is found, and nothing else is taken for it: scenes traced ray by ray."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import EXAMPLES, Example, all_scenes
from drawn import Image, ball, block, jpeg
from drawn import floor as drawn_floor

from cow_service.records import BBox
from cow_service.vision.scene import Scene
from cow_service.vision.shadows import Shadow, find_shadow

WIDTH, HEIGHT = 512, 320
FOCAL = 512.0  # px


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
    edge: float = 1.0  # of the cube: half
    shade: float = 0.3
    softness: float = 0.12
    grey: int = 150
    floor_tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    ball_rgb: tuple[int, int, int] = (225, 120, 30)
    cube_rgb: tuple[int, int, int] = (60, 90, 200)
    seed: int = 0

    @property
    def up(self) -> np.ndarray:
        return np.array([0, -np.cos(np.radians(self.pitch)), -np.sin(np.radians(self.pitch))])

    @property
    def ahead(self) -> np.ndarray:
        return np.array([0, -np.sin(np.radians(self.pitch)), np.cos(np.radians(self.pitch))])

    def on_floor(self, x: float, depth: float, height: float = 0.0) -> np.ndarray:
        """The point [3] of the camera's space over a place on the floor."""
        camera_height = 1.0 + self.distance * np.tan(np.radians(self.pitch))
        return np.array([x, 0, 0]) + depth * self.ahead + (height - camera_height) * self.up

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Image points [N, 2], px."""
        return FOCAL * points[:, :2] / points[:, 2:] + np.array([WIDTH, HEIGHT]) / 2

    @property
    def ball(self) -> np.ndarray:
        return self.on_floor(self.sideways, self.distance, self.height)

    @property
    def ball_bbox(self) -> BBox:
        (x, y), radius = self.seen(self.ball[None])[0], FOCAL / self.ball[2]
        return (float(x - radius), float(y - radius), float(x + radius), float(y + radius))

    def cube_bbox(self, across: float, away: float) -> BBox:
        middle_x, middle_depth = self.sideways + across, self.distance + away
        corners = [
            self.on_floor(middle_x + i * self.edge, middle_depth + j * self.edge, k * self.edge)
            for i in (-1, 1)
            for j in (-1, 1)
            for k in (0, 2)
        ]
        seen = self.seen(np.array(corners))
        x0, y0, x1, y1 = (int(v) for v in (*seen.min(axis=0), *seen.max(axis=0)))
        return (float(x0), float(y0), float(x1), float(y1))

    @property
    def target(self) -> BBox:
        return self.cube_bbox(self.across, self.away)

    def plain_floor(self) -> Image:
        image = drawn_floor(WIDTH, HEIGHT, self.grey, self.seed)
        return np.clip(image * np.array(self.floor_tint), 0, 255).astype(np.uint8)

    def shaded(self, image: Image) -> Image:
        """Darkens the floor wherever the ball stands between it and the light."""
        ys, xs = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        rays = np.stack([(xs - WIDTH / 2) / FOCAL, (ys - HEIGHT / 2) / FOCAL, np.ones_like(xs)], axis=-1)
        below = rays @ self.up
        hits = rays * np.where(below < -1e-3, (self.on_floor(0, 0) @ self.up) / np.minimum(below, -1e-3), 0)[..., None]
        to_light = self.up - self.light[0] * np.array([1, 0, 0]) - self.light[1] * self.ahead
        to_light /= np.linalg.norm(to_light)
        to_ball = self.ball - hits
        along = to_ball @ to_light
        apart = np.sqrt(np.maximum((to_ball * to_ball).sum(axis=-1) - along * along, 0))
        covered = np.clip((1 - apart) / (2 * self.softness) + 0.5, 0, 1) * (below < -1e-3)
        return np.clip(image * (1 - self.shade * covered)[..., None], 0, 255).astype(np.uint8)

    def drawn(self, *, shadow: bool = True, cube: bool = True) -> Image:
        image = self.shaded(self.plain_floor()) if shadow else self.plain_floor()
        if cube:
            image = block(image, tuple(int(v) for v in self.target), self.cube_rgb)
        x0, y0, x1, y1 = self.ball_bbox
        return ball(image, ((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0) / 2, self.ball_rgb)


@cache
def shown(throw: Throw) -> Scene:
    return Scene(throw.drawn())


def found(throw: Throw, image: Image | None = None) -> Shadow | None:
    return find_shadow(shown(throw) if image is None else Scene(image), throw.ball_bbox)


def truth(throw: Throw) -> tuple[float, float, float, float]:
    """Centre and half axes (px, along those of the image) of the shadow that a far light makes on the floor."""
    middle = np.array([throw.sideways + throw.height * throw.light[0], throw.distance + throw.height * throw.light[1]])
    slant = np.array(throw.light)
    turns = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    along = slant / max(float(np.hypot(*slant)), 1e-9)
    drawn_out = circle + np.outer(circle @ along, along) * (np.sqrt(1 + slant @ slant) - 1)
    rim = throw.seen(np.array([throw.on_floor(*place) for place in middle + drawn_out]))
    (x, y), (a, b) = rim.mean(axis=0), np.ptp(rim, axis=0) / 2
    return float(x), float(y), float(a), float(b)


def off(throw: Throw, shadow: Shadow | None) -> float:
    """How far a shadow's centre is from the truth, in half axes; and it has about the right size."""
    assert shadow is not None
    x, y, a, b = truth(throw)
    assert 2 * np.sqrt(shadow.spread[0]) == pytest.approx(a, rel=0.25)
    assert 2 * np.sqrt(shadow.spread[1]) == pytest.approx(b, rel=0.25)
    return float(np.hypot((shadow.centre[0] - x) / a, (shadow.centre[1] - y) / b))


THROWS = {
    "plain": Throw(),
    "steep camera": Throw(pitch=38, distance=12, sideways=-4, across=7, light=(-0.1, 0.3)),
    "flat camera": Throw(pitch=18, distance=17, height=4, light=(0.5, 0.0)),
    "light from behind": Throw(light=(-0.3, -0.15), sideways=-4),
    "wooden floor": Throw(floor_tint=(1.1, 0.85, 0.65), ball_rgb=(40, 90, 210), cube_rgb=(150, 60, 190)),
    "green floor": Throw(floor_tint=(0.75, 1.05, 0.8), ball_rgb=(230, 60, 60)),
    "dark floor, bright ball": Throw(grey=90, ball_rgb=(235, 200, 40)),
    "soft and faint": Throw(softness=0.2, shade=0.12),
    "of a thing high above the floor": Throw(softness=0.45, shade=0.3),
}


@pytest.mark.parametrize("name", THROWS)
def test_the_shadow_is_where_the_light_puts_it(name: str) -> None:
    assert off(THROWS[name], found(THROWS[name])) < 0.12


def test_mirroring_the_image_mirrors_the_shadow() -> None:
    throw = Throw()
    x0, y0, x1, y1 = throw.ball_bbox
    mirrored = find_shadow(Scene(np.ascontiguousarray(throw.drawn()[:, ::-1])), (WIDTH - x1, y0, WIDTH - x0, y1))
    straight = found(throw)
    assert straight is not None
    assert mirrored is not None
    assert mirrored.centre == pytest.approx((WIDTH - straight.centre[0], straight.centre[1]), abs=1.0)


def test_noise_and_compression_move_it_little() -> None:
    throw = Throw()
    image = throw.drawn()
    noisy = np.clip(image + np.random.default_rng(1).normal(0, 5, image.shape), 0, 255).astype(np.uint8)
    for changed in (jpeg(image, 60), jpeg(noisy, 75)):
        assert off(throw, found(throw, changed)) < 0.2


def test_it_grows_with_the_image() -> None:
    throw = Throw()
    x, y, _, _ = truth(throw)
    for scale in (0.6, 1.5):
        image = cv2.resize(throw.drawn(), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        x0, y0, x1, y1 = (scale * side for side in throw.ball_bbox)
        shadow = find_shadow(Scene(np.asarray(image, np.uint8)), (x0, y0, x1, y1))
        assert shadow is not None
        assert shadow.centre == pytest.approx((x * scale, y * scale), abs=2.5)


def test_without_a_shadow_nothing_is_said() -> None:
    throw = Throw()
    image = throw.drawn(shadow=False)
    assert found(throw, image) is None


@pytest.mark.parametrize("rgb", [(20, 20, 20), (70, 70, 70), (40, 60, 110)])
def test_a_dark_thing_is_no_shadow(rgb: tuple[int, int, int]) -> None:
    throw = Throw()
    shadow = found(throw)
    assert shadow is not None
    x0, y0, x1, y1 = (int(v) for v in shadow.bbox)
    thing = block(throw.drawn(shadow=False), (x0, y0 - (x1 - x0) // 3, x1, y1), rgb)
    assert find_shadow(Scene(thing), throw.ball_bbox) is None


def test_a_contact_shadow_is_of_another_thing() -> None:
    throw = Throw(across=1.5, away=-2.0)
    x0, _, x1, y1 = throw.target
    image = throw.plain_floor().astype(np.float32)
    blot = np.zeros(image.shape[:2], np.float32)
    cv2.ellipse(blot, (round((x0 + x1) / 2 + 12), round(y1)), (round((x1 - x0) * 0.6), 12), 0, 0, 360, 1.0, -1)
    image *= (1 - 0.35 * cv2.GaussianBlur(blot, (0, 0), 4))[..., None]
    shaded = block(image.astype(np.uint8), tuple(int(v) for v in throw.target), throw.cube_rgb)
    left, top, right, bottom = throw.ball_bbox
    scene = Scene(ball(shaded, ((left + right) / 2, (top + bottom) / 2), (right - left) / 2, throw.ball_rgb))
    assert find_shadow(scene, throw.ball_bbox) is None


def test_two_equal_patches_leave_it_open() -> None:
    throw = Throw()
    other = replace(throw, light=(-0.2, -0.1))
    assert find_shadow(Scene(other.shaded(throw.drawn())), throw.ball_bbox) is None


def test_a_ball_that_stands_on_the_floor_has_no_shadow_apart() -> None:
    throw = Throw(height=1.0)
    assert found(throw) is None


@pytest.mark.parametrize(
    "folder", [path for path in all_scenes() if path.parent == EXAMPLES], ids=lambda path: path.name
)
def test_what_stands_on_the_floor_has_no_shadow_apart(folder: Path) -> None:
    given = Example(folder)
    if given.meta["motion"] == "linear":
        x0, y0, x1, y1 = given.meta["bbox"]
        assert find_shadow(Scene(given.pixels("image.jpg")), (x0, y0, x1, y1)) is None
