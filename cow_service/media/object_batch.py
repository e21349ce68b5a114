"""Several artifacts on their way to an object store at the same time."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from cow_service.errors import StorageUnavailable
from cow_service.media.artifacts import artifact_of, extension_of
from cow_service.records import Artifact


class ObjectBatch:
    """An `ArtifactWriter` that hands the bytes to other threads. It belongs to one thread."""

    def __init__(
        self,
        threads: Executor,
        send: Callable[[str, bytes, str], Artifact],  # digest, bytes, media type
        scratch: Callable[[], AbstractContextManager[Path]],
    ) -> None:
        self._threads, self._send, self._scratch = threads, send, scratch
        self._sent: list[Future[Artifact]] = []

    def put(self, data: bytes, media_type: str) -> Artifact:
        """Begins to send bytes."""
        extension_of(media_type)
        sha256 = hashlib.sha256(data).hexdigest()
        self._sent.append(self._threads.submit(self._send, sha256, data, media_type))
        return artifact_of(sha256, media_type, len(data))

    def put_file(self, path: Path, media_type: str) -> Artifact:
        """Begins to send the bytes of a file, which is deleted at once."""
        extension_of(media_type)
        return self.put(take_file(path), media_type)

    def scratch(self) -> AbstractContextManager[Path]:
        """A path for a temporary file."""
        return self._scratch()

    def wait(self) -> None:
        """Waits for all. Raises `StorageUnavailable` where one could not be sent."""
        for each in self._sent:
            each.result()


def take_file(path: Path) -> bytes:
    """The bytes of a file, which is deleted."""
    with scratch_errors():
        data = path.read_bytes()
        path.unlink()
        return data


@contextmanager
def scratch_errors() -> Generator[None]:
    """Translates the errors of temporary files to `StorageUnavailable`."""
    try:
        yield
    except OSError as error:
        raise StorageUnavailable(
            f"The data folder cannot be used for temporary files ({error.strerror or type(error).__name__})."
        ) from error
