"""Artifacts as objects of S3, Google Cloud Storage, Azure or compatible stores, through obstore.

An object is `<prefix>/<digest>`; its content type is the media type. The time of an object is that of its last use, but
for `RENEWED_AFTER_SECONDS`: an object store sets it only when the bytes are sent, so that an object that is used again
is sent again where that is longer ago. Bytes are compared with their digest once for each version (ETag) of an object
and process, and whenever they are read. Credentials and endpoints come from the environment, as obstore reads them.
"""

import hashlib
import logging
import time
from collections.abc import Collection, Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import obstore
from obstore import exceptions
from obstore.store import from_url

from cow_service.errors import ArtifactNotFound, StorageUnavailable
from cow_service.media import artifacts
from cow_service.records import Artifact
from cow_service.settings import SettingsError

RENEWED_AFTER_SECONDS = 300.0
REQUEST_SECONDS, CONNECT_SECONDS = 8.0, 3.0  # that a request with its bytes, and a connection, may take
RETRY_SECONDS, MAX_RETRIES = 5.0, 3  # of a request; obstore waits 0.1 s before the first retry, then twice as long
MAX_PARALLEL = 8  # requests for one job
LISTED_TOGETHER = 1000  # by one request; no store lists more
DELETED_TOGETHER = 32  # as many as are asked for their times at the same time, so that none waits between the two
CHECKED = "check"  # the object that shows that the store can be written and read

log = logging.getLogger("cow_service")


@dataclass(frozen=True)
class _Object:
    artifact: Artifact
    e_tag: str | None
    used_at: float  # seconds since 1970

    @property
    def is_fresh(self) -> bool:
        return time.time() - self.used_at < RENEWED_AFTER_SECONDS


