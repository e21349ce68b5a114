"""Tracks of any number, on images of any size, wherever they go, in the forms of ATI and Wan-Move."""

from __future__ import annotations

import io
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from refusals import refused

from cow_service.generators.wan.profiles import WanLimits
from cow_service.generators.wan.tracks import (
    FILE_SAMPLES,
    MAX_FRAMES,
    MAX_OTHER_TRACKS,
    Tracks,
    clip_length,
    to_ati_file,
    to_ati_tensor,
    tracks_of,
    write_tracks,
)
from cow_service.physics.tracks import at_rate
from cow_service.records import Trajectory

pytest_plugins = "toy_fixtures"
sides = st.integers(8, 4000)
lengths = st.integers(2, MAX_FRAMES)
coordinates = st.floats(-1e6, 1e6, width=32)


@st.composite
def tracks(draw: st.DrawFn, frames: st.SearchStrategy[int] = lengths) -> Tracks:
    """Any number of tracks over any number of frames: off the image, invisible and static ones among them."""
    f, n = draw(frames), draw(st.integers(0, 6))
    points = draw(arrays.arrays(np.float32, (f, n, 2), elements=coordinates, fill=st.just(13.0)))
    return Tracks(points, draw(arrays.arrays(np.bool_, (f, n))))


def straight(frames: int, start: tuple[float, float] = (10, 20), step: tuple[float, float] = (3, -2)) -> Tracks:
    points = np.array(start) + np.arange(frames)[:, None, None] * np.array(step)
    return Tracks(points.astype(np.float32), np.ones((frames, 1), bool))


@given(tracks())
def test_the_file_form_holds_the_last_position(some: Tracks) -> None:
    file = to_ati_file(some)
    assert file.shape == (some.points.shape[1], FILE_SAMPLES, 1, 3)
    assert file.dtype == np.float32
    last = int(np.ceil((some.num_frames - 1) * 1.5))
    np.testing.assert_allclose(
        file[:, last:, 0, :2] / 8, np.broadcast_to(some.points[-1][:, None], file[:, last:, 0, :2].shape), rtol=1e-5
    )
    assert ((file[:, last:, 0, 2] == 8) == some.visible[-1][:, None]).all()
    assert set(np.unique(file[..., 2])) <= {0, 8}


@given(tracks(), sides, sides)
def test_the_tensor_is_finite_and_in_the_public_units(some: Tracks, width: int, height: int) -> None:
    tensor = to_ati_tensor(to_ati_file(some), width, height)
    assert tensor.shape == (MAX_FRAMES, some.points.shape[1], 4)
    assert np.isfinite(tensor).all()
    assert set(np.unique(tensor[..., 3])) <= {-1, 1}
    first = (some.points[0] - np.array([width, height]) / 2) / min(width, height) * 2
    np.testing.assert_allclose(tensor[0, :, 1:3], first, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("fps", "frames"), [(8, 81), (24, 17), (16, 5)])
def test_straight_motion_keeps_its_clock(fps: float, frames: int) -> None:
    """Frame k of the clip is sample 1.5 k of the file, whatever the rate at which it is played."""
    some = straight(frames)
    file = to_ati_file(some)[:, :, 0] / 8
    even = np.arange(0, frames, 2)
    np.testing.assert_allclose(file[:, (1.5 * even).astype(int), :2], some.points[even].transpose(1, 0, 2), atol=1e-3)
    assert (file[..., 2] == 1).all()


@given(st.integers(2, 400), st.sampled_from([1.0, 8.0, 15.0, 16.0, 24.0, 30.0, 59.94]), st.sampled_from([16.0, 24.0]))
def test_the_models_clip_is_as_long_as_the_callers(num_frames: int, fps: float, clip_fps: float) -> None:
    (able,) = WanLimits().nearest_lengths(num_frames, fps)
    assert able == num_frames or (able - 1) / fps <= 5 < able / fps
    length = clip_length(able, fps, clip_fps)
    assert length % 4 == 1
    assert length <= 5 * clip_fps + 1
    assert (length - 1) / clip_fps >= (able - 1) / fps - 1e-6  # and none that is shorter is
    assert length == 5 or (length - 5) / clip_fps < (able - 1) / fps


@given(st.integers(2, 60), st.integers(0, 1))
def test_a_motion_keeps_its_pace_at_another_rate(frames: int, lead: int) -> None:
    points = [(3.0 * i + 1, 40.0) for i in range(frames + lead)]
    shown = trajectory(points, [i < frames - 1 for i in range(frames + lead)], fps=30)
    found = at_rate(shown, 16, 81, lead)
    seconds = np.minimum(np.arange(81) / 16, (frames - 1) / 30)
    told = np.array(found.path.points)
    np.testing.assert_allclose(told[lead:, 0], 3 * (lead + 30 * seconds) + 1)
    np.testing.assert_array_equal(told[:lead], np.array(points[:lead]).reshape(-1, 2))
    assert np.array(found.path.tracks)[0].tolist() == told.tolist()
    assert found.num_frames == 81 + lead
    # What is seen at both frames around a time is seen then.
    assert [*found.path.visible][lead:] == [math.ceil(30 * t - 1e-9) + lead < frames - 1 for t in seconds]
    assert at_rate(shown, 30, frames, lead) is shown


