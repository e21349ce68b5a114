"""The store of images, frames, masks and clips: bytes that are named by their SHA-256.

`ArtifactStore` says what a store does. `DiskArtifacts` keeps files in a folder; `ObjectArtifacts`, in a module of its
own because it needs obstore, keeps objects in S3 and the like. (obstore's own store for folders does not sync what it
writes, and keeps neither media types nor the time of last use.) Bytes that no longer match their name are removed when
that is noticed; they come back when the same bytes are sent or computed again.
"""

import errno
import hashlib
import logging
import os
import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias
from uuid import uuid4

from filelock import FileLock

from cow_service.errors import ArtifactNotFound, StorageUnavailable
from cow_service.records import Artifact

MEDIA_TYPES = {
    "image/png": "png",
    "image/jpeg": "jpg",
    "image/webp": "webp",
    "video/mp4": "mp4",
    "application/json": "json",
}
PRIVATE = 0o600  # what the service keeps is for its own user alone: pictures and questions of callers
MAX_VERIFIED = 10_000  # digests that a process remembers to have compared with their bytes
TEMPORARY_SUFFIX = ".part"

_DIGEST = re.compile(r"[0-9a-f]{64}")

log = logging.getLogger("cow_service")


@dataclass(frozen=True, slots=True)
class ListedArtifact:
    """An artifact as a listing has it. No job needed it after `used_at`, seconds since 1970."""

    sha256: str
    size: int  # bytes
    used_at: float


# Does what writes an artifact, and repeats it while the store is away. Raises `StorageUnavailable` after the last try,
# and `Canceled`.
RetryPolicy: TypeAlias = Callable[[Callable[[], Artifact]], Artifact]
Put: TypeAlias = Callable[[bytes, str], Artifact]  # `ArtifactStore.put`


def make_private(folder: Path) -> None:
    """Makes a folder, and those above it that are missing, for this process's user alone. Raises `OSError`."""
    for each in (*reversed(folder.parents), folder):
        each.mkdir(mode=0o700, exist_ok=True)


def try_once(work: Callable[[], Artifact]) -> Artifact:
    """The `RetryPolicy` that repeats nothing."""
    return work()


class ArtifactStore(ABC):
    """Stores, reads, lists and deletes bytes. Every method raises `StorageUnavailable` where that cannot be done.

    Threads may share it.
    """

    def __init__(self, scratch_folder: Path) -> None:
        self.scratch_folder = scratch_folder  # the store's folder, or one next to the jobs if the store has none
        self._verified: dict[str, object] = {}  # by digest, the version whose bytes were compared with it

    @abstractmethod
    def put(self, data: bytes, media_type: str) -> Artifact:
        """Stores bytes, also where those that are stored under their digest are damaged; marks them as used now.

        Raises `ValueError` if the media type is not in `MEDIA_TYPES`.
        """

    @contextmanager
    def scratch(self) -> Generator[Path]:
        """An empty temporary file on this machine, which is deleted afterwards."""
        with disk_errors():
            make_private(self.scratch_folder)
            path = self.scratch_folder / f".{uuid4().hex}{TEMPORARY_SUFFIX}"
            path.touch(PRIVATE)
        try:
            yield path
        finally:
            path.unlink(missing_ok=True)

    @property
    @abstractmethod
    def address(self) -> str:
        """Names the store, the same for every process that shares it. It holds no credentials."""

    @abstractmethod
    def get(self, sha256: str) -> Artifact:
        """Finds an artifact. Raises `ArtifactNotFound` if there is none, or if it is not a digest at all."""

    @abstractmethod
    def read(self, sha256: str) -> bytes:
        """The bytes of an artifact, which are those of its digest; marks it as used now. Raises as `get` does."""

    @abstractmethod
    def touch(self, *sha256: str) -> None:
        """Marks artifacts whose bytes are those of their digests as used now. Raises as `get` does."""

    @abstractmethod
    def local_file(self, sha256: str) -> AbstractContextManager[Path]:
        """A file with the bytes of an artifact, which is there inside the block. Raises as `get` does."""

    def signed_url(self, sha256: str, seconds: float) -> str | None:
        """A URL under which anybody can get an artifact for so long; None if the store has none."""
        return None

    @abstractmethod
    def delete(self, artifacts: Collection[str], untouched_since: float) -> set[str]:
        """Deletes artifacts, given by their digests, except those used after that time (seconds since 1970).

        The time of last use is looked up right before the deletion: a listing may be older. Returns what was deleted.
        """

    @abstractmethod
    def listed(self) -> Iterator[ListedArtifact]:
        """All artifacts, in no particular order, as they are found: there may be too many to hold them all."""

    @contextmanager
    def batch(self, retry: RetryPolicy = try_once) -> Generator[Put]:
        """A `put` that may go on while its caller does; all that was put is there when the block ends.

        `retry` does each of them: what is written took long to make, and is not made again for an outage. The end of
        the block raises what any of them raises. Here they run one after another: a disk is no faster for many threads.
        """
        yield lambda data, media_type: retry(lambda: self.put(data, media_type))

    @abstractmethod
    def check(self) -> None:
        """Writes a small thing and removes or replaces it. Raises `StorageUnavailable` if that fails."""

    def remove_leftovers(self, untouched_since: float) -> None:
        """Removes temporary files of processes that were killed: those not written to after that time."""
        with disk_errors():
            for path in self.scratch_folder.glob(f".*{TEMPORARY_SUFFIX}"):
                with suppress(FileNotFoundError):  # its process has just ended its work
                    if path.stat().st_mtime <= untouched_since:
                        path.unlink()

    def _note_verified(self, sha256: str, version: object) -> None:
        if len(self._verified) >= MAX_VERIFIED:
            self._verified.clear()
        self._verified[sha256] = version


