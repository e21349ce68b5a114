"""What keeps images, frames, masks and clips: bytes that are named by their SHA-256.

Bytes that are no longer those of their name are removed when that is seen: it is then as if they had never been kept,
and they come back when the same bytes are sent or computed again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from cow_service.errors import ArtifactNotFound
from cow_service.records import Artifact

MEDIA_TYPES = {
    "image/png": "png",
    "image/jpeg": "jpg",
    "image/webp": "webp",
    "video/mp4": "mp4",
    "application/json": "json",
}
MAX_VERIFIED = 10_000  # digests that a process remembers to have compared with their bytes

Value = TypeVar("Value")

_SIGNATURES = {b"\x89PNG\r\n\x1a\n": "image/png", b"\xff\xd8\xff": "image/jpeg"}
_DIGEST = re.compile(r"[0-9a-f]{64}")
_MAX_SHOWN_CHARACTERS = 80


def media_type_of(data: bytes) -> str | None:
    """The media type of an image or MP4 file, by its first 12 bytes; None for anything else."""
    for signature, media_type in _SIGNATURES.items():
        if data.startswith(signature):
            return media_type
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return "image/webp"
    return "video/mp4" if data[4:8] == b"ftyp" else None


@dataclass(frozen=True, slots=True)
class ListedArtifact:
    """An artifact as a listing has it. No job needed it after `used_at`, seconds since 1970."""

    sha256: str
    size: int  # bytes
    used_at: float


class Patience(Protocol):
    """Does what writes to a store, and tries it again while the store is away, for as long as its owner waits."""

    def __call__(self, work: Callable[[], Value], /) -> Value:
        """What `work` returns. Raises `StorageUnavailable` after the last try, and `Canceled`."""
        ...


def try_once(work: Callable[[], Value], /) -> Value:
    """A `Patience` that has none."""
    return work()


class ArtifactWriter(Protocol):
    """Stores bytes under their digests. Every method raises `StorageUnavailable` where the store cannot be written."""

    def put(self, data: bytes, media_type: str) -> Artifact:
        """Stores bytes, also where those that are stored under their digest are damaged; marks them as used now.

        Raises `ValueError` if the media type is not in `MEDIA_TYPES`.
        """
        ...

    def put_file(self, path: Path, media_type: str) -> Artifact:
        """Moves in a finished file of `scratch`; afterwards `path` no longer exists. Raises as `put` does."""
        ...

    def scratch(self) -> AbstractContextManager[Path]:
        """A path on this machine for a temporary file; deleted afterwards unless `put_file` moved it."""
        ...


class ArtifactStore(ArtifactWriter, Protocol):
    """Keeps bytes under their digests. Safe to share between threads.

    Every method raises `StorageUnavailable` where the store cannot be read or written.
    """

    @property
    def address(self) -> str:
        """Names the store, the same for every process that shares it. It holds no credentials."""
        ...

    def get(self, sha256: str) -> Artifact:
        """Finds an artifact. Raises `ArtifactNotFound` if there is none, or if it is not a digest at all."""
        ...

    def read(self, sha256: str) -> bytes:
        """The bytes of an artifact, which are those of its digest; marks it as used now. Raises as `get` does."""
        ...

    def touch(self, *sha256: str) -> None:
        """Marks artifacts whose bytes are those of their digests as used now. Raises as `get` does."""
        ...

    def local_file(self, sha256: str) -> AbstractContextManager[Path]:
        """A file with the bytes of an artifact, which is there inside the block. Raises as `get` does."""
        ...

    def signed_url(self, sha256: str, seconds: float) -> str | None:
        """A URL under which anybody can get an artifact for so long; None where the store has none."""
        ...

    def delete(self, sha256: str, untouched_since: float) -> bool:
        """Deletes an artifact unless it was used after that time (seconds since 1970). Returns whether it did."""
        ...

    def listed(self) -> Iterator[ListedArtifact]:
        """All artifacts, in no particular order."""
        ...

    def batch(self, patience: Patience = try_once) -> AbstractContextManager[ArtifactWriter]:
        """A writer several of whose puts may run at the same time; all are done when its block ends.

        Each of them is done by `patience`: what is written took long to make, and is not made again for an outage. The
        end of the block raises what any of them raises.
        """
        ...

    def remove_leftovers(self, untouched_since: float) -> None:
        """Removes temporary files of processes that were killed: those not written to after that time."""
        ...

    def check(self) -> None:
        """Writes a small thing and removes or replaces it. Raises `StorageUnavailable` if that fails."""
        ...


def artifact_of(sha256: str, media_type: str, size: int) -> Artifact:
    """The record of an artifact of so many bytes."""
    return Artifact(sha256=sha256, url=f"/artifacts/{sha256}", media_type=media_type, size=size)


def is_digest(name: str) -> bool:
    """Whether a name is a SHA-256 in hexadecimal digits."""
    return _DIGEST.fullmatch(name) is not None


def check_digest(name: str) -> None:
    """Raises `ArtifactNotFound` for what is no digest: nothing else may become part of a path."""
    if not is_digest(name):
        raise ArtifactNotFound(
            f"No artifact is named {name[:_MAX_SHOWN_CHARACTERS]!r}: give its SHA-256, 64 lower-case hex digits."
        )


def not_found(sha256: str) -> ArtifactNotFound:
    """The error for a digest that nothing is kept under."""
    return ArtifactNotFound(
        f"No artifact has the SHA-256 {sha256}: send the image again, or run the simulation that made it."
    )


def extension_of(media_type: str) -> str:
    """The extension of files of a media type. Raises `ValueError` if it is not in `MEDIA_TYPES`."""
    if media_type not in MEDIA_TYPES:
        raise ValueError(f"The media type {media_type!r} is not kept: use one of {', '.join(MEDIA_TYPES)}.")
    return MEDIA_TYPES[media_type]
