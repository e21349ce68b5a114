"""A depth map of a request: the floor, the camera and the bodies as it shows them, and what is no map of the image."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn import ball, block, floor, png_bytes
from floors import Floats, TrueCamera, depth_png
from hypothesis import given, settings
from hypothesis import strategies as st

from cow_service.errors import InvalidRequest
from cow_service.physics.bodies import SeenBody
from cow_service.physics.geometry import DepthMap, find_floor, measure
from cow_service.records import Simulation
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings
from cow_service.vision.masks import CroppedMask

SIZE = 640, 400
CAMERA = TrueCamera(pitch=28, focal=640)
BALL, NEAR, FAR = (60, 250, 100, 290), (200, 230, 240, 290), (400, 160, 440, 220)
QUESTION = "If the red ball rolls to the right, will it hit the blue block?"


def body(bbox: tuple[int, int, int, int], **given: Any) -> SeenBody:
    x0, y0, x1, y1 = bbox
    mask = np.zeros((SIZE[1], SIZE[0]), bool)
    mask[y0:y1, x0:x1] = True
    return SeenBody("it", (float(x0), float(y0), float(x1), float(y1)), CroppedMask.of(mask), "cylinder", **given)


def wavy(depth: Floats, level: float, seed: int) -> Floats:
    """A depth [H, W] with a smooth error of that size, relative."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]] / max(depth.shape)
    waves = sum(np.sin(2 * math.pi * (a * x + b * y) + c) for a, b, c in rng.uniform(-1.5, 1.5, (4, 3)))
    return depth * np.exp(level * np.asarray(waves) / math.sqrt(2))


class TestFloor:
    @settings(deadline=None, max_examples=25)
    @given(st.floats(3, 60), st.floats(-8, 8), st.floats(400, 1200), st.floats(0.2, 3))
    def test_the_plane_of_a_true_map_is_that_of_the_floor(
        self, pitch: float, roll: float, focal: float, height: float
    ) -> None:
        camera = TrueCamera(pitch, roll, focal, height)
        found = find_floor(DepthMap(camera.depth([NEAR]), 1.0, 0.01, focal), focal, [body(NEAR).mask])
        assert found is not None
        assert math.degrees(found.pitch) == pytest.approx(pitch, abs=0.3)
        assert math.degrees(found.roll) == pytest.approx(roll, abs=0.3)
        assert found.height == pytest.approx(height, rel=0.01)

    def test_its_stated_deviation_covers_what_a_smooth_error_does(self) -> None:
        off = []
        for seed in range(30):
            depth = wavy(CAMERA.depth([NEAR]), 0.04, seed)
            found = find_floor(DepthMap(depth, 1.0, 0.04, 640), 640, [body(NEAR).mask])
            assert found is not None
            off.append((math.degrees(found.pitch) - 28) / math.degrees(found.sigma[0]))
        assert np.mean(np.abs(off) > 2) < 0.15, "it is honest"
        assert np.mean(np.abs(off)) > 0.1, "and no excuse"

    def test_a_wall_a_sky_and_a_table_top_are_none(self) -> None:
        wall, sky = np.full((400, 640), 3.0), np.full((400, 640), np.nan)
        assert find_floor(DepthMap(wall, 1.0, 0.02, 640), 640, []) is None
        assert find_floor(DepthMap(sky, 1.0, 0.02, 640), 640, []) is None
        above = TrueCamera(height=1.0).depth()
        both = np.where(np.isfinite(above) & (np.arange(640) < 420), above, CAMERA.depth())
        found = find_floor(DepthMap(both, 1.0, 0.02, 640), 640, [])
        assert found is not None
        assert found.height == pytest.approx(1.5, rel=0.05), "things stand on what lies beneath the table, too"


