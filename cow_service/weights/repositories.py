"""Weights of repositories on the Hugging Face hub: downloaded once, recorded, and checked against the record.

The layout is `<folder>/<owner>--<name>/`, shared by all manifests that use the repository: its files under their own
names, and `cow.lock.json`, which pins their revision, sizes and digests. It is written before the first file comes, so
that an interrupted download continues with the same revision and only the missing files.

`check`, `verify` and `ready` need no network. `resolve` finds out what there is to download, from the hub or a server
with its API (HF_ENDPOINT), and changes nothing here; `download` carries it out. Exceptions of the hub's library become
`WeightsUnavailable` here and nowhere else.

huggingface_hub's `verify_repo_checksums` asks the hub for the digests and so needs a network; `snapshot_download` lists
the repository at each call: both are not used.
"""

import hashlib
import os
import shutil
from collections import Counter
from collections.abc import Callable, Container, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from filelock import FileLock, Timeout
from pydantic import AfterValidator, Field, ValidationError

from cow_service import __version__
from cow_service.errors import CowError, WeightsUnavailable, install_line, listed
from cow_service.records import Record
from cow_service.settings import Settings
from cow_service.weights.manifests import Manifest, Source

if TYPE_CHECKING:
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoSibling

LOCK_NAME = "cow.lock.json"
PICKLED = (".bin", ".ckpt", ".pickle", ".pkl", ".pt", ".pth")  # reading one of these can run code that it holds

_LISTING_SECONDS = 30.0  # timeout
_LOG_IN = "Log in with `hf auth login`, or set HF_TOKEN, for an account that may read it"
_REACH = "Check the network, the proxy and HF_ENDPOINT, and run it again"
_AGAIN = "Run it again: complete files are kept"

# By the names of exceptions, because those of the HTTP library differ between versions of huggingface_hub. The first
# that fits is told: the reason, then the remedy.
REASONS: tuple[tuple[str, str, str], ...] = (
    ("GatedRepoError", "its owner has not granted access", f"Ask for it on the repository's page. {_LOG_IN}"),
    ("RepositoryNotFoundError", "the hub knows no such repository, or it is private", f"Check the name. {_LOG_IN}"),
    ("RevisionNotFoundError", "it has no revision '{revision}'", "Name an existing one, such as --revision main"),
    ("RemoteEntryNotFoundError", "a file is no longer there", "Choose another revision, such as --revision main"),
    ("DisabledRepoError", "the hub has disabled it", "Choose another revision or another model"),
    ("OfflineModeIsEnabled", "HF_HUB_OFFLINE is set", "Unset it to download"),
    ("FileMetadataError", "what answered does not speak like the hub", "Check HF_ENDPOINT, the proxy and the firewall"),
    ("TimeoutException", "the hub did not answer in time", _AGAIN),
    ("TimeoutError", "the hub did not answer in time", _AGAIN),
    ("TransportError", "the hub cannot be reached", _REACH),
    ("ConnectionError", "the hub cannot be reached", _REACH),
)


def inside(path: str) -> str:
    """The path itself, where it names a file of the repository. Raises `ValueError` if it could lead elsewhere.

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
    """What is not as recorded, without `digests` by sizes alone. Raises `WeightsUnavailable` for unreadable files."""
    lock = read_lock(weights_dir, source.repository)
    if lock is None:
        return tuple(Finding(file=pattern, problem="not-pulled") for pattern in source.files)
    folder, known = folder_of(weights_dir, lock.repository), {file.path for file in lock.files}
    # Weights that are not in the record, such as shards of another revision: a loader would read them, too.
    with disk_errors(lock.repository):
        here = {path.relative_to(folder).as_posix() for path in folder.rglob("*.safetensors*") if path.is_file()}
    strangers = [
        path
        for path in sorted(here - known)
        if not path.startswith(".") and any(fnmatchcase(path, glob) for glob in source.files)
    ]
    return (
        *(Finding(file=name, problem="not-pulled") for name in source.files if name not in lock.patterns),
        *(Finding(file=path, problem="not-recorded") for path in strangers),
        *examine(lock, chosen(lock, source.files), weights_dir, digests),
    )


def verify(source: Source, weights_dir: Path, name: str) -> Path:
    """The folder of a source's files. Raises `WeightsUnavailable` if they are not as recorded, with the remedy."""
    findings = check(source, weights_dir)
    if findings:
        told = listed([finding.message for finding in findings], 10, "; ")
        raise WeightsUnavailable(
            f"'{name}' cannot use its weights of '{source.repository}': {told}. Run `cow models pull {name}`."
        )
    return folder_of(weights_dir, source.repository)


