"""Weights on this disk: the lock file written when they were downloaded, and checks against it. No network.

The layout is `<folder>/<owner>--<name>/`, shared by all manifests that use the repository: its files under their own
names, and `cow.lock.json`, which pins their revision, sizes and digests.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Container, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from threading import Event
from typing import Annotated, Literal
from uuid import uuid4

from pydantic import AfterValidator, Field, ValidationError

from cow_service.errors import WeightsUnavailable
from cow_service.records import Record
from cow_service.settings import Settings
from cow_service.weights.manifests import Manifest, Source

LOCK_NAME = "cow.lock.json"

_CHUNK_BYTES = 8 * 2**20
_MAX_LISTED = 10
_ALGORITHMS = {"sha256": hashlib.sha256, "git-sha1": hashlib.sha1}


def inside(path: str) -> str:
    """The path itself, where it names a file of the repository. Raises `ValueError` where it could lead elsewhere.

    Refused are absolute paths, `..`, what Windows reads as a drive, and the names that the download keeps for itself.
    """
    parts = path.split("/")
    if any(part in ("", ".", "..") for part in parts) or "\\" in path or ":" in path or not path.isprintable():
        raise ValueError(f"{path!r} could lead out of the folder of its repository")
    if path.casefold() == LOCK_NAME or parts[0].casefold() == ".cache":
        raise ValueError(f"{path!r} is a name that the download needs for itself")
    return path


class LockedFile(Record):
    """One file as the hub records it. It does not say whether the file is here."""

    path: Annotated[str, AfterValidator(inside)] = Field(description="Relative to the repository, with slashes.")
    size: int = Field(ge=0, description="Bytes.")
    algorithm: Literal["sha256", "git-sha1"] = Field(
        description="git-sha1 is that of a git blob: SHA-1 of 'blob <size>', a zero byte and the data."
    )
    digest: str = Field(pattern=r"^([0-9a-f]{40}|[0-9a-f]{64})$")


class Lock(Record):
    """What was chosen of one repository, at one revision. Written before the first file comes."""

    version: Literal[1] = 1
    repository: str
    revision: str = Field(pattern=r"^[0-9a-f]{40}$", description="The commit.")
    patterns: tuple[str, ...] = Field(description="The glob patterns by which files were chosen.")
    files: tuple[LockedFile, ...]


class Finding(Record):
    """Something about weights that is not as it should be."""

    file: str = Field(description="Relative to the repository; a pattern where its files were never pulled.")
    problem: Literal["missing", "wrong-size", "wrong-digest", "not-pulled", "not-recorded"]
    wanted: str | None = None
    found: str | None = None

    @property
    def message(self) -> str:
        """The finding in words."""
        if self.problem == "not-pulled":
            return f"{self.file} was not pulled"
        if self.problem == "not-recorded":
            return f"{self.file} lies there but is not of this revision: delete it"
        return f"{self.file} is missing" if self.found is None else f"{self.file} has {self.found}, not {self.wanted}"


def folder_of(weights_dir: Path, repository: str) -> Path:
    """The folder for a repository's files. Manifests that use the same repository share it."""
    return weights_dir / repository.replace("/", "--")


def check(source: Source, weights_dir: Path, digests: bool = True) -> tuple[Finding, ...]:
    """Compares the files of a source with their record; empty when all is right.

    Without `digests` only sizes are compared. Raises `WeightsUnavailable` where something cannot be read.
    """
    lock = read_lock(weights_dir, source.repository)
    if lock is None:
        return tuple(Finding(file=pattern, problem="not-pulled") for pattern in source.files)
    unpulled = [Finding(file=name, problem="not-pulled") for name in source.files if name not in lock.patterns]
    return (
        *unpulled,
        *_unrecorded(lock, source, weights_dir),
        *examine(lock, chosen(lock, source.files), weights_dir, digests),
    )


def verify(source: Source, weights_dir: Path, name: str) -> Path:
    """The folder of a source's files, where every one has the digest that was recorded; `name` is the manifest's.

    Raises `WeightsUnavailable`, saying what is wrong and how to mend it.
    """
    findings = check(source, weights_dir)
    if findings:
        messages = [finding.message for finding in findings[:_MAX_LISTED]]
        if len(findings) > _MAX_LISTED:
            messages.append(f"and {len(findings) - _MAX_LISTED} more")
        raise WeightsUnavailable(
            f"'{name}' cannot use its weights of '{source.repository}': {'; '.join(messages)}. "
            f"Run `cow models pull {name}`."
        )
    return folder_of(weights_dir, source.repository)


def ready(manifest: Manifest, weights_dir: Path, without: Container[str] = ()) -> bool:
    """All files that the manifest needs, but those of the parts `without`, are here with the right sizes.

    Quick: nothing is hashed.
    """
    sources = [source for part, source in manifest.sources.items() if part not in without]
    try:
        return not any(check(source, weights_dir, digests=False) for source in sources)
    except WeightsUnavailable:
        return False


