"""A depth map of a request: the floor, the camera and the bodies as it shows them, and what is no map of the image."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import SCALE
from drawn import ball, block, floor, png_bytes
from floors import Floats, TrueCamera, depth_png
from hypothesis import given, settings
from hypothesis import strategies as st
from refusals import refused
from servers import data_url

from cow_service.media.masks import CroppedMask
from cow_service.physics.bodies import SeenBody
from cow_service.physics.geometry import DepthMap, Floor, Footprint, find_floor, measure
from cow_service.records import Outcome, Simulation
from cow_service.requests import AnswerRequest, SimulateRequest
from cow_service.service import Service
from cow_service.settings import Settings

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


def floor_in(depth: Floats, *boxes: tuple[int, int, int, int], deviation: float = 0.01, focal: float = 640) -> Floor:
    """The floor that a map shows beside things in boxes."""
    found = find_floor(DepthMap(depth, 1.0, deviation, focal), focal, [body(box).mask for box in boxes])
    assert found is not None
    return found


def footprint(
    depth: Floats, box: tuple[int, int, int, int], floor: Floor | None = None, floats: bool = False, **given: Any
) -> Footprint:
    """What a map shows of a thing in a box."""
    floor = floor_in(depth, box) if floor is None else floor
    map_, thing = DepthMap(depth, 1.0, 0.01, 640), body(box, **{"is_form_known": False} | given)
    (found,) = measure(map_, 640, floor, [thing], [floats])
    assert found is not None
    return found


class TestFloor:
    @settings(deadline=None, max_examples=12 * SCALE)
    @given(st.floats(3, 60), st.floats(-8, 8), st.floats(400, 1200), st.floats(0.2, 3))
    def test_the_plane_of_a_true_map_is_that_of_the_floor(
        self, pitch: float, roll: float, focal: float, height: float
    ) -> None:
        found = floor_in(TrueCamera(pitch, roll, focal, height).depth([NEAR]), NEAR, focal=focal)
        assert (math.degrees(found.pitch), math.degrees(found.roll)) == pytest.approx((pitch, roll), abs=0.3)
        assert found.height == pytest.approx(height, rel=0.01)

    @pytest.mark.slow
    def test_its_stated_deviation_covers_what_a_smooth_error_does(self) -> None:
        off = []
        for seed in range(12 * SCALE):
            found = floor_in(wavy(CAMERA.depth([NEAR]), 0.04, seed), NEAR, deviation=0.04)
            off.append((math.degrees(found.pitch) - 28) / math.degrees(found.sigma[0]))
        assert np.mean(np.abs(off) > 2) < 0.15, "it is honest"
        assert np.mean(np.abs(off)) > 0.1, "and no excuse"

    def test_a_wall_a_sky_and_a_table_top_are_none(self) -> None:
        for other in (np.full((400, 640), 3.0), np.full((400, 640), np.nan)):
            assert find_floor(DepthMap(other, 1.0, 0.02, 640), 640, []) is None
        above = TrueCamera(height=1.0).depth()
        both = np.where(np.isfinite(above) & (np.arange(640) < 420), above, CAMERA.depth())
        found = floor_in(both, deviation=0.02)
        assert found.height == pytest.approx(1.5, rel=0.05), "things stand on what lies beneath the table, too"


class TestFootprints:
    def test_boards_stand_where_the_map_has_them(self) -> None:
        depth = CAMERA.depth([NEAR, FAR])
        for box in (NEAR, FAR):
            one = footprint(depth, box, floor_in(depth, NEAR, FAR))
            there = CAMERA.on_floor(((box[0] + box[2]) / 2, box[3]))
            assert (one.centre[0], one.centre[2]) == pytest.approx(there, rel=0.03)
            assert one.half_depth < 0.1 * one.half_width, "it is flat"
            assert one.bottom == pytest.approx(0, abs=0.05)

    def test_neither_an_error_of_the_floor_nor_what_is_seen_through_a_thing_moves_it(self) -> None:
        depth, there = CAMERA.depth([NEAR]), CAMERA.on_floor((220, 290))
        assert there is not None
        off = depth.copy()
        off[180:330, 130:310] *= 1.06
        assert footprint(off, NEAR).centre[2] == pytest.approx(there[1], rel=0.02)
        for columns in (slice(215, 225), slice(212, 240)):  # a gap of a quarter; most of a box that was cut badly
            seen = depth.copy()
            seen[NEAR[1] : NEAR[3], columns] = 2 * np.nanmin(depth[NEAR[1] : NEAR[3], NEAR[0] : NEAR[2]])
            one = footprint(seen, NEAR, floor_in(depth, NEAR))
            assert one.centre[2] == pytest.approx(there[1], rel=0.03)
            assert one.half_depth < 0.2 * one.half_height

    def test_a_wide_thing_that_is_looked_down_on_a_little_shows_how_deep_it_is(self) -> None:
        for box, shows in (((120, 140, 520, 300), True), ((300, 140, 340, 300), False)):
            assert footprint(TrueCamera(pitch=10, focal=640).depth([box]), box).depth_seen == shows

    def test_what_hangs_in_the_air_does_not_reach_down_to_the_floor(self) -> None:
        depth = CAMERA.depth()
        depth[100:140, 300:340] = 2.0
        one = footprint(depth, (300, 100, 340, 140), floats=True)
        assert 2 * one.half_height == pytest.approx(2.0 * 40 / 640, rel=0.2)
        assert one.centre[1] == pytest.approx(CAMERA.height - 2.0 * math.sin(math.radians(28 - 7)), abs=0.1)

    def test_of_a_hole_nothing_is_told(self) -> None:
        depth = CAMERA.depth([NEAR])
        depth[NEAR[1] : NEAR[3], NEAR[0] : NEAR[2]] = np.nan
        assert measure(DepthMap(depth, 1.0, 0.01, 640), 640, floor_in(depth, NEAR), [body(NEAR)], [False]) == (None,)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    folder: Path = tmp_path_factory.mktemp("depth")
    with Service(Settings(data_dir=folder, reader="embedded")) as service:
        yield service


PICTURE = ball(block(floor(*SIZE), NEAR, (40, 60, 200)), (80, 270), 20, (200, 30, 30))


def request(map_: Floats | bytes, **also: Any) -> dict[str, Any]:
    png = map_ if isinstance(map_, bytes) else depth_png(map_)
    depth = {"map": data_url(png), "scale": 0.001, "focal": 640}
    return {"image": data_url(png_bytes(PICTURE)), "question": QUESTION, "depth": depth, "num_frames": 33} | also


def simulated(service: Service, map_: Floats | bytes, **also: Any) -> tuple[Simulation, Outcome]:
    found = service.simulate(SimulateRequest.model_validate(request(map_, video=False, **also)))
    assert found.trajectory.outcome is not None
    return found, found.trajectory.outcome


@pytest.mark.slow
class TestRequest:
    def test_what_was_measured_is_recorded_and_answers(self, service: Service) -> None:
        found, outcome = simulated(service, CAMERA.depth([BALL, NEAR]))
        trajectory, camera, block_ = found.trajectory, found.trajectory.camera, found.trajectory.bodies[1]
        assert outcome.probability is not None
        assert outcome.probability > 0.7
        assert camera is not None
        assert (camera.source, camera.pitch) == ("depth", pytest.approx(28, abs=0.5))
        assert camera.height == pytest.approx(1.5, rel=0.02)
        assert trajectory.depth is not None
        assert trajectory.depth.floor is not None
        assert trajectory.surfaces[0].body is None
        assert trajectory.surfaces[0].distance == pytest.approx(1.5, rel=0.02)
        assert block_.footprint is not None
        assert block_.footprint.centre[0] == pytest.approx(CAMERA.on_floor((220, 290))[0], abs=0.1)  # type: ignore[index]
        assert block_.footprint.covariance is not None
        assert block_.footprint.seen == pytest.approx(1, abs=0.05)

    def test_the_same_picture_has_another_answer_where_the_target_hangs_near_the_camera(self, service: Service) -> None:
        near = CAMERA.depth([BALL])
        near[NEAR[1] : NEAR[3], NEAR[0] : NEAR[2]] = 0.6 * near[NEAR[3], NEAR[0]]
        assert simulated(service, near)[1].probability == pytest.approx(0, abs=0.1)

    def test_a_path_without_contacts_does_not_use_it(self, service: Service) -> None:
        found, outcome = simulated(service, CAMERA.depth([BALL, NEAR]), motion={"law": "ballistic"})
        assert found.trajectory.depth is None
        assert outcome.probability is not None
        assert any("depth" in warning for warning in found.warnings)

    def test_a_pitch_that_the_map_contradicts_is_told(self, service: Service) -> None:
        found, _ = simulated(service, CAMERA.depth([BALL, NEAR]), camera={"pitch": 60})
        assert found.trajectory.camera is not None
        assert found.trajectory.camera.pitch == pytest.approx(28, abs=0.5)
        assert any("camera.pitch" in warning for warning in found.warnings)

    def test_nothing_is_sure_where_the_map_shows_floor_instead_of_the_target(self, service: Service) -> None:
        found, outcome = simulated(service, CAMERA.depth([BALL]))
        assert not outcome.sure
        assert "depth" in outcome.depends_on
        assert any("'blue block'" in warning for warning in found.warnings)
        assert service.answer(AnswerRequest.model_validate(request(CAMERA.depth([BALL])))).not_sure

    @pytest.mark.parametrize("fault", ["no floor", "no mover", "another scene"])
    def test_a_map_that_does_not_show_the_scene_gives_no_answer(self, service: Service, fault: str) -> None:
        depth = np.full((400, 640), 3.0) if fault == "no floor" else CAMERA.depth([FAR])
        if fault == "no mover":
            depth = CAMERA.depth([NEAR])
            depth[BALL[1] : BALL[3], BALL[0] : BALL[2]] = np.nan
        found, outcome = simulated(service, depth)
        assert (outcome.probability, outcome.sure, outcome.depends_on) == (None, False, ("depth",))
        assert sum("depth map" in warning for warning in found.warnings) == 1

    def test_what_is_no_map_of_the_image_is_refused(self, service: Service) -> None:
        depth = CAMERA.depth([BALL, NEAR])
        shifted = data_url(depth_png((depth - np.nanmin(depth)) / np.nanmax(depth), 1e-4))
        maps = (np.full((200, 320), 3.0), np.full((400, 640), np.nan), png_bytes(PICTURE), depth_png(depth)[:-400])
        for asked in (*(request(map_) for map_ in maps), request(depth, depth={"map": shifted})):  # the last: relative
            with refused("invalid-request", "/depth/map"):
                service.simulate(SimulateRequest.model_validate(asked))
