"""Tracks in the forms that ATI and Wan-Move read, made from a trajectory, and their files. No PyTorch but for `.pth`.

A trajectory is sampled at the frames of its clip, in pixels of the input image. ATI's file form has 121 samples,
1.5 for each frame of its 81-frame clip: 24 per second where the clip has 16. Wan-Move has one sample per frame. After
its last frame a track stays where it is.

ATI's `.pth` is a saved string of bytes: the `.npz` file, whose array is called `array`. Wan-Move keeps positions in one
`.npy` file and visibility in another. Reading runs no code that a file brings: no pickled objects are taken.

Sources: the public implementations of ATI (arXiv 2505.22944) and Wan-Move (arXiv 2512.08765).
"""

import io
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cow_service.errors import InvalidRequest
from cow_service.records import Trajectory
from cow_service.vision.types import Floats, Floats32

MAX_FRAMES = 81  # of a Wan2.1 clip
STRIDE = 4  # clip frames per latent frame, after the first
FILE_SAMPLES = 121
FILE_UNITS_PER_PIXEL = 8
SAMPLES_PER_FRAME = 1.5
MAX_OTHER_TRACKS = 40  # of the bodies that the mover sets moving: memory and time of a clip grow with their number

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

    def held(self) -> "Tracks":
        """Without tracks that are never visible; zeros where a track is not, which stand for no place, become its last.

        Before a track is first seen they become its first place.
        """
        ever = self.visible.any(axis=0)
        points, visible = self.points[:, ever].copy(), self.visible[:, ever]
        placed = visible | points.any(axis=2)
        for track in range(points.shape[1]):
            known = placed[:, track]
            last = np.maximum.accumulate(np.where(known, np.arange(self.num_frames), -1))
            points[:, track] = points[np.where(last < 0, known.argmax(), last), track]
        return Tracks(points, visible)

    def scaled(self, x: float, y: float) -> "Tracks":
        """The same tracks on the image resized by these factors."""
        return Tracks((self.points * np.array([x, y])).astype(np.float32), self.visible)