class DiskArtifacts(ArtifactStore):
    """Files `<folder>/<first two digits>/<digest>.<extension>`; the extension keeps the media type.

    The folder is made when it is first needed. The time of a file is that of its last use.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self._folder = folder
        self._commit_lock = threading.Lock()

    @property
    def address(self) -> str:
        """A random name that lies in the folder: other machines may see the folder under another path."""
        name = self._folder / "name"
        with disk_errors():
            make_private(self._folder)
            with FileLock(self._folder / "name.lock", mode=PRIVATE):
                if not name.exists():
                    with self._written(uuid4().hex.encode()) as temporary:
                        _move(temporary, name)
                return f"folder:{name.read_text()}"

    def put(self, data: bytes, media_type: str) -> Artifact:
        """Stores bytes. Bytes that are stored already keep their first media type."""
        extension = extension_of(media_type)
        sha256 = hashlib.sha256(data).hexdigest()
        with disk_errors():
            if known := self._find_intact(sha256):
                self._mark_used(known)
                return _artifact_at(known)
            # Two threads may store the same bytes under two media types: the first one decides.
            with self._written(data) as temporary, self._commit_lock:
                stored = self._find_intact(sha256)
                if stored is None:
                    stored = self._folder / sha256[:2] / f"{sha256}.{extension}"
                    make_private(stored.parent)
                    _move(temporary, stored)
                    self._note_verified(sha256, _version(stored))
            return _artifact_at(stored)

    def get(self, sha256: str) -> Artifact:
        """Finds an artifact whose bytes are those of its digest."""
        with disk_errors(sha256):
            return _artifact_at(self._get(sha256))

    def read(self, sha256: str) -> bytes:
        """Reads the file."""
        with disk_errors(sha256):
            path = self._get(sha256)
            self._mark_used(path)
            return path.read_bytes()

    def touch(self, *sha256: str) -> None:
        """Sets the times of the files."""
        for one in sha256:
            with disk_errors(one):
                self._mark_used(self._get(one))

    @contextmanager
    def local_file(self, sha256: str) -> Generator[Path]:
        """The file itself."""
        with disk_errors(sha256):
            path = self._get(sha256)
        yield path

    def delete(self, artifacts: Collection[str], untouched_since: float) -> set[str]:
        """Deletes the files."""
        deleted = set[str]()
        for sha256 in artifacts:
            with disk_errors(), suppress(FileNotFoundError):  # another process has just deleted it
                path = self._find(sha256)
                if path is not None and path.stat().st_mtime <= untouched_since:
                    path.unlink()
                    deleted.add(sha256)
        return deleted

    def listed(self) -> Iterator[ListedArtifact]:
        """All files that are named by a digest."""
        with disk_errors():
            for folder in self._folder.glob("[0-9a-f][0-9a-f]"):
                with suppress(NotADirectoryError), os.scandir(folder) as entries:
                    for entry in entries:
                        sha256, _, extension = entry.name.partition(".")
                        with suppress(FileNotFoundError):  # deleted meanwhile
                            if extension and is_digest(sha256):
                                status = entry.stat()
                                yield ListedArtifact(sha256, status.st_size, status.st_mtime)

    def check(self) -> None:
        """Writes, syncs and removes a small file."""
        with disk_errors(), self._written(b"\0"):
            pass

    @contextmanager
    def _written(self, data: bytes) -> Generator[Path]:
        """A temporary file of these bytes, which are on the disk."""
        with self.scratch() as path:
            with path.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            yield path

    def _find(self, sha256: str) -> Path | None:
        for extension in MEDIA_TYPES.values():
            path = self._folder / sha256[:2] / f"{sha256}.{extension}"
            with suppress(FileNotFoundError):
                path.stat()
                return path
        return None

    def _find_intact(self, sha256: str) -> Path | None:
        """A stored file that holds what its name says, compared once for as long as it is not changed."""
        path = self._find(sha256)
        try:
            if path is None or self._verified.get(sha256) == _version(path):
                return path
            with path.open("rb") as file:
                found = hashlib.file_digest(file, "sha256").hexdigest()
            if found == sha256:
                self._note_verified(sha256, _version(path))
                return path
        except FileNotFoundError:  # it was deleted just now
            return None
        log.error("artifact %s is damaged and was removed", sha256)
        path.unlink(missing_ok=True)
        return None

    def _get(self, sha256: str) -> Path:
        check_digest(sha256)
        path = self._find_intact(sha256)
        if path is None:
            raise not_found(sha256)
        return path

    def _mark_used(self, path: Path) -> None:
        os.utime(path)  # maintenance deletes by this time
        self._note_verified(path.stem, _version(path))


def _artifact_at(path: Path) -> Artifact:
    media_type = next(name for name, extension in MEDIA_TYPES.items() if path.suffix == f".{extension}")
    return artifact_of(path.stem, media_type, path.stat().st_size)


def _version(path: Path) -> tuple[int, ...]:
    """What changes with the bytes of a file, unless the disk itself damages them."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


