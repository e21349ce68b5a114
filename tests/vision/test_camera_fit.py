"""The camera by the shadow of a ball: shadows made by known cameras are fitted within the deviations that it states."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from conftest import SCALE
from floors import TrueCamera, outline

from cow_service.physics.bodies import SeenBody
from cow_service.physics.camera import MEASUREMENT_SIGMA, CameraFit, Standing, fit_shadow, narrowed, prior
from cow_service.physics.draws import ensemble
from cow_service.physics.lift import Cameras
from cow_service.physics.world import WorldInput, run_world
from cow_service.records import BBox, MetresPerPixel, Motion
from cow_service.vision.edges import divide, find_segments
from cow_service.vision.masks import CroppedMask
from cow_service.vision.shadows import Shadow

SIZE = (640, 400)
NAMES = ("pitch", "focal", "height", "slant right", "slant ahead")


def shadow_of(camera: TrueCamera, ball: tuple[float, float, float], light: tuple[float, float]) -> Shadow:
    """The shadow of a ball of radius 1 (m, as all lengths), lit from far away: an ellipse on the floor."""
    slant = np.array(light)
    turns = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    along = slant / max(float(np.hypot(*slant)), 1e-9)
    rim = circle + np.outer(circle @ along, along) * (math.sqrt(1 + slant @ slant) - 1)
    rim += np.array([ball[0], ball[2]]) + ball[1] * slant
    points = camera.seen(np.column_stack([rim[:, 0], np.zeros(len(rim)), rim[:, 1]]))
    (x, y), spread = points.mean(axis=0), np.cov(points.T, bias=True) / 2
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    return Shadow((x0, y0, x1, y1), (x, y), (spread[0, 0], spread[1, 1], spread[0, 1]), 0.3)


def measured(shadow: Shadow, radius: float, rng: np.random.Generator) -> Shadow:
    """As it is measured: with the errors that the fit takes measurements to have."""
    dx, dy, width, height, turn = rng.normal(0, MEASUREMENT_SIGMA)
    xx, yy, xy = shadow.spread
    correlation = xy / math.sqrt(xx * yy) + turn
    xx, yy = xx * math.exp(2 * width), yy * math.exp(2 * height)
    centre = shadow.centre[0] + radius * dx, shadow.centre[1] + radius * dy
    return Shadow(shadow.bbox, centre, (xx, yy, correlation * math.sqrt(xx * yy)), shadow.shade)


def throw(rng: np.random.Generator) -> tuple[np.ndarray, BBox, Shadow] | None:
    """A camera and a light as the priors have them: what is true of them, the ball's box and its shadow."""
    start = prior()
    truth = start.mean + np.sqrt(np.diag(start.covariance)) * rng.normal(0, 1, 5)
    height, distance = math.exp(truth[2]), rng.uniform(12, 25)
    camera = TrueCamera(
        pitch=math.degrees(truth[0]), focal=640 * math.exp(truth[1]), size=SIZE,
        height=1 + distance * math.tan(truth[0]),
    )  # fmt: skip
    ball = rng.uniform(-0.3, 0.3) * distance, height, distance
    box, shadow = camera.sphere_box(ball, 1.0), shadow_of(camera, ball, (truth[3], truth[4]))
    seen = (
        min(*box[:2], *shadow.bbox[:2]) > 0 and max(box[2], shadow.bbox[2]) < 640 and max(box[3], shadow.bbox[3]) < 400
    )
    return (truth, box, shadow) if seen and height > 1.4 and 5 < truth[0] * 57 < 60 else None


@pytest.mark.scaled
def test_errors_are_as_large_as_the_deviations_say() -> None:
    rng = np.random.default_rng(3)
    errors: list[np.ndarray] = []
    refused = 0
    while len(errors) < 50 * SCALE:
        made = throw(rng)
        if made is None:
            continue
        truth, box, shadow = made
        fit = fit_shadow(prior(), box, measured(shadow, (box[2] - box[0]) / 2, rng), SIZE)
        if fit is None:
            refused += 1
            continue
        errors.append((fit.mean - truth) / np.sqrt(np.diag(fit.covariance)))
    assert refused <= 0.1 * len(errors)
    ratio = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert ratio.max() < 2, dict(zip(NAMES, ratio.tolist(), strict=True))
    assert ratio.min() > 0.4, "deviations are not stated larger than they are"