def nearest_lengths(num_frames: int) -> tuple[int, ...]:
    """`(num_frames,)` where a clip may have that many frames (4n + 1, 5 to 81), else the legal lengths next to it."""
    if num_frames >= MAX_FRAMES:
        return (MAX_FRAMES,)
    below = max((num_frames - 1) // STRIDE * STRIDE + 1, STRIDE + 1)
    return (below,) if below >= num_frames else (below, below + STRIDE)


def tracks_of(trajectory: Trajectory, width: int, height: int) -> Tracks:
    """The tracks of every body that moves, the mover's first, then the anchors, on an image of this size (px).

    Points outside the image are not visible. The bodies after the mover share `MAX_OTHER_TRACKS`.
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
    least = max(1, MAX_OTHER_TRACKS // max(1, len(parts) - 1))
    parts[1:] = [Tracks(part.points[:, :least], part.visible[:, :least]) for part in parts[1 : MAX_OTHER_TRACKS + 1]]
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


def from_ati_file(samples: Floats32) -> Tracks:
    """The tracks at the 81 frames of a clip from ATI's file form [N, 121, 1, 3]: each frame at its own time.

    ATI's own reader (`to_ati_tensor`) takes every odd frame from the sample a third of a frame before it.
    """
    at = np.arange(MAX_FRAMES) * SAMPLES_PER_FRAME
    before, after = np.floor(at).astype(int), np.ceil(at).astype(int)
    values = samples[:, :, 0].astype(np.float64).transpose(1, 0, 2) / FILE_UNITS_PER_PIXEL
    points = (values[before, :, :2] + values[after, :, :2]) / 2
    return Tracks(points.astype(np.float32), values[np.rint(at).astype(int), :, 2] > 0.5)


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


ARRAY = "array"  # its name in the .npz file
VISIBILITY = "-visibility"  # between the name of Wan-Move's file of positions and its suffix
MOST = 10_000_000  # numbers in a file


def write_tracks(tracks: Tracks, path: Path) -> tuple[Path, ...]:
    """Writes the form that the suffix names, and says which files that were.

    Raises `InvalidRequest` for another suffix, a clip that is too long for ATI, or `.pth` without PyTorch.
    """
    _check_suffix(path)
    if path.suffix == ".npy":
        other = path.with_name(path.stem + VISIBILITY + path.suffix)
        np.save(path, tracks.points[None])
        np.save(other, tracks.visible[None])
        return path, other
    if tracks.num_frames > MAX_FRAMES:
        raise InvalidRequest(
            f"The trajectory has {tracks.num_frames} frames: ATI's files hold {MAX_FRAMES}. Simulate with that many."
        )
    zipped = io.BytesIO()
    np.savez_compressed(zipped, array=to_ati_file(tracks))
    if path.suffix == ".npz":
        path.write_bytes(zipped.getvalue())
    else:
        _import_torch().save(zipped.getvalue(), path)
    return (path,)


def read_tracks(path: Path, visibility: Path | None = None) -> Tracks:
    """The tracks of a file, at the frames of a clip.

    `visibility` is the other file of Wan-Move; without it the one that `write_tracks` puts beside is taken, and where
    there is none every point counts as visible. Raises `InvalidRequest` saying what is wrong with the file.
    """
    _check_suffix(path)
    if visibility is not None and path.suffix != ".npy":
        raise InvalidRequest(f"{path.name} holds its own visibility: a file of it goes with .npy alone.")
    try:
        if path.suffix == ".npy":
            return _wan_move(path, visibility)
        return from_ati_file(_ati_array(path))
    except InvalidRequest:
        raise
    except Exception as error:  # NumPy, zipfile and PyTorch raise a dozen kinds on damaged files
        reason = f"it is damaged, or holds more than the plain numbers of a {path.suffix} file, which could run code"
        reason = "there is no such file" if isinstance(error, FileNotFoundError) else reason
        raise InvalidRequest(f"{path.name} cannot be read: {reason}.") from error


def _ati_array(path: Path) -> Floats32:
    if path.suffix == ".npz":
        data: Any = path.read_bytes()
    else:
        torch = _import_torch()
        with warnings.catch_warnings():  # PyTorch remarks on how it was pickled
            warnings.simplefilter("ignore")
            data = torch.load(path, map_location="cpu", weights_only=True)
        if isinstance(data, torch.Tensor):
            data = data.detach().float().numpy()
        elif not isinstance(data, bytes):
            kind = type(data).__name__
            raise InvalidRequest(f"{path.name} holds a {kind}: ATI's tracks are the bytes of an .npz file.")
    if isinstance(data, bytes):
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            if ARRAY not in arrays:
                raise InvalidRequest(f"{path.name} has no '{ARRAY}', but {', '.join(arrays) or 'nothing'}.")
            data = arrays[ARRAY]
    array = _numbers(path, data)
    if array.ndim == 4 and array.shape[0] == FILE_SAMPLES != array.shape[1]:
        array = array.transpose(1, 0, 2, 3)
    if array.ndim != 4 or array.shape[1:] != (FILE_SAMPLES, 1, 3):
        raise InvalidRequest(f"{path.name} holds {list(array.shape)}: ATI's tracks are [N, {FILE_SAMPLES}, 1, 3].")
    return array


def _wan_move(path: Path, visibility: Path | None) -> Tracks:
    points = _numbers(path, np.load(path, allow_pickle=False))
    points = points[0] if points.ndim == 4 and points.shape[0] == 1 else points
    if points.ndim != 3 or points.shape[2] != 2 or not points.shape[0]:
        raise InvalidRequest(f"{path.name} holds {list(points.shape)}: Wan-Move's tracks are [F, N, 2].")
    # As `write_tracks` names it, and as Wan-Move's own examples do.
    names = path.stem + VISIBILITY, *(path.stem.replace(word, "visibility") for word in ("tracks", "track"))
    beside = [path.with_stem(name) for name in names if name != path.stem]
    file = visibility or next((other for other in beside if other.is_file()), None)
    if file is None:
        return Tracks(points, np.ones(points.shape[:2], bool))
    visible = np.load(file, allow_pickle=False)
    visible = visible[0] if visible.ndim == 3 and visible.shape[0] == 1 else visible
    if visible.shape != points.shape[:2]:
        raise InvalidRequest(f"{file.name} holds {list(visible.shape)}: the tracks need {list(points.shape[:2])}.")
    return Tracks(points, visible.astype(bool))


def _numbers(path: Path, data: NDArray[np.generic]) -> Floats32:
    if data.size > MOST:
        raise InvalidRequest(f"{path.name} holds {data.size} numbers, more than {MOST}.")
    if not np.issubdtype(data.dtype, np.number) or np.iscomplexobj(data):
        raise InvalidRequest(f"{path.name} holds {data.dtype}, not numbers.")
    array = data.astype(np.float32)
    if not np.isfinite(array).all():
        raise InvalidRequest(f"{path.name} holds numbers that are not finite.")
    return array


def _import_torch() -> Any:
    try:
        import torch  # noqa: PLC0415
    except ImportError as error:
        raise InvalidRequest('.pth files need PyTorch: pip install "cow-service[wan]", or use .npz.') from error
    return torch


def _check_suffix(path: Path) -> None:
    if path.suffix not in (".pth", ".npz", ".npy"):
        raise InvalidRequest(
            f"{path.name} has the suffix '{path.suffix}': track files are .pth or .npz (ATI) and .npy (Wan-Move)."
        )