def _move(temporary: Path, stored: Path) -> None:
    """Gives a file that is on the disk its name there."""
    temporary.replace(stored)
    folder = os.open(stored.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


@contextmanager
def disk_errors(sha256: str | None = None) -> Generator[None]:
    """Turns an `OSError` into `StorageUnavailable`, without its text, which holds the path.

    With a digest, a file that is not there becomes `ArtifactNotFound`.
    """
    try:
        yield
    except OSError as error:
        if sha256 is not None and isinstance(error, FileNotFoundError):
            raise not_found(sha256) from error
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise StorageUnavailable("The disk of the data folder is full: free some space and try again.") from error
        reason = os.strerror(error.errno) if error.errno else type(error).__name__
        raise StorageUnavailable(
            f"The data folder cannot be used ({reason}): give a folder that the server can read and write."
        ) from error


def artifact_of(sha256: str, media_type: str, size: int) -> Artifact:
    """The record of an artifact of so many bytes."""
    return Artifact(sha256=sha256, url=f"/artifacts/{sha256}", media_type=media_type, size=size)


def media_type_of(data: bytes) -> str | None:
    """The media type of an image or MP4 file, by its first 12 bytes; None for anything else."""
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return "image/png"
    if data.startswith(b"\xff\xd8\xff"):
        return "image/jpeg"
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return "image/webp"
    return "video/mp4" if data[4:8] == b"ftyp" else None


def extension_of(media_type: str) -> str:
    """The extension of files of a media type. Raises `ValueError` if it is not in `MEDIA_TYPES`."""
    if media_type not in MEDIA_TYPES:
        raise ValueError(f"The media type {media_type!r} is not supported: use one of {', '.join(MEDIA_TYPES)}.")
    return MEDIA_TYPES[media_type]


def is_digest(name: str) -> bool:
    """Whether a name is a SHA-256 in hexadecimal digits."""
    return _DIGEST.fullmatch(name) is not None


def check_digest(name: str) -> None:
    """Raises `ArtifactNotFound` for what is no digest: nothing else may become part of a path."""
    if not is_digest(name):
        raise ArtifactNotFound(f"No artifact is named {name[:80]!r}: give its SHA-256, 64 lower-case hex digits.")


def not_found(sha256: str) -> ArtifactNotFound:
    """The error for a digest that nothing is kept under."""
    return ArtifactNotFound(
        f"No artifact has the SHA-256 {sha256}: send the image again, or run the simulation that made it."
    )
