"""Artifacts as files of one folder.

The layout is `<folder>/<first two digits>/<digest>.<extension>`; the extension keeps the media type. The time of a file
is that of its last use.
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import threading
from collections.abc import Generator, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from uuid import uuid4

from filelock import FileLock

from cow_service.errors import StorageUnavailable
from cow_service.media.artifacts import (
    MAX_VERIFIED,
    MEDIA_TYPES,
    ArtifactWriter,
    ListedArtifact,
    Patience,
    artifact_of,
    check_digest,
    extension_of,
    is_digest,
    not_found,
    try_once,
)
from cow_service.media.temporary_files import remove_temporary_files, temporary_beside
from cow_service.records import Artifact

_FULL = (errno.ENOSPC, errno.EDQUOT)

log = logging.getLogger("cow_service")


@dataclass(frozen=True)
class _StoredFile:
    artifact: Artifact
    path: Path


class DiskArtifacts:
    """An `ArtifactStore` of files under one folder, which is made when first needed."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._commit_lock = threading.Lock()
        self._verified: dict[str, tuple[int, ...]] = {}  # files whose bytes were compared with their names

    @property
    def address(self) -> str:
        """A random name that lies in the folder: other machines may see the folder under another path."""
        name = self._folder / "name"
        with _storage_errors():
            self._folder.mkdir(parents=True, exist_ok=True)
            with FileLock(self._folder / "name.lock"):
                if not name.exists():
                    name.write_text(uuid4().hex)
                return f"folder:{name.read_text()}"

    def put(self, data: bytes, media_type: str) -> Artifact:
        """Stores bytes. Bytes that are stored already keep their first media type."""
        extension = extension_of(media_type)
        sha256 = hashlib.sha256(data).hexdigest()
        with _storage_errors():
            known = self._intact(sha256)
            if known is not None:
                self._use(known)
                return known.artifact
            target = self._target(sha256, extension)
            with temporary_beside(target) as temporary:
                with temporary.open("xb") as file:
                    file.write(data)
                    _sync(file)
                return self._commit(temporary, target, sha256)

    def put_file(self, path: Path, media_type: str) -> Artifact:
        """Moves in a file, hashing it in chunks."""
        extension = extension_of(media_type)
        with _storage_errors():
            with path.open("rb+") as file:
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
                _sync(file)
            target = self._target(sha256, extension)
            with temporary_beside(target) as temporary:
                path.replace(temporary)
                return self._commit(temporary, target, sha256)

    def get(self, sha256: str) -> Artifact:
        """Finds an artifact whose bytes are those of its digest."""
        return self._get(sha256).artifact

    def read(self, sha256: str) -> bytes:
        """Reads the file."""
        stored = self._get(sha256)
        with _storage_errors(), _deleted_meanwhile(sha256):
            self._use(stored)
            return stored.path.read_bytes()

    def touch(self, *sha256: str) -> None:
        """Sets the times of the files."""
        for one in sha256:
            stored = self._get(one)
            with _storage_errors(), _deleted_meanwhile(one):
                self._use(stored)

    @contextmanager
    def local_file(self, sha256: str) -> Generator[Path]:
        """The file itself."""
        yield self._get(sha256).path

    def signed_url(self, sha256: str, seconds: float) -> str | None:
        """There is none."""
        return None

    def delete(self, sha256: str, untouched_since: float) -> bool:
        """Deletes the file unless it was used after that time (seconds since 1970)."""
        with _storage_errors():
            stored = self._find(sha256)
            if stored is None or stored.path.stat().st_mtime > untouched_since:
                return False
            stored.path.unlink(missing_ok=True)
        return True

    def listed(self) -> Iterator[ListedArtifact]:
        """All files that are named by a digest."""
        with _storage_errors():
            for folder in self._folder.glob("[0-9a-f][0-9a-f]"):
                with suppress(NotADirectoryError), os.scandir(folder) as entries:
                    for entry in entries:
                        sha256, _, extension = entry.name.partition(".")
                        with suppress(FileNotFoundError):  # deleted meanwhile
                            if extension and is_digest(sha256):
                                status = entry.stat()
                                yield ListedArtifact(sha256, status.st_size, status.st_mtime)

    @contextmanager
    def scratch(self) -> Generator[Path]:
        """A path on the disk of the folder, so that the file needs no copying."""
        with ExitStack() as stack:
            with _storage_errors():
                path = stack.enter_context(temporary_beside(self._folder / "scratch"))
            yield path

    @contextmanager
    def batch(self, patience: Patience = try_once) -> Generator[ArtifactWriter]:
        """One after another: a disk writes no faster for several threads."""
        yield _Batch(self, patience)

    def remove_leftovers(self, untouched_since: float) -> None:
        """Looks for them beside the artifacts."""
        with _storage_errors():
            remove_temporary_files(self._folder, untouched_since)

    def check(self) -> None:
        """Writes, syncs and removes a small file."""
        with _storage_errors(), temporary_beside(self._folder / "check") as temporary, temporary.open("xb") as file:
            file.write(b"\0")
            _sync(file)

    def _get(self, sha256: str) -> _StoredFile:
        check_digest(sha256)
        with _storage_errors():
            stored = self._intact(sha256)
        if stored is None:
            raise not_found(sha256)
        return stored

    def _use(self, stored: _StoredFile) -> None:
        os.utime(stored.path)  # it is in use: maintenance deletes by this time
        self._note_verified(stored)

    def _intact(self, sha256: str) -> _StoredFile | None:
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

    def _note_verified(self, stored: _StoredFile) -> None:
        if len(self._verified) >= MAX_VERIFIED:
            self._verified.clear()
        self._verified[stored.artifact.sha256] = _state(stored.path)

    def _target(self, sha256: str, extension: str) -> Path:
        return self._folder / sha256[:2] / f"{sha256}.{extension}"

    def _find(self, sha256: str) -> _StoredFile | None:
        for media_type, extension in MEDIA_TYPES.items():
            path = self._target(sha256, extension)
            try:
                size = path.stat().st_size
            except FileNotFoundError:
                continue
            return _StoredFile(artifact_of(sha256, media_type, size), path)
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


class _Batch:
    """An `ArtifactWriter` that waits while the disk is full or away."""

    def __init__(self, store: DiskArtifacts, patience: Patience) -> None:
        self._store, self._patience = store, patience

    def put(self, data: bytes, media_type: str) -> Artifact:
        return self._patience(lambda: self._store.put(data, media_type))

    def put_file(self, path: Path, media_type: str) -> Artifact:
        return self._patience(lambda: self._store.put_file(path, media_type))

    def scratch(self) -> AbstractContextManager[Path]:
        return self._store.scratch()


def _state(path: Path) -> tuple[int, ...]:
    """What changes with the bytes of a file, unless the disk itself damages them."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


@contextmanager
def _deleted_meanwhile(sha256: str) -> Generator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise not_found(sha256) from error


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