def test_it_knows_more_than_before() -> None:
    rng = np.random.default_rng(5)
    narrower = []
    while len(narrower) < 20:
        made = throw(rng)
        fit = None if made is None else fit_shadow(prior(), made[1], made[2], SIZE)
        if fit is not None:
            assert fit.source == "shadow"
            narrower.append(np.sqrt(np.diag(fit.covariance) / np.diag(prior().covariance)))
    median = np.median(narrower, axis=0)
    assert median[2] < 0.5, "the height above the floor"
    assert median[0] < 0.85, "the pitch"
    assert (median < 1.01).all()


def test_a_tilted_photograph_is_fitted_with_its_roll() -> None:
    for roll in (-12.0, 12.0):
        camera = TrueCamera(pitch=28, roll=roll, height=9.0, size=SIZE)
        ball = (0.5, 4.5, 15.0)
        fit = fit_shadow(
            prior(math.radians(roll)), camera.sphere_box(ball, 1.0), shadow_of(camera, ball, (0.2, 0.2)), SIZE
        )
        assert fit is not None
        assert fit.roll == pytest.approx(math.radians(roll))
        assert math.degrees(fit.mean[0]) == pytest.approx(28, abs=5)
        assert math.exp(fit.mean[2]) == pytest.approx(4.5, rel=0.2)


@pytest.mark.parametrize("change", ["above the ball", "far to the side", "too large", "a streak"])
def test_what_can_be_no_shadow_of_the_ball_gives_nothing(change: str) -> None:
    camera = TrueCamera(pitch=28, height=9.0, size=SIZE)
    ball = (0.0, 4.0, 15.0)
    box, shadow = camera.sphere_box(ball, 1.0), shadow_of(camera, ball, (0.1, 0.1))
    assert fit_shadow(prior(), box, shadow, SIZE) is not None
    (x, y), (xx, yy, xy) = shadow.centre, shadow.spread
    centre, spread = {
        "above the ball": ((x, box[1] - 30), shadow.spread),
        "far to the side": ((x - 600, y), shadow.spread),
        "too large": ((x, y), (9 * xx, 9 * yy, 9 * xy)),
        "a streak": ((x, y), (xx, 30 * yy, xy)),
    }[change]
    assert fit_shadow(prior(), box, Shadow(shadow.bbox, centre, spread, 0.3), SIZE) is None


def standing(camera: TrueCamera, shape: str, right: float, ahead: float) -> Standing:
    """What a cylinder or a cube of 0.3 m on the floor shows of a camera, its outline included."""
    places = outline("cylinder" if shape == "cylinder" else "box", (right, ahead), 0.15, 0.3, yaw=0.3)
    hull = cv2.convexHull(camera.seen(places).astype(np.float32)).round().astype(np.int32)
    mask = np.zeros(SIZE[::-1], np.uint8)
    cv2.fillConvexPoly(mask, hull, 1)
    body = SeenBody(shape, camera.box(places), CroppedMask.of(mask > 0), "cylinder")
    return Standing(body.bbox, body.rim if shape == "cylinder" else None, is_cube=shape == "cube")