def trajectory(points: list[tuple[float, float]], visible: list[bool], **rest: object) -> Trajectory:
    fields = {
        "fps": 16, "states": [(0, 0, 1, 0, 0, 0)] * len(points), "points": points, "visible": visible,
        "scale": [1] * len(points), "tracks": [points], "anchors": [(5, 5), (90, 5)],
    }  # fmt: skip
    return Trajectory.model_validate(fields | rest)


def test_visibility_of_tracks_and_anchors() -> None:
    points = [(50.0, 50.0), (90.0, 50.0), (130.0, 50.0), (50.0, 50.0)]
    other = [(x - 35, y) for x, y in points]
    found = tracks_of(trajectory(points, [True, True, False, False], tracks=[points, other]), 100, 100)
    assert found.points.shape == (4, 4, 2)
    # Out of the image at frame 2 the other point is still inside it; at frame 3 the object is hidden as a whole.
    assert found.visible[:, 0].tolist() == [True, True, False, False]
    assert found.visible[:, 1].tolist() == [True, True, True, False]
    assert found.visible[:, 2:].all()
    given = [[True, False, True, True], [True] * 4]
    shown = trajectory(points, [True] * 4, tracks=[points, other], tracks_visible=given)
    assert tracks_of(shown, 100, 100).visible[:, 0].tolist() == [True, False, False, True]
    assert (found.points[:, 2] == [5, 5]).all()


def test_every_body_that_moves_has_tracks_the_mover_first() -> None:
    points = [(50.0, 50.0), (60.0, 50.0)]
    pushed = [(20.0, 20.0), (130.0, 20.0)]
    one = trajectory(points, [True, True], tracks=[points])
    path = one.path.model_copy(
        update={"body": 1, "points": tuple(pushed), "visible": (True, False), "tracks": (pushed,) * 5}
    )
    both = one.model_copy(update={"paths": (one.path, path)})
    found = tracks_of(both, 100, 100)
    assert found.points[0].tolist() == [[50, 50], *[[20, 20]] * 5, [5, 5], [90, 5]]
    assert found.visible[1].tolist() == [True, *[False] * 5, True, True]
    many = tracks_of(one.model_copy(update={"paths": (one.path, *[path] * 60)}), 100, 100)
    assert many.points.shape == (2, 1 + MAX_OTHER_TRACKS + 2, 2)
    assert (many.points[:, 0] == found.points[:, 0]).all()


@pytest.mark.slow  # it imports PyTorch
@given(tracks(st.sampled_from([5, 9, 13])), st.integers(1, 7), st.integers(1, 9))
def test_wan_move_is_what_its_definition_says(toys, some: Tracks, h: int, w: int) -> None:
    near = Tracks(np.mod(some.points, 120).astype(np.float32) - 20, some.visible)
    frames = (near.num_frames - 1) // 4 + 1
    latent = toys.torch.randn(3, frames, h, w, generator=toys.torch.Generator().manual_seed(h + w))
    wanted = latent.clone()
    inside = near.visible & (near.points >= 0).all(-1) & (near.points[..., 0] < 8 * w) & (near.points[..., 1] < 8 * h)
    for t in range(1, frames):
        for n in range(near.points.shape[1]):
            if inside[0, n] and inside[4 * t, n]:
                (x0, y0), (x, y) = (near.points[0, n] // 8).astype(int), (near.points[4 * t, n] // 8).astype(int)
                wanted[:, t, y, x] = latent[:, 0, y0, x0]
    found = toys.wan_move_latent(latent, toys.torch.from_numpy(near.points), toys.torch.from_numpy(near.visible))
    assert toys.torch.equal(found, wanted)


@pytest.mark.slow  # it imports PyTorch
def test_the_files_are_what_ati_and_wan_move_read(toys, tmp_path: Path) -> None:
    some = straight(17)
    write_tracks(some, tmp_path / "a.pth")
    saved = toys.torch.load(tmp_path / "a.pth", weights_only=True)  # the bytes of an .npz file
    with np.load(io.BytesIO(saved)) as opened:
        np.testing.assert_array_equal(opened["array"], to_ati_file(some))
    positions, visibility = write_tracks(some, tmp_path / "a.npy")
    np.testing.assert_array_equal(np.load(positions), some.points[None])
    assert np.load(visibility).shape == (1, 17, 1)
    write_tracks(straight(81), tmp_path / "a.npz")
    for wrong, file, named in ((some, "a.csv", ".csv"), (straight(161), "a.npz", "81")):
        with refused("invalid-request") as caught:
            write_tracks(wrong, tmp_path / file)
        assert named in caught.value.detail
