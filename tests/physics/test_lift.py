"""From boxes to bodies on a floor and back, against a camera whose geometry is written independently."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import SCALE
from floors import TrueCamera, known, outline
from hypothesis import assume, given
from hypothesis import strategies as st

from cow_service.media.masks import CroppedMask
from cow_service.physics.bodies import NOTHING_SAID, SeenBody, supports_of
from cow_service.physics.camera import FloorCamera, prior
from cow_service.physics.draws import ensemble, likeliest
from cow_service.physics.events import find_world_events, seen_paths
from cow_service.physics.layout import BOX_SIDE, lay_out
from cow_service.physics.lift import Cameras, above, in_the_air
from cow_service.physics.world import WorldInput, run_world
from cow_service.records import MetresPerPixel, Motion, ObjectPrior

METRES = 3 / 640  # per pixel

cameras = st.builds(
    TrueCamera,
    pitch=st.floats(12, 55),
    roll=st.floats(-6, 6),
    focal=st.floats(450, 1000),
    height=st.floats(-1, 1).map(lambda power: 10**power),
)


feet = st.tuples(st.floats(60, 580), st.floats(150, 380))  # px


def exactly(camera: TrueCamera) -> Cameras:
    return Cameras.drawn(known(camera), camera.size, likeliest())[0].at_height(np.array([camera.height]))


def filled(shape: tuple[int, int], bbox) -> CroppedMask:
    """A mask that fills a box."""
    mask = np.zeros(shape, bool)
    x0, y0, x1, y1 = (max(0, round(v)) for v in bbox)
    mask[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)] = True
    return CroppedMask.of(mask)


def body(bbox, shape="box", name="thing", prior=NOTHING_SAID) -> SeenBody:
    return SeenBody(name, bbox, filled((400, 640), bbox), shape, prior=prior)


def motion(kind="static", direction=None, speed=0.0, **other) -> Motion:
    return Motion(
        kind=kind, law="contact", direction=direction, cue="request", speed=speed, sentence="", source="request",
        direction_deviation=1.0,        metres_per_pixel=MetresPerPixel(value=METRES, source="default"), **other,
    )  # fmt: skip


class TestProjection:
    @given(cameras, st.floats(-3, 3), st.floats(0, 3), st.floats(2, 30))
    def test_places_are_seen_where_the_true_camera_sees_them(self, camera, right, up, ahead) -> None:
        places = camera.height * np.array([[right, up, ahead]])
        if camera.positions(places)[0, 2] < 0.1 * camera.height:
            return
        points, depth = exactly(camera).project(places)
        assert points[0] == pytest.approx(camera.seen(places)[0], abs=1e-6 * (1 + np.abs(camera.seen(places)).max()))
        assert depth[0] == pytest.approx(camera.positions(places)[0, 2])
        single = FloorCamera(
            *camera.size, camera.focal, math.radians(camera.pitch), math.radians(camera.roll), camera.height
        )
        assert single.project(single.from_floor(places))[0] == pytest.approx(points[0], rel=1e-6, abs=1e-6)
        assert single.to_floor(single.from_floor(places)) == pytest.approx(places)
        if up == 0:
            assert single.to_floor(single.floor_points(points))[0] == pytest.approx(places[0], rel=1e-5, abs=1e-5)

    def test_points_at_and_above_the_horizon_lie_nowhere_on_the_floor(self) -> None:
        camera = FloorCamera(640, 400, 640, math.radians(10), 0.0, 1.5)
        horizon = 200 - 640 * math.tan(math.radians(10))
        found = camera.floor_points(np.array([[320.0, horizon - 1], [320.0, horizon + 40]]))
        assert np.isnan(found[0]).all()
        assert np.isfinite(found[1]).all()


def round_trip(shape: str, rng: np.random.Generator) -> tuple[float, float, float] | None:
    """How far a solid is placed from where it stands, in half widths; and width and height placed, of the true ones."""
    camera = TrueCamera(rng.uniform(20, 35), rng.uniform(-2, 2), rng.uniform(450, 1000), 10 ** rng.uniform(-1, 1))
    there = camera.on_floor((rng.uniform(60, 580), rng.uniform(150, 380)))
    if there is None:
        return None
    half = rng.uniform(0.02, 0.05) * camera.away(there)
    tall = half * (1 if shape == "sphere" else rng.uniform(0.5, 1.5))
    if shape == "sphere":
        bbox = camera.sphere_box((there[0], half, there[1]), half)
    else:
        bbox = camera.box(outline(shape, there, half, 2 * tall, rng.uniform(0, 3)))
    found = above(exactly(camera), bbox, shape, likeliest(), np.zeros(1))
    assert found is not None
    assert found.stands
    assert found.centre[0, 1] == pytest.approx(found.half_height[0]), "it stands on the floor"
    away = float(np.hypot(*(found.centre[0, [0, 2]] - there))) / half
    width = float(found.half_width[0]) * (BOX_SIDE if shape == "box" else 1.0) / half
    return away, width, float(found.half_height[0]) / tall


class TestStanding:
    @pytest.mark.scaled
    @pytest.mark.parametrize(
        ("shape", "median", "worst", "widths", "heights"),
        [
            ("sphere", 0.05, 0.25, (0.99, 1.1), (0.99, 1.1)),
            ("cone", 0.1, 0.35, (0.98, 1.2), (0.8, 1.1)),
            ("cylinder", 0.3, 1.25, (0.98, 1.8), (0.4, 1.1)),
            ("box", 0.3, 1.25, (0.8, 1.85), (0.35, 1.2)),
        ],
    )
    def test_what_stands_on_the_floor_is_found_again(self, shape, median, worst, widths, heights) -> None:
        """Positions in half widths. Placing has nothing but the box: the top of what is tall is nearer and looks wider,
        the far rim of its top is not in the middle, and a box may be seen across."""
        rng = np.random.default_rng(1)
        tried = [round_trip(shape, rng) for _ in range(150 * SCALE)]
        away, width, height = np.array([found for found in tried if found is not None]).T
        assert len(away) > 60 * SCALE
        assert np.median(away) < median
        assert away.max() < worst
        assert widths[0] < width.min()
        assert np.median(width) < 1.25
        assert width.max() < widths[1]
        assert heights[0] < height.min()
        assert np.median(height) > 0.9
        assert height.max() < heights[1]

    @given(cameras, feet, st.floats(0.05, 0.4))
    def test_a_ball_on_a_table_is_as_high_as_the_table(self, camera, foot, table) -> None:
        there = camera.on_floor(foot)
        assume(there is not None)
        half, top = 0.03 * camera.away(there), table * camera.height
        centre = (there[0], top + half, there[1])
        found = above(exactly(camera), camera.sphere_box(centre, half), "sphere", likeliest(), np.array([top]))
        assert found is not None
        assert found.centre[0] == pytest.approx(centre, abs=0.8 * half)
        assert found.centre[0, 1] == pytest.approx(top + half, abs=0.2 * half)

    def test_a_foot_above_the_horizon_stands_nowhere(self) -> None:
        camera = exactly(TrueCamera(pitch=5))
        assert above(camera, (300, 20, 340, 60), "cylinder", likeliest(), np.zeros(1)) is None
        assert above(camera, (300, 280, 340, 320), "cylinder", likeliest(), np.zeros(1)) is not None

    @given(cameras, feet, st.floats(2, 30))
    def test_in_the_air_it_is_where_its_depth_puts_it(self, camera, point, depth) -> None:
        x, y = point[0], 400 - point[1]
        box, pixel = (x - 20, y - 30, x + 20, y + 30), depth / camera.focal
        for shape, half, tall in (("sphere", 25, 25), ("cylinder", 20, 30)):
            found = in_the_air(exactly(camera), box, shape, np.array([depth]))
            assert camera.seen(found.centre)[0] == pytest.approx((x, y), abs=1e-4)
            assert camera.positions(found.centre)[0, 2] == pytest.approx(depth)
            assert (found.half_width[0], found.half_height[0]) == pytest.approx((half * pixel, tall * pixel))
        assert not found.stands


class TestLayout:
    def test_above_the_horizon_things_are_in_the_air_and_above_the_floor(self) -> None:
        bodies = body((300, 150, 340, 190), "sphere"), body((100, 100, 200, 260), "cylinder")
        for draws in (likeliest(), ensemble(50)):
            scene = lay_out(bodies, motion(), known(TrueCamera(pitch=-35), 0.1), (640, 400), draws)
            for placed in scene.bodies:
                assert not placed.stands
                assert np.isfinite(placed.centre).all()
                assert (placed.half_width > 0).all()
                assert (placed.centre[:, 1] > 0).all()
        bodies = body((300, 250, 340, 290), "sphere"), body((100, 10, 140, 40), "box"), body((500, 240, 540, 300))
        scene = lay_out(bodies, motion(), known(TrueCamera(pitch=8)), (640, 400), likeliest())
        assert [placed.stands for placed in scene.bodies] == [True, False, True], "which is nobody else's concern"
        assert scene.bodies[1].centre[0, 1] > scene.cameras.height[0]

    @pytest.mark.parametrize("direction", [(1.0, 0.0), (-0.6, 0.8), (0.0, -1.0)])
    def test_along_the_floor_it_goes_where_it_is_seen_to_go(self, direction) -> None:
        given_ = motion("linear", direction, speed=100)
        world = WorldInput((body((280, 240, 330, 290), "sphere"),), given_, known(TrueCamera()), (640, 400), 17, 16.0)
        worlds = run_world(world, likeliest())
        seen = seen_paths(worlds, 0).points[0]
        step = (seen[10] - seen[3]) / np.linalg.norm(seen[10] - seen[3])
        assert step == pytest.approx(direction, abs=0.02)
        assert worlds.layout.velocity[0, 1] == 0
        speed = float(np.linalg.norm(worlds.layout.velocity[0]))
        assert speed == pytest.approx(100 * METRES), "speeds are along the floor, at the first depth"

    @pytest.mark.parametrize("roll", [-15.0, 0.0])
    def test_in_a_tilted_photograph_things_fall_along_its_vertical(self, roll: float) -> None:
        lean = math.radians(roll)
        given_ = motion("fall", gravity=(0, 9.81 / METRES), down=(math.sin(lean), math.cos(lean)))
        ball = body((300, 60, 340, 100), "sphere")
        world = WorldInput((ball,), given_, known(TrueCamera(pitch=0, roll=roll)), (640, 400), 17, 16.0)
        worlds = run_world(world, likeliest())
        seen = seen_paths(worlds, 0).points[0]
        way = seen[4] - seen[0]
        assert way / np.linalg.norm(way) == pytest.approx((math.sin(lean), math.cos(lean)), abs=0.01)
        t = 4 / 16
        assert np.linalg.norm(way) * METRES == pytest.approx(9.81 * t * t / 2, rel=0.05)

    def fallen(self, x: float, radii: float | None = None) -> np.ndarray:
        """How far ahead [K], m, a released object hangs, with a box that is lower in the image."""
        bodies = body((x, 60, x + 40, 100), "sphere"), body((290, 200, 350, 270))
        fit = prior(0.0)
        if radii is not None:  # above the floor, for certain
            known_height = np.array([0.0, 0.0, math.log(radii) - fit.mean[2], 0.0, 0.0])
            fit = replace(fit, mean=fit.mean + known_height, covariance=fit.covariance * np.diag([1, 1, 1e-4, 1, 1]))
        scene = lay_out(bodies, motion("fall", gravity=(0, 9.81 / METRES)), fit, (640, 400), ensemble(100))
        return scene.bodies[0].centre[:, 2] - scene.bodies[1].centre[:, 2]

    def test_what_is_let_go_hangs_over_what_is_seen_below_it_in_most_worlds(self) -> None:
        wide = 40 * METRES
        over = np.abs(self.fallen(300)) < wide
        assert over[0], "in the likeliest"
        assert 0.55 < over.mean() < 0.95
        assert (np.abs(self.fallen(420)) < wide).mean() < 0.5, "beside it, the camera's priors say where"
        assert (np.abs(self.fallen(300, radii=2)) < wide).mean() < 0.5, "a height that is known outweighs that"


@given(cameras, feet, st.floats(0.3, 0.7), st.floats(0.35, 0.7))
def test_a_bowl_is_as_high_as_it_is_though_its_foot_is_narrower_than_its_rim(camera, foot, bottom, height) -> None:
    there = camera.on_floor(foot)
    assume(there is not None and 18 < camera.pitch < 45)
    half = 0.05 * camera.away(there)
    turns = np.linspace(0, 2 * np.pi, 90)
    circle = np.stack([np.cos(turns), np.zeros(90), np.sin(turns)], axis=1) * half
    middle = np.array([there[0], 0.0, there[1]])
    tall = height * half
    seen = camera.seen(np.concatenate([middle + circle + (0, 2 * tall, 0), middle + bottom * circle]))
    bbox = (*seen.min(axis=0), *seen.max(axis=0))
    assume(seen[90:, 1].max() > seen[:90, 1].max())  # its lowest point is its foot and not its near rim
    right, wrong = (above(exactly(camera), bbox, "cylinder", likeliest(), np.zeros(1), taper=t) for t in (bottom, 1.0))
    assert right is not None
    assert wrong is not None
    assert right.half_height[0] == pytest.approx(tall, rel=0.25)
    assert abs(right.half_height[0] - tall) < abs(wrong.half_height[0] - tall)


TABLE = body((200, 200, 440, 330), "box", "table")
SUPPORTS: dict[str, tuple[Any, SeenBody, int | None]] = {
    "on a table": ((300, 180, 340, 220), TABLE, 1),
    "before its far corner": ((300, 205, 340, 245), TABLE, 1),
    "behind it": ((300, 150, 340, 200), TABLE, None),
    "before it": ((300, 290, 340, 330), TABLE, None),
    "beside it": ((10, 180, 60, 220), TABLE, None),
    "on a ball": ((300, 180, 340, 220), replace(TABLE, shape="sphere"), None),
    "on what is narrower": ((300, 180, 340, 220), body((305, 200, 335, 330)), None),
}


@pytest.mark.parametrize("case", SUPPORTS)
def test_what_something_is_seen_to_stand_on(case: str) -> None:
    bbox, under, on = SUPPORTS[case]
    assert supports_of([body(bbox, "sphere"), under]) == [on, None]


@pytest.mark.parametrize(
    ("said", "on"), [("table", 1), ("floor", None), ("air", None), ("a table that is not there", 1)]
)
def test_what_is_said_goes_before_what_is_seen(said: str, on: int | None) -> None:
    ball = body((300, 180, 340, 220), "sphere", prior=ObjectPrior(stands_on=said))
    assert supports_of([ball, TABLE])[0] == on
    hangs = body((300, 100, 340, 140), "sphere", prior=ObjectPrior(stands_on=said))
    assert supports_of([hangs, TABLE])[0] == (1 if said == "table" else None), "where nothing is seen"


def test_things_that_stand_on_each_other_in_a_circle_end_somewhere() -> None:
    a = body((200, 180, 300, 260), "box", "a", ObjectPrior(stands_on="b"))
    b = body((320, 180, 420, 260), "box", "b", ObjectPrior(stands_on="a"))
    itself = body((20, 180, 120, 260), "box", "c", ObjectPrior(stands_on="c"))
    for bodies in ([a, b, itself], [itself, b, a]):
        scene = lay_out(bodies, motion("linear", (1.0, 0.0), 50), known(TrueCamera(), 0.1), (640, 400), ensemble(10))
        assert all(np.isfinite(placed.centre).all() for placed in scene.bodies)
    assert supports_of([itself]) == [None]


def laid_out(*bodies: SeenBody, kind: str = "static"):
    """Fifty draws of bodies, seen by a camera that is known."""
    camera = known(TrueCamera(pitch=20, focal=640))
    return lay_out(bodies, motion(kind), camera, (640, 400), ensemble(50))


def test_feet_are_off_by_pixels_of_their_own_and_what_the_border_cuts_off_may_reach_far_beyond_it() -> None:
    one, other = laid_out(body((300, 180, 312, 192)), body((340, 180, 352, 192))).bodies
    off = one.centre[:, 2] / other.centre[:, 2]
    assert np.std(off) > 0.01
    assert abs(np.mean(off) - 1) < 0.02
    whole, cut = (laid_out(body((300, 250, 360, y))).bodies[0].centre for y in (395, 400))
    assert np.ptp(np.log(cut[:, 2] / cut[:, 1])) > 3 * np.ptp(np.log(whole[:, 2] / whole[:, 1]))


def test_what_falls_in_clutter_may_have_stood_behind_what_is_seen_below_it() -> None:
    below = body((300, 300, 360, 360), name="below")
    apart = []
    for stands_out in (True, False):
        mover = replace(body((310, 100, 350, 140), "sphere"), stands_out=stands_out)
        falling, under = laid_out(mover, below, kind="fall").bodies
        apart.append(np.mean(np.abs(falling.centre[:, 2] - under.centre[:, 2]) > 2 * under.half_width))
    assert apart[1] > apart[0] + 0.2


def test_a_world_that_begins_with_the_mover_inside_another_body_is_misread() -> None:
    mover, inside = body((300, 200, 340, 240), name="mover"), body((280, 180, 360, 245), name="around")
    way = motion("linear", (1.0, 0.0), 100.0)
    for other, least, most in ((inside, 0.5, 1.0), (body((500, 180, 560, 245)), 0.0, 0.0)):
        world = WorldInput((mover, other), way, known(TrueCamera(pitch=20, focal=640)), (640, 400), 17, 16.0)
        misread = find_world_events(run_world(world, ensemble(50)), world.bodies, ensemble(50), (640, 400)).misread
        assert misread is not None
        assert least <= misread.mean() <= most


@pytest.mark.parametrize("kind", ["projectile", "linear"])
def test_no_draw_hangs_on_which_other_draws_there_are(kind: str) -> None:
    """A throw out of the image is weighed, and a vehicle's depth taken, by each world's own camera and places."""
    mover = replace(body((300, 180, 340, 205), "box", name="mover"), elongated=True)
    bodies = (mover, body((450, 230, 500, 280)))
    way = motion(kind, (0.8, -0.6), 100.0)
    way = way.model_copy(update={"depth_deviation": 15.0}) if kind == "projectile" else way
    camera = known(TrueCamera(pitch=20, focal=640))
    camera = replace(camera, covariance=np.eye(5) * 0.01)
    rows = ensemble(20)
    whole = lay_out(bodies, way, camera, (640, 400), rows)
    part = lay_out(bodies, way, camera, (640, 400), rows[5:])
    assert np.ptp(whole.velocity, axis=0).max() > 0.01
    assert np.allclose(whole.velocity[5:], part.velocity, rtol=1e-9)
    assert np.allclose(np.broadcast_to(whole.bodies[0].depth_share, 20)[5:], part.bodies[0].depth_share, rtol=1e-9)