class ObjectArtifacts(artifacts.ArtifactStore):
    """An `ArtifactStore` in an object store. Temporary files lie in a folder of this machine."""

    def __init__(self, url: str, scratch_folder: Path) -> None:
        """Connects to nothing yet. Raises `SettingsError` for a store that cannot be set up."""
        super().__init__(scratch_folder)
        self._url = url.rstrip("/")
        try:
            self._store: Any = from_url(
                url,
                client_options={
                    "allow_http": True,  # for an endpoint of the environment that is one of http://
                    "timeout": timedelta(seconds=REQUEST_SECONDS),
                    "connect_timeout": timedelta(seconds=CONNECT_SECONDS),
                },
                retry_config={"max_retries": MAX_RETRIES, "retry_timeout": timedelta(seconds=RETRY_SECONDS)},
            )
        except (exceptions.BaseError, ValueError) as error:
            reason = str(error).partition("\n")[0]
            raise SettingsError(f"Bad settings: the object store of COW_ARTIFACTS cannot be used: {reason}.") from error

    @property
    def address(self) -> str:
        """The URL of the settings."""
        return self._url

    def put(self, data: bytes, media_type: str) -> Artifact:
        """Sends bytes, unless this process knows that the same bytes are there."""
        artifacts.extension_of(media_type)
        sha256 = hashlib.sha256(data).hexdigest()
        if sha256 in self._verified:
            with suppress(ArtifactNotFound):
                found = self._head(sha256)
                if found.is_fresh and self._is_verified(found):
                    return found.artifact
        self._send(sha256, data, media_type)
        return artifacts.artifact_of(sha256, media_type, len(data))

    def get(self, sha256: str) -> Artifact:
        """Finds an object. Its bytes are not compared; a caller with a signed URL can do that."""
        return self._head(sha256).artifact

    def read(self, sha256: str) -> bytes:
        """Gets the bytes and compares them."""
        found, data = self._fetch(sha256)
        if not found.is_fresh:
            self._send(sha256, data, found.artifact.media_type)
        return data

    def touch(self, *sha256: str) -> None:
        """Gets bytes only where they were not compared, or where they must be sent again."""

        def touch_one(sha256: str) -> None:
            found = self._head(sha256)
            if not (found.is_fresh and self._is_verified(found)):
                self.read(sha256)

        with ThreadPoolExecutor(MAX_PARALLEL) as pool:
            list(pool.map(touch_one, sha256))  # what one of them raises is raised here

    @contextmanager
    def local_file(self, sha256: str) -> Generator[Path]:
        """A temporary copy."""
        _, data = self._fetch(sha256)
        with self.scratch() as path:
            with artifacts.disk_errors():
                path.write_bytes(data)
            yield path

    def signed_url(self, sha256: str, seconds: float) -> str | None:
        """A URL of the store itself; None if its credentials cannot sign."""
        try:
            return obstore.sign(self._store, "GET", sha256, timedelta(seconds=seconds))
        except exceptions.BaseError as error:
            log.warning("artifacts are streamed, because the object store cannot sign URLs (%s)", type(error).__name__)
            return None

    def delete(self, artifacts: Collection[str], untouched_since: float) -> set[str]:
        """Deletes objects, `DELETED_TOGETHER` with one request where the store can.

        Their times are asked for at the same time, right before it: what is sent again after that is lost, as it
        would be if each object had a request of its own.
        """

        def is_unused(sha256: str) -> bool:
            with suppress(ArtifactNotFound), _store_errors(sha256):
                return obstore.head(self._store, sha256)["last_modified"].timestamp() <= untouched_since
            return False

        names, deleted = list(artifacts), set[str]()
        with ThreadPoolExecutor(DELETED_TOGETHER) as pool:
            for start in range(0, len(names), DELETED_TOGETHER):
                some = names[start : start + DELETED_TOGETHER]
                unused = [sha256 for sha256, yes in zip(some, pool.map(is_unused, some), strict=True) if yes]
                self._remove(*unused)
                deleted.update(unused)
        return deleted

    def listed(self) -> Iterator[artifacts.ListedArtifact]:
        """All objects that are named by a digest; a request for each thousand."""
        with _store_errors():
            for chunk in obstore.list(self._store, chunk_size=LISTED_TOGETHER):
                for one in chunk:
                    if artifacts.is_digest(one["path"]):
                        yield artifacts.ListedArtifact(one["path"], one["size"], one["last_modified"].timestamp())

    @contextmanager
    def batch(self, retry: artifacts.RetryPolicy = artifacts.try_once) -> Generator[artifacts.Put]:
        """Sends in threads. The `put` belongs to one thread."""
        sent: list[Future[Artifact]] = []
        with ThreadPoolExecutor(MAX_PARALLEL, thread_name_prefix="cow-artifacts") as pool:

            def put(data: bytes, media_type: str) -> Artifact:
                artifacts.extension_of(media_type)
                sent.append(pool.submit(retry, partial(self.put, data, media_type)))
                return artifacts.artifact_of(hashlib.sha256(data).hexdigest(), media_type, len(data))

            yield put
            for each in sent:
                each.result()

    def check(self) -> None:
        """Sends a small object and gets it. Deleting needs a permission, too, but only once artifacts are old."""
        with _store_errors():
            obstore.put(self._store, CHECKED, b"\0", use_multipart=False)
            obstore.get(self._store, CHECKED).bytes()

    def _head(self, sha256: str) -> _Object:
        artifacts.check_digest(sha256)
        with _store_errors(sha256):
            return _object(sha256, obstore.get(self._store, sha256, options={"head": True}))

    def _fetch(self, sha256: str) -> tuple[_Object, bytes]:
        """An object and its bytes, which are those of its digest. Raises `ArtifactNotFound`."""
        artifacts.check_digest(sha256)
        with _store_errors(sha256):
            result = obstore.get(self._store, sha256)
            found, data = _object(sha256, result), bytes(result.bytes())
        if hashlib.sha256(data).hexdigest() != sha256:
            log.error("artifact %s is damaged and was removed", sha256)
            self._remove(sha256)
            raise artifacts.not_found(sha256)
        self._note_verified(sha256, found.e_tag)
        return found, data

    def _send(self, sha256: str, data: bytes, media_type: str) -> None:
        with _store_errors():
            # In one piece: an upload in parts takes three requests and more.
            attributes = {"Content-Type": media_type}
            result = obstore.put(self._store, sha256, data, attributes=attributes, use_multipart=False)
        self._note_verified(sha256, result["e_tag"])

    def _remove(self, *artifacts: str) -> None:
        for sha256 in artifacts:
            self._verified.pop(sha256, None)
        with _store_errors():
            try:
                obstore.delete(self._store, artifacts)
            except FileNotFoundError:  # Google and Azure say so where another process has deleted one, and stop there
                for sha256 in artifacts:
                    with suppress(FileNotFoundError):
                        obstore.delete(self._store, sha256)

    def _is_verified(self, found: _Object) -> bool:
        return found.e_tag is not None and self._verified.get(found.artifact.sha256) == found.e_tag


def _object(sha256: str, result: "obstore.GetResult") -> _Object:
    meta, media_type = result.meta, result.attributes.get("Content-Type", "")
    if media_type not in artifacts.MEDIA_TYPES:  # an object from another program
        raise artifacts.not_found(sha256)
    artifact = artifacts.artifact_of(sha256, media_type, meta["size"])
    return _Object(artifact, meta["e_tag"], meta["last_modified"].timestamp())


@contextmanager
def _store_errors(sha256: str | None = None) -> Generator[None]:
    """Translates obstore's errors; a missing object, where a digest is given, becomes a missing artifact.

    Their own text is for the log: it is long, and holds addresses.
    """
    try:
        yield
    except (FileNotFoundError, exceptions.BaseError) as error:
        if isinstance(error, FileNotFoundError):
            if sha256 is not None:
                raise artifacts.not_found(sha256) from error
            reason = "there is no such bucket"
        elif isinstance(error, exceptions.PermissionDeniedError | exceptions.UnauthenticatedError):
            reason = "it refuses the credentials; check the provider's variables, such as AWS_*"
        else:
            reason = f"no answer, or no credentials ({type(error).__name__}): see the log"
        log.warning("object store: %s", str(error).partition("\n")[0])
        raise StorageUnavailable(f"The object store of COW_ARTIFACTS cannot be used: {reason}.") from error
