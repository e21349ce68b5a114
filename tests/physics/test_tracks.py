"""Points on the surfaces of bodies: where each is in every frame, and whether it is seen there."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cow_service.media.masks import CroppedMask, hull
from cow_service.physics.camera import FloorCamera
from cow_service.physics.tracks import Density, lifted, with_tracks
from cow_service.records import Body, CameraEstimate, Footprint, Trajectory
from cow_service.records import Path as BodyPath

WIDTH, HEIGHT, FRAMES = 640, 400, 41
ESTIMATE = CameraEstimate.model_validate(
    {"focal": 600, "pitch": 20, "roll": 0, "height": 1.2, "source": "prior",
     "deviations": {"focal": 1, "pitch": 1, "roll": 1, "height": 0.1}}
)  # fmt: skip
CAMERA = FloorCamera.of(ESTIMATE, WIDTH, HEIGHT)


def body(shape: Any, right: float, ahead: float, size: tuple[float, float, float], yaw: float = 0.0) -> Body:
    """One that stands on the floor."""
    centre = CAMERA.from_floor(np.array([[right, size[1] / 2, ahead]]))[0]
    halves = {"half_width": size[0] / 2, "half_depth": size[2] / 2, "height": size[1]}
    return Body(
        object=shape,
        bbox=mask_of(shape, centre, size, yaw).bbox,
        shape=shape,
        size=size,
        position=tuple(centre.tolist()),
        support="floor",
        footprint=Footprint.model_validate(halves | {"centre": (right, ahead), "yaw": yaw}),
        source="request",
        confidence=1.0,
    )


def mask_of(shape: str, centre: Any, size: tuple[float, float, float], yaw: float) -> CroppedMask:
    """The hull of many points of its surface, as the camera sees them."""
    rng = np.random.default_rng(0)
    if shape == "sphere":
        local = rng.normal(size=(4000, 3))
        local *= size[0] / 2 / np.linalg.norm(local, axis=1, keepdims=True)
    else:
        local = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.array(size) / 2
    angle = math.radians(yaw)
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    points, canvas = CAMERA.project(centre + (local @ turn) @ CAMERA.axes), np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.fillConvexPoly(canvas, cv2.convexHull(np.round(points).astype(np.int32)), 1)
    return CroppedMask.of(canvas > 0)


def moving(number: int, start: Body, ahead: tuple[float, float], right: tuple[float, float], **rest: Any) -> BodyPath:
    """A body that goes over the floor at a steady pace."""
    up = start.size[1] / 2
    places = np.column_stack([np.linspace(*right, FRAMES), np.full(FRAMES, up), np.linspace(*ahead, FRAMES)])
    positions = CAMERA.from_floor(places)
    points = CAMERA.project(positions)
    return BodyPath(
        body=number,
        states=tuple((x, y, z, 0.0, 0.0, 0.0) for x, y, z in positions.tolist()),
        points=tuple(map(tuple, points.tolist())),
        visible=(True,) * FRAMES,
        scale=tuple((positions[0, 2] / positions[:, 2]).tolist()),
        **rest,
    )


def world(bodies: list[Body], paths: list[BodyPath]) -> tuple[Trajectory, list[CroppedMask]]:
    told = Trajectory(
        law="contact", fps=16, camera=ESTIMATE, bodies=tuple(bodies), paths=tuple(paths), anchors=(), moving_until=1.0
    )
    yaws = [0.0 if each.footprint is None else each.footprint.yaw for each in bodies]
    masks = [mask_of(e.shape, np.array(e.position), e.size, yaw) for e, yaw in zip(bodies, yaws, strict=True)]
    return told, masks


def flags(path: BodyPath) -> Any:
    return np.array(path.tracks_visible or [[True] * FRAMES] * len(path.tracks))


shapes = st.sampled_from(["sphere", "box", "cylinder", "cone"])


@given(shapes, st.floats(-0.8, 0.8), st.floats(2, 6), st.floats(0.1, 0.6), st.floats(0.1, 0.6), st.floats(-90, 90))
def test_a_pixel_is_lifted_onto_the_surface_that_it_shows(
    shape: str, right: float, ahead: float, width: float, height: float, yaw: float
) -> None:
    size = (width, width if shape == "sphere" else height, width)
    thing = body(shape, right, ahead, size, yaw)
    centre = CAMERA.to_floor(np.array([thing.position]))[0]
    pixel = CAMERA.project(np.array([thing.position]))
    offsets, normals = lifted(CAMERA, thing, centre, pixel)
    np.testing.assert_allclose(CAMERA.project(CAMERA.from_floor(centre + offsets)), pixel, atol=1e-6)
    assert np.linalg.norm(offsets) <= np.linalg.norm(size) / 2 * 1.05
    sight = np.array([0, CAMERA.height, 0]) - centre - offsets
    assert (sight * normals).sum() > 0, "what is seen faces the camera"
    if shape == "sphere":
        assert np.linalg.norm(offsets) == pytest.approx(width / 2, rel=0.02)


def test_what_passes_behind_is_hidden_there_and_nowhere_else() -> None:
    ball, box = body("sphere", -0.9, 4, (0.3, 0.3, 0.3)), body("box", 0, 3, (0.4, 0.5, 0.4))
    told, masks = world([ball, box], [moving(0, ball, (4, 4), (-0.9, 0.9))])
    found = with_tracks(told, masks, told.path.points[0], Density(8, 50, 200))
    seen, tracks = flags(found.path), np.array(found.path.tracks)
    assert len(tracks) >= 50
    x, y = np.floor(tracks[..., 0]).astype(int), np.floor(tracks[..., 1]).astype(int)
    covered = masks[1].full()[y, x]
    assert covered.any()
    assert not (seen & covered).any()
    near = masks[1].bbox[0] - 4 < tracks[..., 0]
    near &= tracks[..., 0] < masks[1].bbox[2] + 4
    assert seen[~near].all()
    (still,) = found.still_tracks
    assert still.body == 1
    assert 1 <= len(still.points) <= 3
    assert still.visible is None, "nothing passes before the box"
    for px, py in still.points:
        assert masks[1].contains(int(px), int(py))


def test_what_passes_in_front_hides_points_of_what_stays() -> None:
    ball, box = body("sphere", -0.9, 2.2, (0.5, 0.5, 0.5)), body("box", 0, 3, (0.4, 0.5, 0.4))
    told, masks = world([ball, box], [moving(0, ball, (2.2, 2.2), (-0.9, 0.9))])
    found = with_tracks(told, masks, told.path.points[0])
    assert found.path.tracks_visible is None
    assert len(found.path.tracks) == 5
    few, many = (with_tracks(told, masks, told.path.points[0], Density(1, d, d)).path.tracks for d in (5, 40))
    assert many[:5] == few, "the first points are those of a sparser density"
    (still,) = found.still_tracks
    assert still.visible is not None
    hidden = ~np.array(still.visible)
    assert hidden.any()
    assert not hidden[:, [0, -1]].any(), "before and after they are seen"


def test_no_point_is_told_visible_beside_what_is_drawn() -> None:
    """A neck is carried as if the body were as wide there as below."""
    bottle = body("cylinder", -0.7, 1.7, (0.5, 0.6, 0.5))
    told, (mask,) = world([bottle], [moving(0, bottle, (1.7, 1.7), (-0.7, 0.7))])
    narrow, (x0, y0, x1, y1) = mask.full(), (int(side) for side in mask.bbox)
    middle, half, foot = (x0 + x1) // 2, (x1 - x0) // 8, y0 + 3 * (y1 - y0) // 4
    narrow[:foot, : middle - half] = narrow[:foot, middle + half :] = False
    found = with_tracks(told, [CroppedMask.of(narrow)], told.path.points[0], Density(4, 50, 200))
    tracks, seen = np.array(found.path.tracks), flags(found.path)
    back = np.array(told.path.points[0]) + (tracks - np.array(told.path.points)) / np.array(told.path.scale)[:, None]
    x, y = np.floor(back[..., 0]).astype(int), np.floor(back[..., 1]).astype(int)
    near = cv2.dilate(hull(narrow).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    beside = ~near[np.clip(y, 0, HEIGHT - 1), np.clip(x, 0, WIDTH - 1)]
    assert beside.any()
    assert not (seen & beside).any()


def test_a_side_that_turns_away_is_not_seen() -> None:
    box = body("box", 0, 3, (0.5, 0.5, 0.5))
    half = np.linspace(0, math.pi, FRAMES) / 2  # once around to its back
    turns = tuple((0.0, math.sin(h), 0.0, math.cos(h)) for h in half.tolist())
    told, masks = world([box], [moving(0, box, (3, 3), (0, 0), turns=turns)])
    found = with_tracks(told, masks, told.path.points[0], Density(8, 50, 50))
    tracks, seen = np.array(found.path.tracks), flags(found.path)
    edge = CAMERA.project(CAMERA.from_floor(np.array([[0, 0.5, 2.75]])))[0, 1]  # between its front and its top
    front, top = tracks[:, 0, 1] > edge + 3, tracks[:, 0, 1] < edge - 3
    assert seen[:, 0].all()
    assert front.sum() > 10
    assert not seen[front, -1].any()
    assert seen[top, -1].all(), "its top is seen all the time"
    width = np.ptp(tracks[front, :, 0], axis=0)
    assert width[FRAMES // 3] < 0.8 * width[0], "and narrower as it turns"