def ready(manifest: Manifest, weights_dir: Path, without: Container[str] = ()) -> bool:
    """All files of the manifest, but those of the parts `without`, are here with the right sizes; nothing is hashed."""
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
                f"The record of the weights of '{repository}', {path.parent.name}/{LOCK_NAME}, is damaged: "
                f"delete it and pull them again."
            ) from error


def write_lock(weights_dir: Path, lock: Lock) -> None:
    """Writes the record; a reader sees the old one or the new one. Raises `OSError`."""
    path = folder_of(weights_dir, lock.repository) / LOCK_NAME
    partial = path.with_name(f"{LOCK_NAME}.partial")  # `download` lets one pull at a time come here
    with partial.open("w", encoding="utf-8") as file:
        file.write(lock.model_dump_json(indent=2) + "\n")
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def chosen(lock: Lock, patterns: Sequence[str]) -> tuple[LockedFile, ...]:
    """The recorded files that match one of the glob patterns, in which `*` takes slashes too."""
    return tuple(file for file in lock.files if any(fnmatchcase(file.path, pattern) for pattern in patterns))


def examine(lock: Lock, files: Iterable[LockedFile], weights_dir: Path, digests: bool = True) -> tuple[Finding, ...]:
    """Compares files with their record, hashing several at a time. Raises `WeightsUnavailable` if one is unreadable."""
    folder = folder_of(weights_dir, lock.repository)

    def compare(file: LockedFile) -> Finding | None:
        path = folder / file.path
        try:
            size = path.stat().st_size if path.is_file() else None
        except (FileNotFoundError, NotADirectoryError):
            size = None
        if size is None:
            return Finding(file=file.path, problem="missing")
        if size != file.size:
            return Finding(file=file.path, problem="wrong-size", wanted=f"{file.size} bytes", found=f"{size} bytes")
        if digests:
            state = hashlib.sha256() if file.algorithm == "sha256" else hashlib.sha1(usedforsecurity=False)
            if file.algorithm == "git-sha1":
                state.update(b"blob %d\0" % file.size)
            with path.open("rb") as data:
                found = hashlib.file_digest(data, lambda: state).hexdigest()
            if found != file.digest:
                wanted, found = f"{file.algorithm} {file.digest}", f"{file.algorithm} {found}"
                return Finding(file=file.path, problem="wrong-digest", wanted=wanted, found=found)
        return None

    # Hashing releases the GIL, so threads are enough; beyond a few, the disk is the limit.
    with disk_errors(lock.repository), ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        return tuple(finding for finding in pool.map(compare, files) if finding is not None)


@contextmanager
def disk_errors(repository: str) -> Generator[None]:
    """Turns an `OSError` into `WeightsUnavailable` with the reason, without the path that the OSError's text holds."""
    try:
        yield
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else type(error).__name__
        raise WeightsUnavailable(
            f"The weights of '{repository}' cannot be read or written ({reason}): check the permissions "
            f"of the folder for weights (COW_MODELS_DIR)."
        ) from error


@dataclass(frozen=True)
class Download:
    """What is to be downloaded: the record to write, the files of the source, and those that are not here yet."""

    lock: Lock
    files: tuple[LockedFile, ...]
    pending: tuple[LockedFile, ...]