def weights_identity(manifest: Manifest, settings: Settings) -> str:
    """Changes with the weights: revisions of what was pulled; names, sizes and times of the user's own files."""
    own = settings.checkpoints.get(manifest.name)
    parts: list[object] = []
    if own is not None:
        files = [own] if own.is_file() else sorted(path for path in own.rglob("*") if path.is_file())
        parts += [(path.name, path.stat().st_size, path.stat().st_mtime_ns) for path in files]
    for part, source in sorted(manifest.sources.items()):
        lock = read_lock(settings.weights_dir, source.repository)
        parts.append((part, None if lock is None else lock.revision))
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def read_lock(weights_dir: Path, repository: str) -> Lock | None:
    """The record of a repository's files; None before the first pull. Raises `WeightsUnavailable` for a spoilt one."""
    path = folder_of(weights_dir, repository) / LOCK_NAME
    with disk_errors(repository):
        try:
            return Lock.model_validate_json(path.read_bytes())
        except FileNotFoundError:
            return None
        except ValidationError as error:
            raise WeightsUnavailable(
                f"The record of the weights of '{repository}', {path.parent.name}/{LOCK_NAME}, is spoilt: "
                f"delete it and pull them again."
            ) from error


def write_lock(weights_dir: Path, lock: Lock) -> None:
    """Writes the record; a reader sees the old one or the new one. Raises `OSError`."""
    path = folder_of(weights_dir, lock.repository) / LOCK_NAME
    temporary = path.with_name(f"{LOCK_NAME}.{uuid4().hex}")
    try:
        with temporary.open("x", encoding="utf-8") as file:
            file.write(lock.model_dump_json(indent=2) + "\n")
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def merged(old: Lock | None, new: Lock) -> Lock:
    """One record of what both chose at the same revision; of different revisions, the new one."""
    if old is None or old.revision != new.revision:
        return new
    files = {file.path: file for file in (*old.files, *new.files)}
    return new.model_copy(
        update={
            "patterns": tuple(dict.fromkeys((*old.patterns, *new.patterns))),
            "files": tuple(files[path] for path in sorted(files)),
        }
    )


def _unrecorded(lock: Lock, source: Source, weights_dir: Path) -> list[Finding]:
    """Weights that are not in the lock file, such as shards of another revision: a loader would read them, too."""
    folder, known = folder_of(weights_dir, lock.repository), {file.path for file in lock.files}
    with disk_errors(lock.repository):
        here = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.safetensors*") if path.is_file())
    return [
        Finding(file=path, problem="not-recorded")
        for path in here
        if path not in known and not path.startswith(".") and any(fnmatchcase(path, glob) for glob in source.files)
    ]


def chosen(lock: Lock, patterns: Iterable[str]) -> tuple[LockedFile, ...]:
    """The recorded files that match one of the glob patterns, in which `*` takes slashes too."""
    wanted = tuple(patterns)
    return tuple(file for file in lock.files if any(fnmatchcase(file.path, pattern) for pattern in wanted))


def examine(lock: Lock, files: tuple[LockedFile, ...], weights_dir: Path, digests: bool = True) -> tuple[Finding, ...]:
    """Compares files with their record, hashing several at a time. Raises `WeightsUnavailable` if one is unreadable."""
    folder = folder_of(weights_dir, lock.repository)
    with disk_errors(lock.repository):
        sizes = {file.path: _size(folder / file.path) for file in files}
        whole = [file for file in files if sizes[file.path] == file.size]
        found = _digests(folder, whole) if digests else {}
    findings = (_compare(file, sizes[file.path], found.get(file.path)) for file in files)
    return tuple(finding for finding in findings if finding is not None)


@contextmanager
def disk_errors(repository: str) -> Generator[None]:
    """Turns an `OSError` into `WeightsUnavailable` with the reason, without the path that the OSError's text holds."""
    try:
        yield
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else type(error).__name__
        raise WeightsUnavailable(
            f"The weights of '{repository}' cannot be read or written ({reason}): make the folder for weights "
            f"(COW_MODELS_DIR) one that may be."
        ) from error


def _compare(file: LockedFile, size: int | None, digest: str | None) -> Finding | None:
    if size is None:
        return Finding(file=file.path, problem="missing")
    if size != file.size:
        return Finding(file=file.path, problem="wrong-size", wanted=f"{file.size} bytes", found=f"{size} bytes")
    if digest is not None and digest != file.digest:
        wanted, found = f"{file.algorithm} {file.digest}", f"{file.algorithm} {digest}"
        return Finding(file=file.path, problem="wrong-digest", wanted=wanted, found=found)
    return None


def _size(path: Path) -> int | None:
    try:
        return path.stat().st_size if path.is_file() else None
    except (FileNotFoundError, NotADirectoryError):
        return None


def _digests(folder: Path, files: list[LockedFile]) -> dict[str, str]:
    stop = Event()
    # Hashing releases the GIL, so threads are enough; beyond a few, the disk is the limit.
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        try:
            digests = list(pool.map(_digest, [folder] * len(files), files, [stop] * len(files)))
        except BaseException:
            stop.set()  # else an interrupted check would first finish the files in progress
            raise
    return {file.path: digest for file, digest in zip(files, digests, strict=True)}


def _digest(folder: Path, file: LockedFile, stop: Event) -> str:
    head = b"" if file.algorithm == "sha256" else b"blob %d\0" % file.size
    state = _ALGORITHMS[file.algorithm](head, usedforsecurity=False)
    buffer = memoryview(bytearray(min(_CHUNK_BYTES, max(file.size, 1))))
    with (folder / file.path).open("rb", buffering=0) as data:
        while (count := data.readinto(buffer)) and not stop.is_set():
            state.update(buffer[:count])
    return state.hexdigest()
