"""What is recorded of a world that is known exactly: a ball hits a post, beside a table with a lamp on it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from floors import known, outline
from worlds import CAMERA, FPS, HALF, SPEED, ball, post, rolling, seen

from cow_service.physics.ballistic import Camera, given_path
from cow_service.physics.ensemble import Query, run_ensemble
from cow_service.physics.placement import PlacementGoal
from cow_service.physics.recording import record_trajectory
from cow_service.physics.world import WorldInput
from cow_service.records import Asked, Trajectory
from cow_service.requests import TrajectoryRequest

LAMP = seen("lamp", "cylinder", CAMERA.box(outline("cylinder", (1.2, 3.6), 0.06, 0.2) + np.array([0, 0.3, 0])))
BODIES = (ball(-1.2), post(0.2, half=0.05, height=0.5), LAMP, post(1.2, 3.6, 0.3, 0.3, name="table", shape="box"))


@pytest.fixture(scope="module")
def told() -> Trajectory:
    world = WorldInput(BODIES, rolling(), known(CAMERA, 0.01), CAMERA.size, 65, FPS, turns_wanted=True)
    (result,) = run_ensemble(world, Query(Asked(relation="tips", target="post"), 1), 16)
    return record_trajectory(result, None, None, None, True)


def place(right: float, above: float, ahead: float) -> np.ndarray:
    return CAMERA.positions(np.array([[right, above, ahead]]))[0]


def test_the_camera_and_what_stands_where(told: Trajectory) -> None:
    camera, pitch = told.camera, math.radians(25)
    assert (camera.focal, camera.pitch, camera.roll) == pytest.approx((640, 25, 0), abs=1e-6)
    assert camera.height == pytest.approx(1.5, abs=0.01)
    assert (camera.deviations.focal, camera.deviations.pitch) == pytest.approx((6.4, math.degrees(0.01)))
    assert 0.01 < camera.deviations.height < 0.06
    floor, top = told.surfaces
    assert floor.normal == top.normal == pytest.approx((0, -math.cos(pitch), -math.sin(pitch)))
    assert (floor.body, floor.distance, floor.extent, top.body) == (None, camera.height, None, 3)
    table = told.bodies[3]
    assert top.distance == pytest.approx(camera.height - table.size[1])
    assert [body.support for body in told.bodies] == ["floor", "floor", "table", "floor"]
    spots = [(-1.2, 3.0), (0.2, 3.0), (1.2, 3.6), (1.2, 3.6)]
    for body, (right, ahead) in zip(told.bodies, spots, strict=True):
        foot = body.footprint
        assert foot.centre == pytest.approx((right, ahead), abs=0.25)
        assert body.size == (2 * foot.half_width, foot.height, 2 * foot.half_depth)
        above = foot.height / 2 + (table.size[1] if body.support == "table" else 0.0)
        assert body.position == pytest.approx(place(foot.centre[0], above, foot.centre[1]), abs=0.01)
        assert foot.covariance[2] > 1e-4
        assert (body.rotation, foot.seen, foot.yaw) == (0, None, 0)
    x0, y0, x1, y1 = top.extent
    assert ((x0 + x1) / 2, (y0 + y1) / 2) == pytest.approx(table.footprint.centre)
    assert (x1 - x0, y1 - y0) == pytest.approx((table.size[0], table.size[2]))


def test_paths_contacts_and_times(told: Trajectory) -> None:
    rolls, falls = told.paths
    (met,), (hit,) = told.contacts, told.encounters
    begins = (1.4 - HALF - 0.05) / SPEED
    assert (met.a, met.b, met.time) == (0, 1, pytest.approx(begins, abs=0.03))
    assert 0.05 < met.impulse < SPEED
    assert met.point == pytest.approx(CAMERA.seen(np.array([[0.15, 0.2, 3.0]]))[0], abs=12)
    assert (hit.subject, hit.body, hit.probability, hit.time, hit.share) == (0, 1, 1.0, met.time, None)
    assert (rolls.moved_at, rolls.tipped_at, rolls.turns) == (1 / FPS, None, ())
    assert begins < falls.moved_at < falls.tipped_at < 2.5
    assert rolls.states[16] == pytest.approx((*place(-1.2 + SPEED, HALF, 3.0), SPEED, 0, 0), abs=0.07)
    rolled = CAMERA.seen(np.array([[-1.2, HALF, 3.0], [-1.2 + SPEED, HALF, 3.0]]))
    assert np.array([rolls.points[0], rolls.points[16]]) == pytest.approx(rolled, abs=2)
    assert rolls.rotation[16] == pytest.approx(math.degrees(SPEED / HALF), rel=0.15)
    assert falls.rotation[-1] == pytest.approx(90, abs=8), "it lies"
    assert 2 * math.degrees(math.acos(falls.turns[-1][3])) == pytest.approx(90, abs=8)
    assert [falls.points[0]] * 16 == list(falls.points[:16])
    assert (len(rolls.futures), len(falls.futures), told.ensemble) == (8, 0, 16)
    for path in told.paths:
        (x0, y0, x1, y1), wide = path.band[0], np.diff(np.array(path.band)[:, [0, 2]])
        assert (x1 - x0, y1 - y0) == pytest.approx((0, 0), abs=3)
        assert wide[-1] > 50
        assert len(path.tracks) == 5
    assert told.moving_until == 4.0
    assert [still.body for still in told.still_tracks] == [2, 3]
    assert len(told.anchors) == 8
    for x, y in told.anchors:
        assert not any(x0 <= x < x1 and y0 <= y < y1 for x0, y0, x1, y1 in (body.bbox for body in told.bodies[1:]))
        assert not (60 < x < 540 and abs(y - 196) < 24), "nor on the way of the ball"


def test_what_is_put_somewhere_first_and_a_path_that_no_contact_changes() -> None:
    goal = PlacementGoal("left-of", (1,), body=2, place="to the left of the post")
    world = WorldInput(BODIES, rolling(), known(CAMERA, 0.01), CAMERA.size, 33, FPS, placed_before=(goal,))
    changed, factual = run_ensemble(world, None, 8)
    told = record_trajectory(changed, None, None, None, True)
    (placed,) = told.placed
    assert (placed.object, placed.body, placed.place, placed.result) == ("lamp", 2, goal.place, "beside")
    assert (placed.probabilities, placed.fits, placed.by_heading) == ({"beside": 1.0}, 1.0, False)
    assert placed.visible == pytest.approx(1, abs=0.1)
    lamp, post_ = told.bodies[2], told.bodies[1]
    gap = post_.footprint.centre[0] - lamp.footprint.centre[0]
    assert gap == pytest.approx(post_.size[0] / 2 + 1.5 * lamp.size[0] / 2, abs=0.03)
    assert lamp.support == "floor"
    assert lamp.bbox[2] < post_.bbox[0]
    seen_first = record_trajectory(factual, None, None, None, True)
    assert (seen_first.placed, seen_first.bodies[2].bbox) == ((), BODIES[2].bbox)
    tracks = (((90, 200), (290, 200)),)
    given = TrajectoryRequest(points=((100, 200), (300, 200)), fps=0.5, tracks=tracks, anchors=((9, 9),))
    path = given_path(Camera(*CAMERA.size, 0.005), given, np.arange(33) / FPS)
    led = record_trajectory(factual, None, path, given, False)
    assert (led.law, led.tracks_given, led.encounters_known, led.anchors) == ("ballistic", True, False, ((9, 9),))
    assert led.path.points[16] == pytest.approx((200, 200))
    assert led.path.tracks[0][16] == pytest.approx((190, 200))