def resolve(source: Source, weights_dir: Path, revision: str | None = None, *, endpoint: str | None = None) -> Download:
    """The missing files of a source. The hub is asked only about files without a record. Raises `WeightsUnavailable`.

    `revision` is a branch, tag or commit; by default the recorded one, or at first the newest. `endpoint` is the hub's
    address, by default HF_ENDPOINT or the public one.
    """
    lock = read_lock(weights_dir, source.repository)
    if lock is None or revision not in (None, lock.revision) or not {*source.files} <= {*lock.patterns}:
        wanted = revision or (lock.revision if lock else None)
        lock = _list(source, wanted, lock.patterns if lock else (), endpoint)
    files = chosen(lock, source.files)
    wrong = {finding.file for finding in examine(lock, files, weights_dir)}
    return Download(lock, files, tuple(file for file in files if file.path in wrong))


def download(
    downloads: Sequence[Download],
    weights_dir: Path,
    tell: Callable[[str, LockedFile], None] = lambda repository, file: None,
    *,
    endpoint: str | None = None,
) -> None:
    """Downloads from different repositories; `tell` is called before each file, and a terminal shows the hub's bars.

    Raises `WeightsUnavailable`, before the first byte if disks are full.
    """
    recorded = {each.lock.repository: read_lock(weights_dir, each.lock.repository) for each in downloads}
    downloads = [each for each in downloads if each.pending or each.lock != recorded[each.lock.repository]]
    if not downloads:
        return
    hub = _hub(endpoint)
    with ExitStack() as held:
        for each in downloads:
            held.enter_context(held_alone(each.lock.repository, weights_dir))
        check_room(downloads, weights_dir)
        for each in downloads:
            with disk_errors(each.lock.repository):
                write_lock(weights_dir, merged_with(each.lock, read_lock(weights_dir, each.lock.repository)))
            for file in each.pending:
                tell(each.lock.repository, file)
                _download_file(hub, each.lock, file, weights_dir)


@contextmanager
def held_alone(repository: str, weights_dir: Path) -> Generator[None]:
    """Makes a repository's folder, keeps other pulls out of it, and deletes what killed ones have left there."""
    kept = folder_of(weights_dir, repository) / ".cache"
    with ExitStack() as held:
        with disk_errors(repository):
            kept.mkdir(parents=True, exist_ok=True)
            try:
                held.enter_context(FileLock(kept / "cow.lock").acquire(timeout=0))
            except Timeout as error:
                why = "another pull is downloading it"
                raise _unavailable(repository, why, "Wait until it has ended") from error
            for left in kept.rglob("*.*.*.incomplete"):  # unique to one pull: the library never resumes them
                left.unlink(missing_ok=True)
        yield


def check_room(downloads: Sequence[Download], weights_dir: Path) -> None:
    """Raises `WeightsUnavailable` if a disk is too full for what is to be downloaded to it."""
    needed: Counter[int] = Counter()  # bytes, by disk
    for each in downloads:
        with disk_errors(each.lock.repository):
            folder = folder_of(weights_dir, each.lock.repository)  # which may be a link to another disk
            disk, free = folder.stat().st_dev, shutil.disk_usage(folder).free
        needed[disk] += sum(file.size for file in each.pending)
        if needed[disk] > free:
            why = f"its disk has {free / 1e9:.1f} GB free, and {needed[disk] / 1e9:.1f} GB are needed"
            raise _unavailable(each.lock.repository, why, "Free some space, or set COW_MODELS_DIR to a larger disk")


def merged_with(lock: Lock, old: Lock | None) -> Lock:
    """With what the record of the same revision has: another download may have ended meanwhile."""
    if old is None or old.revision != lock.revision:
        return lock
    patterns = tuple(dict.fromkeys((*old.patterns, *lock.patterns)))
    files = {file.path: file for file in (*old.files, *lock.files)}
    return lock.model_copy(update={"patterns": patterns, "files": tuple(files[path] for path in sorted(files))})


def _download_file(hub: "HfApi", lock: Lock, file: LockedFile, weights_dir: Path) -> None:
    folder = folder_of(weights_dir, lock.repository)
    with _hub_errors(lock.repository, lock.revision):
        # The library trusts an existing file by its modification time; this one has a wrong digest.
        (folder / file.path).unlink(missing_ok=True)
        hub.hf_hub_download(lock.repository, file.path, revision=lock.revision, local_dir=folder)
    for finding in examine(lock, (file,), weights_dir):
        with disk_errors(lock.repository):
            (folder / file.path).unlink(missing_ok=True)
        why = f"the download differs from what the hub lists: {finding.message}"
        raise _unavailable(lock.repository, why, "The file was deleted: run it again")