class TestNarrowed:
    def test_nothing_is_assumed_of_a_camera_but_what_pictures_have(self) -> None:
        cameras, _ = Cameras.drawn(prior(), SIZE, ensemble(200))
        pitch = np.degrees(np.arcsin(-cameras.axes[:, 1, 2]))
        widths = cameras.focal / SIZE[0]
        assert (pitch.min(), pitch.max()) == pytest.approx((0, 55), abs=1.5)
        assert (widths.min(), widths.max()) == pytest.approx((0.45, 2.2), rel=0.05)

    @pytest.mark.parametrize("pitch", [12, 28, 45])
    @pytest.mark.parametrize("shape", ["cylinder", "cube"])
    def test_what_stands_on_the_floor_tells_how_far_the_camera_looks_down(self, pitch: float, shape: str) -> None:
        distance = 2.6
        camera = TrueCamera(pitch, 0.0, 700, distance * math.sin(math.radians(pitch)) + 0.15)
        ahead = distance * math.cos(math.radians(pitch))
        start = prior()
        fit = narrowed(start, [standing(camera, shape, -0.4, ahead), standing(camera, shape, 0.5, ahead + 0.2)], SIZE)
        deviation = math.degrees(math.sqrt(fit.covariance[0, 0]))
        assert abs(math.degrees(fit.mean[0]) - pitch) < max(6, 2 * deviation)
        assert deviation < (8 if shape == "cylinder" else 14) < math.degrees(math.sqrt(start.covariance[0, 0]))

    def test_feet_lie_below_the_horizon(self) -> None:
        fit = narrowed(prior(), [Standing((300, 60, 340, 90))], SIZE)
        assert math.degrees(fit.mean[0]) > 30, "so high in the image they are on a floor that is seen from above"

    def test_what_no_ellipse_is_tells_nothing(self) -> None:
        spiky = np.zeros(SIZE[::-1], bool)
        spiky[200:260, 300:340] = True
        spiky[170:200, 318:322] = True
        assert SeenBody("candle", (300, 170, 340, 260), CroppedMask.of(spiky), "cylinder").rim is None

    def test_how_deep_an_unknown_thing_is_is_not_known(self) -> None:
        block = np.zeros(SIZE[::-1], bool)
        block[200:260, 300:340] = True
        mover = SeenBody("ball", (100, 220, 140, 260), CroppedMask.of(block), "sphere")
        motion = Motion(
            kind="linear", direction=(1, 0), cue="request", speed=100, sentence="", source="request",
            metres_per_pixel=MetresPerPixel(value=0.005, source="default"),
        )  # fmt: skip
        for known, least, most in ((True, 1.0, 1.0), (False, 0.33, 1.9)):
            thing = SeenBody("it", (300, 200, 340, 260), CroppedMask.of(block), "cylinder", is_form_known=known)
            world = WorldInput((mover, thing), motion, prior(), SIZE, 17, 16.0)
            shapes = [bodies[1] for bodies in run_world(world, ensemble(50)).shapes]
            shares = [shape.half_depth / shape.half_width for shape in shapes]
            assert min(shares) <= least
            assert max(shares) >= most


GREY, DARK, LIGHT = (120, 118, 112), (150, 60, 40), (220, 120, 90)  # RGB of the floor, and of sides and tops


def draw(image: np.ndarray, camera: TrueCamera, shape: str, foot: tuple[float, float], yaw: float) -> CroppedMask:
    """Draws a thing 0.3 m wide that stands on the floor, with a lit top, and returns its mask."""
    places = outline(shape, foot, 0.15, 0.35, yaw)
    points = camera.seen(places)
    ring = len(points) // 2
    mask = np.zeros(image.shape[:2], np.uint8)

    def fill(corners: np.ndarray, colour: tuple[int, int, int]) -> None:
        hull = cv2.convexHull((16 * corners).astype(np.float32)).round().astype(np.int32)
        cv2.fillConvexPoly(image, hull, colour, cv2.LINE_AA, 4)
        cv2.fillConvexPoly(mask, hull, 1, shift=4)

    fill(points, DARK)
    if shape == "box":  # the nearest edge, between a lighter side and a darker one
        near = int(np.hypot(*places[:4, [0, 2]].T).argmin())
        side = [near, (near + 1) % 4, near + 4, (near + 1) % 4 + 4]
        fill(points[side], (185, 85, 60))
    fill(points[ring:], LIGHT)
    return CroppedMask.of(mask > 0)


def fit_drawn(camera: TrueCamera, shapes: tuple[str, ...], tiles: bool, rng: np.random.Generator) -> CameraFit:
    """The fit to a picture of things of shapes that are not told, seen by a camera, and of a floor with tiles."""
    width, height = camera.size
    image = np.full((height, width, 3), GREY, np.uint8)
    if tiles:
        steps = np.linspace(-4, 4, 17)
        for start, end in [((s, -4), (s, 4)) for s in steps] + [((-4, s), (4, s)) for s in steps]:
            ends = np.linspace(start, end, 200) @ np.array([[0.8, 0.6], [-0.6, 0.8]]) + [0, 3]
            seen = camera.seen(np.column_stack([ends[:, 0], np.zeros(200), ends[:, 1]])[ends[:, 1] > 0.8])
            cv2.polylines(image, [(16 * seen).astype(np.int32)], False, (70, 70, 70), 2, cv2.LINE_AA, 4)
    masks = []
    for index, shape in enumerate(shapes):
        point = width * (0.2 + 0.6 * index / (len(shapes) - 1)), height * rng.uniform(0.55, 0.8)
        foot = camera.on_floor(point)
        assert foot is not None
        masks.append(draw(image, camera, shape, foot, rng.uniform(0, 1.5)))
    own, floor = divide(find_segments(image, np.zeros((height, width), bool)), masks)
    things = [Standing(mask.bbox, segments=segments) for mask, segments in zip(masks, own, strict=True)]
    return narrowed(prior(0.0, max(camera.size) / width), things, camera.size, floor)