class TestFootprints:
    def test_boards_stand_where_the_map_has_them(self) -> None:
        boards = [NEAR, FAR]
        given_ = DepthMap(CAMERA.depth(boards), 1.0, 0.01, 640)
        found = find_floor(given_, 640, [body(each).mask for each in boards])
        assert found is not None
        for box, one in zip(
            boards,
            measure(given_, 640, found, [body(each, is_form_known=False) for each in boards], [False] * len(boards)),
            strict=True,
        ):
            there = CAMERA.on_floor(((box[0] + box[2]) / 2, box[3]))
            assert one is not None
            assert there is not None
            assert (one.centre[0], one.centre[2]) == pytest.approx(there, rel=0.03)
            assert one.half_depth < 0.1 * one.half_width, "it is flat"
            assert one.bottom == pytest.approx(0, abs=0.05)

    def test_the_error_of_the_floor_beside_a_body_is_taken_off_it(self) -> None:
        depth, rows = CAMERA.depth([NEAR]), slice(180, 330)
        depth[rows, 130:310] *= 1.06
        given_ = DepthMap(depth, 1.0, 0.05, 640)
        found = find_floor(given_, 640, [body(NEAR).mask])
        assert found is not None
        one = measure(given_, 640, found, [body(NEAR, is_form_known=False)], [False])[0]
        assert one is not None
        assert one.centre[2] == pytest.approx(CAMERA.on_floor((220, 290))[1], rel=0.02)  # type: ignore[index]

    def test_what_is_seen_through_a_thing_or_beside_it_is_no_part_of_it(self) -> None:
        depth = CAMERA.depth([NEAR])
        found = find_floor(DepthMap(depth, 1.0, 0.01, 640), 640, [body(NEAR).mask])
        assert found is not None
        for columns in (slice(215, 225), slice(212, 240)):  # a gap of a quarter; most of a box that was cut badly
            seen = depth.copy()
            seen[NEAR[1] : NEAR[3], columns] = 2 * np.nanmin(depth[NEAR[1] : NEAR[3], NEAR[0] : NEAR[2]])
            one = measure(DepthMap(seen, 1.0, 0.01, 640), 640, found, [body(NEAR, is_form_known=False)], [False])[0]
            assert one is not None
            assert one.centre[2] == pytest.approx(CAMERA.on_floor((220, 290))[1], rel=0.03)  # type: ignore[index]
            assert one.half_depth < 0.2 * one.half_height

    def test_a_wide_thing_that_is_looked_down_on_a_little_shows_how_deep_it_is(self) -> None:
        camera = TrueCamera(pitch=10, focal=640)
        for box, shows in (((120, 140, 520, 300), True), ((300, 140, 340, 300), False)):
            given_ = DepthMap(camera.depth([box]), 1.0, 0.01, 640)
            found = find_floor(given_, 640, [body(box).mask])
            assert found is not None
            one = measure(given_, 640, found, [body(box, is_form_known=False)], [False])[0]
            assert one is not None
            assert one.depth_seen == shows

    def test_what_hangs_in_the_air_does_not_reach_down_to_the_floor(self) -> None:
        depth, box = CAMERA.depth(), (300, 100, 340, 140)
        depth[100:140, 300:340] = 2.0
        given_ = DepthMap(depth, 1.0, 0.01, 640)
        found = find_floor(given_, 640, [body(box).mask])
        assert found is not None
        one = measure(given_, 640, found, [body(box, is_form_known=False)], [True])[0]
        assert one is not None
        assert 2 * one.half_height == pytest.approx(2.0 * 40 / 640, rel=0.2)
        assert one.centre[1] == pytest.approx(CAMERA.height - 2.0 * math.sin(math.radians(28 - 7)), abs=0.1)

    def test_of_a_hole_nothing_is_told(self) -> None:
        depth = CAMERA.depth([NEAR])
        depth[NEAR[1] : NEAR[3], NEAR[0] : NEAR[2]] = np.nan
        given_ = DepthMap(depth, 1.0, 0.01, 640)
        found = find_floor(given_, 640, [body(NEAR).mask])
        assert found is not None
        assert measure(given_, 640, found, [body(NEAR)], [False]) == (None,)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    folder: Path = tmp_path_factory.mktemp("depth")
    with Service(Settings(data_dir=folder, reader="embedded")) as service:
        yield service


PICTURE = ball(block(floor(*SIZE), NEAR, (40, 60, 200)), (80, 270), 20, (200, 30, 30))


def simulate(service: Service, map_: Floats | bytes, **also: Any) -> Simulation:
    png = map_ if isinstance(map_, bytes) else depth_png(map_)
    body = {
        "image": "data:image/png;base64," + base64.b64encode(png_bytes(PICTURE)).decode(),
        "question": QUESTION,
        "depth": {"map": "data:image/png;base64," + base64.b64encode(png).decode(), "scale": 0.001, "focal": 640},
        "num_frames": 33,
        "video": False,
    }
    return service.simulate(SimulateRequest.model_validate(body | also))


