"""Tracks in the forms that ATI and Wan-Move read, made from a trajectory, and their files. No PyTorch but for `.pth`.

A trajectory is sampled at the frames of the model's clip, in pixels of the input image. ATI's file form has 121
samples, 1.5 for each frame of its 81-frame clip: 24 per second where the clip has 16. Wan-Move has one sample per
frame. After its last frame a track stays where it is.

ATI's `.pth` is a saved string of bytes: the `.npz` file, whose array is called `array`. Wan-Move keeps positions in one
`.npy` file and visibility in another.

Sources: the public implementations of ATI (arXiv 2505.22944) and Wan-Move (arXiv 2512.08765).
"""

import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cow_service.errors import InvalidRequest, install_line
from cow_service.media.types import Floats, Floats32
from cow_service.records import Trajectory

MAX_FRAMES = 81  # of a Wan2.1 clip
CLIP_FPS = 16.0  # at which Wan2.1 was trained
STRIDE = 4  # clip frames per latent frame, after the first
FILE_SAMPLES = 121
FILE_UNITS_PER_PIXEL = 8
SAMPLES_PER_FRAME = 1.5
MAX_OTHER_TRACKS = 40

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Tracks:
    """Where points of the image are in every frame of a clip."""

    points: Floats32  # [F, N, 2] x, y in px
    visible: Bools  # [F, N]

    @property
    def num_frames(self) -> int:
        """F, the frames of the clip."""
        return self.points.shape[0]

    def scaled(self, x: float, y: float) -> "Tracks":
        """The same tracks on the image resized by these factors."""
        return Tracks((self.points * np.array([x, y])).astype(np.float32), self.visible)


def clip_length(num_frames: int, fps: float, clip_fps: float) -> int:
    """Frames, 4n + 1 and at least 5, of the shortest clip at `clip_fps` that is as long as so many frames at `fps`."""
    steps = (num_frames - 1) * clip_fps / fps
    return max(1, math.ceil(steps / STRIDE - 1e-6)) * STRIDE + 1


def tracks_of(trajectory: Trajectory, width: int, height: int) -> Tracks:
    """The tracks of every body that moves, the mover's first, of those that stay, then the anchors.

    On an image of this size (px), at the frames of the trajectory. Points outside the image are not visible. The bodies
    that are set in motion share three times as many tracks as the mover has, or `MAX_OTHER_TRACKS`.
    """
    frames = trajectory.num_frames
    parts: list[Tracks] = []
    for path in trajectory.paths:
        points = np.array(path.tracks, np.float64).reshape(-1, frames, 2).transpose(1, 0, 2)
        # Inside the image and yet not visible: behind the camera or hidden, and so are the body's other points. Outside
        # it the centre says nothing of them.
        hidden = _inside(np.array(path.points, np.float64), width, height) & ~np.array(path.visible, bool)
        visible = _inside(points, width, height) & ~hidden[:, None]
        if path.tracks_visible is not None:
            visible &= np.array(path.tracks_visible, bool).reshape(-1, frames).T
        parts.append(Tracks(points.astype(np.float32), visible))
    most = max(MAX_OTHER_TRACKS, 3 * parts[0].points.shape[1])  # memory and time of a clip grow with their number
    each = max(1, most // max(1, len(parts) - 1))
    parts[1:] = [Tracks(part.points[:, :each], part.visible[:, :each]) for part in parts[1 : most + 1]]
    for still in trajectory.still_tracks:
        points = np.array(still.points, np.float64).reshape(1, -1, 2).repeat(frames, axis=0)
        seen = True if still.visible is None else np.array(still.visible, bool).reshape(-1, frames).T
        parts.append(Tracks(points.astype(np.float32), _inside(points, width, height) & seen))
    anchors = np.array(trajectory.anchors, np.float32).reshape(1, -1, 2).repeat(frames, axis=0)
    parts.append(Tracks(anchors, _inside(anchors.astype(np.float64), width, height)))
    return Tracks(
        np.concatenate([part.points for part in parts], axis=1),
        np.concatenate([part.visible for part in parts], axis=1),
    )


def to_ati_file(tracks: Tracks) -> Floats32:
    """[N, 121, 1, 3]: x, y (px) and visible (0 or 1), each times 8, linear between frames."""
    last = tracks.num_frames - 1
    at = np.minimum(np.arange(FILE_SAMPLES) / SAMPLES_PER_FRAME, last)
    before = np.floor(at).astype(int)
    after = np.minimum(before + 1, last)
    share = (at - before)[:, None, None]
    points = tracks.points.astype(np.float64)
    between = points[before] * (1 - share) + points[after] * share
    visible = tracks.visible[np.rint(at).astype(int)]
    samples = np.concatenate([between, visible[..., None]], axis=2) * FILE_UNITS_PER_PIXEL
    return samples.transpose(1, 0, 2)[:, :, None].astype(np.float32)


def to_ati_tensor(samples: Floats32, width: int, height: int) -> Floats32:
    """[81, N, 4]: time, x, y and visible from ATI's file form [N, 121, 1, 3], on an image of this size (px).

    Time and visible go from -1 to 1. The image's centre is x = y = 0 and its shorter side is 2 long.
    """
    k = np.arange(MAX_FRAMES - 1)
    picks = np.concatenate([[0], 1 + (3 * k + 1) // 2])  # which of the 121 samples are the 81 frames
    tracks = samples[:, picks, 0].astype(np.float64).transpose(1, 0, 2) / FILE_UNITS_PER_PIXEL
    positions = (tracks[..., :2] - np.array([width, height]) / 2) / min(width, height) * 2
    time = np.broadcast_to((2 * picks / (FILE_SAMPLES - 1) - 1)[:, None], tracks.shape[:2])
    return np.concatenate([time[..., None], positions, 2 * tracks[..., 2:] - 1], axis=2).astype(np.float32)


def _inside(points: Floats, width: int, height: int) -> Bools:
    x, y = points[..., 0], points[..., 1]
    return (x >= 0) & (x < width) & (y >= 0) & (y < height)


def write_tracks(tracks: Tracks, path: Path) -> tuple[Path, ...]:
    """Writes the form that the suffix names, and says which files that were.

    Raises `InvalidRequest` for another suffix, a clip that is too long for ATI, or `.pth` without PyTorch.
    """
    if path.suffix not in (".pth", ".npz", ".npy"):
        raise InvalidRequest(
            f"{path.name} has the suffix '{path.suffix}': track files are .pth or .npz (ATI) and .npy (Wan-Move)."
        )
    if path.suffix == ".npy":
        visibility = path.with_stem(f"{path.stem}-visibility")
        np.save(path, tracks.points[None])
        np.save(visibility, tracks.visible[None])
        return path, visibility
    if tracks.num_frames > MAX_FRAMES:
        raise InvalidRequest(
            f"The clip takes {tracks.num_frames} frames at {CLIP_FPS:g} per second, and ATI's files hold {MAX_FRAMES}, "
            "5 s. Simulate a shorter one."
        )
    zipped = io.BytesIO()
    np.savez_compressed(zipped, array=to_ati_file(tracks))
    if path.suffix == ".npz":
        path.write_bytes(zipped.getvalue())
        return (path,)
    try:
        import torch  # noqa: PLC0415
    except ImportError as error:
        raise InvalidRequest(f".pth files need PyTorch: {install_line('wan')}, or use .npz.") from error
    torch.save(zipped.getvalue(), path)
    return (path,)
