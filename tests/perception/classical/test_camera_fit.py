"""The camera by the shadow of a ball: shadows made by known cameras are fitted within the deviations that it states."""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from conftest import SCALE
from floors import TrueCamera, outline

from cow_service.media.masks import CroppedMask
from cow_service.perception.classical.edges import divide, find_segments
from cow_service.physics.bodies import SeenBody, Shadow
from cow_service.physics.camera import MEASUREMENT_SIGMA, CameraFit, Standing, fit_shadow, narrowed, prior
from cow_service.physics.draws import ensemble
from cow_service.physics.lift import Cameras
from cow_service.records import BBox

SIZE = (640, 400)
NAMES = ("pitch", "focal", "height", "slant right", "slant ahead")


def shadow_of(camera: TrueCamera, ball: tuple[float, float, float], light: tuple[float, float]) -> Shadow:
    """The shadow of a ball of radius 1 (m, as all lengths), lit from far away: an ellipse on the floor."""
    points = camera.shadow_rim(ball, light)
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


def throws(count: int, seed: int) -> Iterator[tuple[np.ndarray, BBox, Shadow, np.random.Generator]]:
    """Cameras and lights as the priors have them: what is true of them, the ball's box and its shadow."""
    rng, start, made = np.random.default_rng(seed), prior(), 0
    while made < count:
        truth = start.mean + np.sqrt(np.diag(start.covariance)) * rng.normal(0, 1, 5)
        height, distance = math.exp(truth[2]), rng.uniform(12, 25)
        pitch, focal = math.degrees(truth[0]), 640 * math.exp(truth[1])
        camera = TrueCamera(pitch, 0.0, focal, 1 + distance * math.tan(truth[0]), SIZE)
        ball = rng.uniform(-0.3, 0.3) * distance, height, distance
        box, shadow = camera.sphere_box(ball, 1.0), shadow_of(camera, ball, (truth[3], truth[4]))
        edges = np.array([box, shadow.bbox])
        if edges.min() > 0 and (edges.max(axis=0)[2:] < SIZE).all() and height > 1.4 and 5 < pitch < 60:
            made += 1
            yield truth, box, shadow, rng


@pytest.mark.scaled
def test_errors_are_as_large_as_the_deviations_say() -> None:
    errors: list[np.ndarray] = []
    count = 50 * SCALE
    for truth, box, shadow, rng in throws(count, 3):
        fit = fit_shadow(prior(), box, measured(shadow, (box[2] - box[0]) / 2, rng), SIZE)
        errors += [] if fit is None else [(fit.mean - truth) / np.sqrt(np.diag(fit.covariance))]
    assert len(errors) >= 0.9 * count
    ratio = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert ratio.max() < 2, dict(zip(NAMES, ratio.tolist(), strict=True))
    assert ratio.min() > 0.4, "deviations are not stated larger than they are"


@pytest.mark.parametrize("roll", [-12.0, 12.0])
def test_a_tilted_photograph_is_fitted_with_its_roll(roll: float) -> None:
    camera, ball, start = TrueCamera(28, roll, 640, 9.0, SIZE), (0.5, 4.5, 15.0), prior(math.radians(roll))
    fit = fit_shadow(start, camera.sphere_box(ball, 1.0), shadow_of(camera, ball, (0.2, 0.2)), SIZE)
    assert fit is not None
    assert math.degrees(fit.roll) == pytest.approx(roll)
    assert math.degrees(fit.mean[0]) == pytest.approx(28, abs=5)
    assert math.exp(fit.mean[2]) == pytest.approx(4.5, rel=0.2)


def test_what_can_be_no_shadow_of_the_ball_gives_nothing() -> None:
    camera, ball = TrueCamera(pitch=28, height=9.0, size=SIZE), (0.0, 4.0, 15.0)
    box, shadow = camera.sphere_box(ball, 1.0), shadow_of(camera, ball, (0.1, 0.1))
    assert fit_shadow(prior(), box, shadow, SIZE) is not None
    (x, y), (xx, yy, xy) = shadow.centre, shadow.spread
    for reason, centre, spread in (
        ("above the ball", (x, box[1] - 30), shadow.spread),
        ("far to the side", (x - 600, y), shadow.spread),
        ("too large", (x, y), (9 * xx, 9 * yy, 9 * xy)),
        ("a streak", (x, y), (xx, 30 * yy, xy)),
    ):
        assert fit_shadow(prior(), box, Shadow(shadow.bbox, centre, spread, 0.3), SIZE) is None, reason


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
    things = [Standing(mask.bbox, edges=segments) for mask, segments in zip(masks, own, strict=True)]
    return narrowed(prior(0.0, max(camera.size) / width), things, camera.size, floor)


@pytest.mark.slow
class TestEdges:
    @pytest.mark.parametrize(
        ("shapes", "tiles", "most", "size"),
        [
            (("box", "cylinder", "box"), False, 3.0, (832, 480)),
            (("cylinder",) * 3, False, 4.5, (600, 800)),
            (("box", "cone"), True, 3.0, (832, 480)),
        ],
    )
    def test_pitch_and_focal_length_are_measured(
        self, shapes: tuple[str, ...], tiles: bool, most: float, size: tuple[int, int]
    ) -> None:
        rng = np.random.default_rng(7)
        errors, deviations, sources = [], [], set[str]()
        for pitch in (12, 24, 36, 44):
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
        start, bare = prior(), np.full((400, 640, 3), 90, np.uint8)
        assert narrowed(start, [], SIZE, find_segments(bare, np.zeros((400, 640), bool))) is start

    def test_edges_of_clutter_rarely_pass_for_a_measurement(self) -> None:
        """Each thing has edges in two directions, such as those of another camera, or of what leans and tapers."""
        rng, measured = np.random.default_rng(3), 0
        for _ in range(30):
            things: list[Standing] = []
            for _ in range(int(rng.integers(2, 7))):
                corner, sides = rng.uniform([0, 100], [400, 250]), rng.uniform(60, 150, 2)
                count = int(rng.integers(3, 12))
                turn = rng.choice(rng.uniform(0, math.pi, 2), count) + rng.normal(0, 0.03, count)
                along = np.stack([np.cos(turn), np.sin(turn)], axis=1) * np.sort(rng.uniform(8, 40, count))[::-1, None]
                middle = corner + sides * rng.uniform(0, 1, (count, 2))
                bbox = (*corner.tolist(), *(corner + sides).tolist())
                things.append(Standing(bbox, edges=np.hstack([middle - along, middle + along])))
            measured += narrowed(prior(), things, SIZE).source == "edges"
        assert measured < 11
