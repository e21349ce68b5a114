"""Frames, masks and clips as files, named by the SHA-256 of their bytes.

The layout is `<folder>/<first two digits>/<digest>.<extension>`; the extension keeps the media type. A file whose bytes
are no longer those of its name is removed when that is seen: it is then as if it had never been kept, and comes back
when the same bytes are sent or computed again.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import threading
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

from cow_service.errors import ArtifactNotFound, StorageUnavailable
from cow_service.records import Artifact

MEDIA_TYPES = {
    "image/png": "png",
    "image/jpeg": "jpg",
    "image/webp": "webp",
    "video/mp4": "mp4",
    "application/json": "json",
}

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}
_DIGEST = re.compile(r"[0-9a-f]{64}")
_FULL = (errno.ENOSPC, errno.EDQUOT)
_MAX_SHOWN_CHARACTERS = 80
MAX_VERIFIED = 10_000  # files

log = logging.getLogger("cow_service")


def media_type_of(data: bytes) -> str | None:
    """The media type of an image or MP4 file, by its first 12 bytes; None for anything else."""
    for signature, media_type in _SIGNATURES.items():
        if data.startswith(signature):
            return media_type
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return "image/webp"
    return "video/mp4" if data[4:8] == b"ftyp" else None


@dataclass(frozen=True)
class StoredArtifact:
    """An artifact and where its bytes are on this machine. The path never leaves the server."""

    artifact: Artifact
    path: Path


class ArtifactStore:
    """Content-addressed files under one folder, made when first needed. Safe to share between threads.

    Every method raises `StorageUnavailable` where the folder cannot be read or written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._commit_lock = threading.Lock()
        self._verified: dict[str, tuple[int, ...]] = {}  # files whose bytes were compared with their names

    def put(self, data: bytes, media_type: str) -> Artifact:
        """Stores bytes. Bytes that are stored already keep their first media type.

        Raises `ValueError` if the media type is not in `MEDIA_TYPES`.
        """
        extension = _extension(media_type)
        sha256 = hashlib.sha256(data).hexdigest()
        with _storage_errors():
            known = self._intact(sha256)
            if known is not None:
                self._use(known)
                return known.artifact
            target = self._target(sha256, extension)
            with _temporary_beside(target) as temporary:
                with temporary.open("xb") as file:
                    file.write(data)
                    _sync(file)
                return self._commit(temporary, target, sha256)

    def put_file(self, path: Path, media_type: str) -> Artifact:
        """Moves in a finished file of `scratch`, hashing it in chunks; afterwards `path` no longer exists.

        Raises `ValueError` if the media type is not in `MEDIA_TYPES`.
        """
        extension = _extension(media_type)
        with _storage_errors():
            with path.open("rb+") as file:
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
                _sync(file)
            target = self._target(sha256, extension)
            with _temporary_beside(target) as temporary:
                path.replace(temporary)
                return self._commit(temporary, target, sha256)

    def get(self, sha256: str) -> StoredArtifact:
        """Find an artifact. Raises `ArtifactNotFound` if there is none, or if it is not a digest at all."""
        if _DIGEST.fullmatch(sha256) is None:
            # Before any path is built: only a digest may become part of one.
            raise ArtifactNotFound(
                f"No artifact is named {sha256[:_MAX_SHOWN_CHARACTERS]!r}: give its SHA-256, 64 lower-case hex digits."
            )
        with _storage_errors():
            stored = self._intact(sha256)
        if stored is None:
            raise ArtifactNotFound(
                f"No artifact has the SHA-256 {sha256}: send the image again, or run the simulation that made it."
            )
        return stored

    def touch(self, sha256: str) -> None:
        """Marks an artifact as used now. Raises as `get` does."""
        stored = self.get(sha256)
        with _storage_errors():
            self._use(stored)

    def delete(self, sha256: str, untouched_since: float) -> bool:
        """Deletes an artifact unless it was used after that time (seconds since 1970). Returns whether it did."""
        with _storage_errors():
            stored = self._find(sha256)
            if stored is None or stored.path.stat().st_mtime > untouched_since:
                return False
            stored.path.unlink(missing_ok=True)
        return True

    def untouched_since(self, moment: float) -> Iterator[str]:
        """Digests of the artifacts not used after that time (seconds since 1970)."""
        with _storage_errors():
            for path in self._folder.glob("[0-9a-f][0-9a-f]/*.*"):
                if _DIGEST.fullmatch(path.stem) and path.stat().st_mtime <= moment:
                    yield path.stem

    def read(self, sha256: str) -> bytes:
        """The bytes of an artifact. Raises as `get` does."""
        path = self.get(sha256).path
        with _storage_errors():
            return path.read_bytes()

    @contextmanager
    def scratch(self) -> Generator[Path]:
        """A path on the data folder's disk for a temporary file; deleted afterwards unless `put_file` moved it."""
        with ExitStack() as stack:
            with _storage_errors():
                path = stack.enter_context(_temporary_beside(self._folder / "scratch"))
            yield path

    def check(self) -> None:
        """Write, sync and remove a small file. Raises `StorageUnavailable` if that fails."""
        with _storage_errors(), _temporary_beside(self._folder / "check") as temporary, temporary.open("xb") as file:
            file.write(b"\0")
            _sync(file)

    def _use(self, stored: StoredArtifact) -> None:
        os.utime(stored.path)  # it is in use: maintenance deletes by this time
        self._note_verified(stored)

    def _intact(self, sha256: str) -> StoredArtifact | None:
        """A stored file that holds what its name says, compared once for as long as it is not changed."""
        stored = self._find(sha256)
        try:
            if stored is None or self._verified.get(sha256) == _state(stored.path):
                return stored
            with stored.path.open("rb") as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()
            if found == sha256:
                self._note_verified(stored)
                return stored
        except FileNotFoundError:  # it was deleted just now
            return None
        log.error("artifact %s is damaged and was removed", sha256)
        stored.path.unlink(missing_ok=True)
        return None

    def _note_verified(self, stored: StoredArtifact) -> None:
        if len(self._verified) >= MAX_VERIFIED:
            self._verified.clear()
        self._verified[stored.artifact.sha256] = _state(stored.path)

    def _target(self, sha256: str, extension: str) -> Path:
        return self._folder / sha256[:2] / f"{sha256}.{extension}"

    def _find(self, sha256: str) -> StoredArtifact | None:
        for media_type, extension in MEDIA_TYPES.items():
            path = self._target(sha256, extension)
            try:
                size = path.stat().st_size
            except FileNotFoundError:
                continue
            url = f"/artifacts/{sha256}"
            return StoredArtifact(Artifact(sha256=sha256, url=url, media_type=media_type, size=size), path)
        return None

    def _commit(self, temporary: Path, target: Path, sha256: str) -> Artifact:
        # Two threads may store the same bytes under two media types: the first one decides.
        with self._commit_lock:
            stored = self._intact(sha256)
            if stored is None:
                temporary.replace(target)
                stored = self._find(sha256)
                if stored is not None:
                    self._note_verified(stored)
        if stored is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        return stored.artifact


def _state(path: Path) -> tuple[int, ...]:
    """What changes with the bytes of a file, unless the disk itself damages them."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


def _extension(media_type: str) -> str:
    if media_type not in MEDIA_TYPES:
        raise ValueError(f"The media type {media_type!r} is not kept: use one of {', '.join(MEDIA_TYPES)}.")
    return MEDIA_TYPES[media_type]


@contextmanager
def _temporary_beside(target: Path) -> Generator[Path]:
    """A name for a file that does not exist yet, on the target's own disk so that it can be renamed to it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.parent / f".{uuid4().hex}.part"
    try:
        yield temporary
    finally:
        temporary.unlink(missing_ok=True)


def _sync(file: BinaryIO) -> None:
    file.flush()
    os.fsync(file.fileno())


@contextmanager
def _storage_errors() -> Generator[None]:
    try:
        yield
    except OSError as error:
        if error.errno in _FULL:
            raise StorageUnavailable("The disk of the data folder is full: free some space and try again.") from error
        # The reason alone: the text of an OSError holds the path.
        reason = os.strerror(error.errno) if error.errno else type(error).__name__
        raise StorageUnavailable(
            f"The data folder cannot be used ({reason}): make it a folder that the server may read and write."
        ) from error