class TestEdges:
    @pytest.mark.parametrize("size", [(832, 480), (600, 800)])
    @pytest.mark.parametrize(
        ("shapes", "tiles", "most"),
        [(("box", "cylinder", "box"), False, 3.0), (("cylinder",) * 3, False, 4.5), (("box", "cone"), True, 3.0)],
    )
    def test_pitch_and_focal_length_are_measured(
        self, size: tuple[int, int], shapes: tuple[str, ...], tiles: bool, most: float
    ) -> None:
        rng = np.random.default_rng(7)
        errors, deviations, sources = [], [], set[str]()
        for pitch in (12, 20, 28, 36, 44):
            camera = TrueCamera(pitch, 0.0, rng.uniform(0.6, 1.4) * max(size), 0.4 + 0.03 * pitch, size)
            fit = fit_drawn(camera, shapes, tiles, rng)
            errors.append(math.degrees(fit.mean[0]) - pitch)
            sources.add(fit.source)
            deviations.append(math.degrees(math.sqrt(fit.covariance[0, 0])))
        assert np.abs(errors).mean() < most
        assert (np.abs(errors) < 2.5 * np.array(deviations)).all()
        assert np.mean(deviations) < 2 * most
        assert "edges" in sources

    def test_a_bare_floor_tells_nothing(self) -> None:
        start = prior()
        assert (
            narrowed(start, [], SIZE, find_segments(np.full((400, 640, 3), 90, np.uint8), np.zeros((400, 640), bool)))
            is start
        )

    def test_a_far_end_of_the_floor_is_below_the_horizon_and_not_far(self) -> None:
        fit = narrowed(prior(), [Standing((300, 200, 340, 240))], SIZE, np.array([[0.0, 100.0, 640.0, 104.0]]))
        above = math.degrees(math.atan2(98, 640 * math.exp(fit.mean[1])))
        assert above < math.degrees(fit.mean[0]) < above + 20

    def test_edges_of_clutter_rarely_pass_for_a_measurement(self) -> None:
        """Each thing has edges in two directions, such as those of another camera, or of what leans and tapers."""
        rng, measured = np.random.default_rng(3), 0
        for _ in range(60):
            things: list[Standing] = []
            for _ in range(int(rng.integers(2, 7))):
                corner, sides = rng.uniform([0, 100], [400, 250]), rng.uniform(60, 150, 2)
                count = int(rng.integers(3, 12))
                turn = rng.choice(rng.uniform(0, math.pi, 2), count) + rng.normal(0, 0.03, count)
                along = np.stack([np.cos(turn), np.sin(turn)], axis=1) * np.sort(rng.uniform(8, 40, count))[::-1, None]
                middle = corner + sides * rng.uniform(0, 1, (count, 2))
                bbox = (*corner.tolist(), *(corner + sides).tolist())
                things.append(Standing(bbox, segments=np.hstack([middle - along, middle + along])))
            measured += narrowed(prior(), things, SIZE).source == "edges"
        assert measured < 21

    def test_random_lines_leave_the_camera_in_doubt(self) -> None:
        rng = np.random.default_rng(2)
        for _ in range(10):
            middle, turn, reach = rng.uniform(0, SIZE, (12, 2)), rng.uniform(0, np.pi, 12), rng.uniform(10, 60, (12, 1))
            along = reach * np.stack([np.cos(turn), np.sin(turn)], axis=1)
            fit = narrowed(prior(), [], SIZE, np.hstack([middle - along, middle + along]))
            assert math.degrees(math.sqrt(fit.covariance[0, 0])) > 5
