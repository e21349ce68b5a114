"""Reads and writes the track files of ATI (`.pth`, `.npz`) and Wan-Move (`.npy`).

ATI's `.pth` is a saved string of bytes: the `.npz` file, whose array is called `array`. Wan-Move keeps positions in one
`.npy` file and visibility in another. Reading runs no code that a file brings: no pickled objects are taken.
"""

from __future__ import annotations

import io
import warnings
import zipfile
import zlib
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cow_service.errors import InvalidRequest
from cow_service.generators.wan.tracks import FILE_SAMPLES, MAX_FRAMES, Tracks, from_ati_file, to_ati_file
from cow_service.vision.masks import Floats32

ARRAY = "array"  # its name in the .npz file
VISIBILITY = "-visibility"  # between the name of Wan-Move's file of positions and its suffix
MOST = 10_000_000  # numbers in a file
SUFFIXES = (".pth", ".npz", ".npy")


def write_tracks(tracks: Tracks, path: Path) -> tuple[Path, ...]:
    """Writes the form that the suffix names, and says which files that were.

    Raises `InvalidRequest` for another suffix, a clip that is too long for ATI, or `.pth` without PyTorch.
    """
    if path.suffix in (".pth", ".npz") and tracks.num_frames > MAX_FRAMES:
        raise InvalidRequest(
            f"The trajectory has {tracks.num_frames} frames: ATI's files hold {MAX_FRAMES}. Simulate with that many."
        )
    if path.suffix == ".npy":
        other = path.with_name(path.stem + VISIBILITY + path.suffix)
        np.save(path, tracks.points[None])
        np.save(other, tracks.visible[None])
        return path, other
    if path.suffix == ".npz":
        path.write_bytes(_zipped(to_ati_file(tracks)))
    elif path.suffix == ".pth":
        _torch().save(_zipped(to_ati_file(tracks)), path)
    else:
        raise _unknown(path)
    return (path,)


def read_tracks(path: Path, visibility: Path | None = None) -> Tracks:
    """The tracks of a file, at the frames of a clip.

    `visibility` is the other file of Wan-Move; without it the one that `write_tracks` puts beside is taken, and where
    there is none every point counts as visible. Raises `InvalidRequest` saying what is wrong with the file.
    """
    if path.suffix not in SUFFIXES:
        raise _unknown(path)
    if visibility is not None and path.suffix != ".npy":
        raise InvalidRequest(f"{path.name} holds its own visibility: a file of it goes with .npy alone.")
    try:
        if path.suffix == ".npy":
            return _wan_move(path, visibility)
        return from_ati_file(_ati_array(path))
    except (OSError, ValueError, TypeError, KeyError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        missing = isinstance(error, FileNotFoundError)
        reason = "there is no such file" if missing else f"it is damaged, or no {path.suffix} file of plain numbers"
        raise InvalidRequest(f"{path.name} cannot be read: {reason}.") from error


def _ati_array(path: Path) -> Floats32:
    data = path.read_bytes() if path.suffix == ".npz" else _saved_bytes(path)
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


def _saved_bytes(path: Path) -> bytes | NDArray[np.generic]:
    torch = _torch()
    try:
        with warnings.catch_warnings():  # PyTorch remarks on how it was pickled
            warnings.simplefilter("ignore")
            saved = torch.load(path, map_location="cpu", weights_only=True)
    except (UnpicklingError, RuntimeError, KeyError, EOFError) as error:
        raise InvalidRequest(
            f"{path.name} is damaged, or holds more than plain data, which is not read: it could run code."
        ) from error
    if isinstance(saved, bytes):
        return saved
    if isinstance(saved, torch.Tensor):
        return saved.detach().float().numpy()
    raise InvalidRequest(f"{path.name} holds a {type(saved).__name__}: ATI's tracks are the bytes of an .npz file.")


def _wan_move(path: Path, visibility: Path | None) -> Tracks:
    points = _numbers(path, np.load(path, allow_pickle=False))
    points = points[0] if points.ndim == 4 and points.shape[0] == 1 else points
    if points.ndim != 3 or points.shape[2] != 2 or not points.shape[0]:
        raise InvalidRequest(f"{path.name} holds {list(points.shape)}: Wan-Move's tracks are [F, N, 2].")
    # As `write_tracks` names it, and as Wan-Move's own examples do.
    names = (
        path.stem + VISIBILITY,
        path.stem.replace("tracks", "visibility"),
        path.stem.replace("track", "visibility"),
    )
    beside = [path.with_name(name + path.suffix) for name in names if name != path.stem]
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


def _zipped(array: Floats32) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, array=array)
    return file.getvalue()


def _torch() -> Any:
    try:
        import torch  # noqa: PLC0415
    except ImportError as error:
        raise InvalidRequest('.pth files need PyTorch: pip install "cow-service[wan]", or use .npz.') from error
    return torch


def _unknown(path: Path) -> InvalidRequest:
    return InvalidRequest(
        f"{path.name} has the suffix '{path.suffix}': track files are .pth or .npz (ATI) and .npy (Wan-Move)."
    )