class TestRequest:
    def test_the_same_picture_has_the_answer_that_its_depth_gives(self, service: Service) -> None:
        met = simulate(service, CAMERA.depth([BALL, NEAR])).trajectory
        far = CAMERA.depth([BALL])
        far[NEAR[1] : NEAR[3], NEAR[0] : NEAR[2]] = (
            0.6 * far[NEAR[3], NEAR[0]]
        )  # it hangs before that place, near the camera
        missed = simulate(service, far).trajectory
        assert met.outcome is not None
        assert missed.outcome is not None
        assert met.outcome.probability is not None
        assert met.outcome.probability > 0.7
        assert missed.outcome.probability is not None
        assert missed.outcome.probability < 0.1

    def test_what_was_measured_is_recorded(self, service: Service) -> None:
        trajectory = simulate(service, CAMERA.depth([BALL, NEAR])).trajectory
        assert trajectory.camera is not None
        assert trajectory.camera.source == "depth"
        assert trajectory.camera.pitch == pytest.approx(28, abs=0.5)
        assert trajectory.camera.height == pytest.approx(1.5, rel=0.02)
        assert trajectory.depth is not None
        assert trajectory.depth.floor is not None
        assert trajectory.surfaces[0].body is None
        assert trajectory.surfaces[0].distance == pytest.approx(1.5, rel=0.02)
        block_ = trajectory.bodies[1]
        assert block_.footprint is not None
        there = CAMERA.on_floor((220, 290))
        assert there is not None
        assert block_.footprint.centre[0] == pytest.approx(there[0], abs=0.1)
        assert block_.footprint.covariance is not None
        assert block_.footprint.seen == pytest.approx(1, abs=0.05)

    def test_a_path_without_contacts_does_not_use_it(self, service: Service) -> None:
        found = simulate(service, CAMERA.depth([BALL, NEAR]), motion={"law": "ballistic"})
        assert found.trajectory.depth is None
        assert found.trajectory.outcome is not None
        assert found.trajectory.outcome.probability is not None
        assert any("depth map was not used" in warning for warning in found.warnings)

    def test_a_pitch_that_the_map_contradicts_is_told(self, service: Service) -> None:
        found = simulate(service, CAMERA.depth([BALL, NEAR]), camera={"pitch": 60})
        assert found.trajectory.camera is not None
        assert found.trajectory.camera.pitch == pytest.approx(28, abs=0.5)
        assert any("`camera.pitch` is 60 degrees" in warning for warning in found.warnings)

    def test_nothing_is_sure_where_the_map_shows_floor_instead_of_the_target(self, service: Service) -> None:
        found = simulate(service, CAMERA.depth([BALL]))
        assert found.trajectory.outcome is not None
        assert not found.trajectory.outcome.sure
        assert "depth" in found.trajectory.outcome.depends_on
        assert any("does not show 'blue block'" in warning for warning in found.warnings)

    @pytest.mark.parametrize("shown", [[BALL], []])
    def test_the_answer_says_that_the_map_is_at_fault(self, service: Service, shown: list[Any]) -> None:
        depth = "data:image/png;base64," + base64.b64encode(depth_png(CAMERA.depth(shown))).decode()
        body = {
            "image": "data:image/png;base64," + base64.b64encode(png_bytes(PICTURE)).decode(),
            "question": QUESTION,
            "depth": {"map": depth, "scale": 0.001, "focal": 640},
        }
        told = service.answer(AnswerRequest.model_validate(body))
        assert told.not_sure
        assert "the depth map does not show what matters" in told.reasoning

    def test_a_relative_map_may_not_be_shifted(self, service: Service) -> None:
        depth = CAMERA.depth([BALL, NEAR])
        shifted = depth_png((depth - np.nanmin(depth)) / np.nanmax(depth), 1e-4)
        given_ = {"map": "data:image/png;base64," + base64.b64encode(shifted).decode()}
        with pytest.raises(InvalidRequest, match="without an offset"):
            simulate(service, depth, depth=given_)

    @pytest.mark.parametrize("fault", ["no floor", "no mover", "another scene"])
    def test_a_map_that_does_not_show_the_scene_gives_no_answer(self, service: Service, fault: str) -> None:
        depth = np.full((400, 640), 3.0)
        if fault == "another scene":
            depth = CAMERA.depth([FAR])
        elif fault == "no mover":
            depth = CAMERA.depth([NEAR])
            depth[BALL[1] : BALL[3], BALL[0] : BALL[2]] = np.nan
        found = simulate(service, depth)
        assert found.trajectory.outcome is not None
        assert found.trajectory.outcome.probability is None
        assert not found.trajectory.outcome.sure
        assert found.trajectory.outcome.depends_on == ("depth",)
        assert sum("depth map" in warning for warning in found.warnings) == 1

    @pytest.mark.parametrize(
        ("png", "told"),
        [
            (depth_png(np.full((200, 320), 3.0)), "320 x 200 px where the upright image has 640 x 400"),
            (depth_png(np.full((400, 640), np.nan)), "is empty"),
            (png_bytes(PICTURE), "save it as 16-bit grey"),
            (depth_png(CAMERA.depth())[:-400], "damaged"),
        ],
    )
    def test_what_is_no_map_of_the_image_is_refused(self, service: Service, png: bytes, told: str) -> None:
        with pytest.raises(InvalidRequest, match=told) as raised:
            simulate(service, png)
        assert raised.value.errors[0].pointer == "/depth/map"