def _list(source: Source, revision: str | None, others: tuple[str, ...], endpoint: str | None) -> Lock:
    """The repository's files at a revision that match the source, and those that other sources of it have chosen."""
    hub = _hub(endpoint)
    with _hub_errors(source.repository, revision):
        info = hub.model_info(source.repository, revision=revision, files_metadata=True, timeout=_LISTING_SECONDS)
        siblings = {sibling.rfilename: sibling for sibling in info.siblings or ()}
        names: set[str] = set()
        patterns: list[str] = []
        for pattern in dict.fromkeys((*source.files, *others)):
            matching = {name for name in siblings if fnmatchcase(name, pattern)}
            if found := {name for name in matching if source.pickled or not name.lower().endswith(PICKLED)}:
                names |= found
                patterns.append(pattern)
            elif pattern in source.files:
                pickled = "only pickled files, which can run code when they are read, match"
                why = f"{pickled if matching else 'no file matches'} '{pattern}'"
                raise _unavailable(source.repository, why, "Choose a revision that has such files as safetensors")
        files = tuple(record_of(source.repository, name, siblings[name]) for name in sorted(names))
        return Lock(repository=source.repository, revision=info.sha or "", patterns=tuple(patterns), files=files)


def record_of(repository: str, name: str, listed: "RepoSibling") -> LockedFile:
    """The record of a file that the hub lists."""
    try:
        path = inside(name)
    except ValueError as error:
        raise _unavailable(repository, f"in its listing, {error}", "Do not use this repository") from error
    if listed.lfs is not None:  # files in large-file storage, xet included
        return LockedFile(path=path, size=listed.lfs.size, algorithm="sha256", digest=listed.lfs.sha256)
    if listed.size is None or listed.blob_id is None:
        raise _unavailable(repository, f"the hub lists no size or no digest of '{path}'", "Run it again")
    return LockedFile(path=path, size=listed.size, algorithm="git-sha1", digest=listed.blob_id)


def _hub(endpoint: str | None) -> "HfApi":
    try:
        from huggingface_hub import HfApi  # noqa: PLC0415
    except ImportError as error:
        why = f"Downloading weights needs huggingface_hub, which is not installed: {install_line('wan')}."
        raise WeightsUnavailable(why) from error
    return HfApi(endpoint=endpoint, library_name="cow-service", library_version=__version__)


@contextmanager
def _hub_errors(repository: str, revision: str | None) -> Generator[None]:
    """Turns whatever the library raises into `WeightsUnavailable` with the reason and a remedy."""
    try:
        yield
    except CowError:
        raise
    except Exception as error:
        cause: BaseException = error
        # By which the library replaces the network's own error.
        while type(cause).__name__ == "LocalEntryNotFoundError" and cause.__cause__ is not None:
            cause = cause.__cause__
        kinds = {kind.__name__ for kind in type(cause).__mro__}
        known = next(((reason, remedy) for name, reason, remedy in REASONS if name in kinds), None)
        status = getattr(getattr(cause, "response", None), "status_code", None)
        number = cause.errno if isinstance(cause, OSError) else None
        if known is not None:
            reason, remedy = known[0].format(revision=revision or "main"), known[1]
        elif status in (401, 403):
            reason, remedy = f"it is not open to this account (HTTP {status})", _LOG_IN
        elif status is not None:
            reason, remedy = f"the hub answered with HTTP {status}", "Wait a little and run it again"
        elif number:
            reason = f"the folder for weights cannot be used ({os.strerror(number)})"
            remedy = "Make it writable or free some space, or set COW_MODELS_DIR to another folder"
        else:
            reason, remedy = f"the download failed ({type(cause).__name__})", _AGAIN
        raise _unavailable(repository, reason, remedy) from error


def _unavailable(repository: str, reason: str, remedy: str) -> WeightsUnavailable:
    return WeightsUnavailable(f"'{repository}' cannot be downloaded: {reason}. {remedy}.")
