"""Downloads weights from the Hugging Face hub, or a server with its API (HF_ENDPOINT), and checks every file's digest.

`resolve` finds out what there is to download and changes nothing here; `download` carries it out. The revision and the
files are recorded before the first file comes, so that an interrupted download continues with the same revision and
only the missing files. Exceptions of the hub's library become `WeightsUnavailable` here and nowhere else.
"""

from __future__ import annotations

import errno
import shutil
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from cow_service import __version__
from cow_service.errors import CowError, WeightsUnavailable
from cow_service.weights import lock as weights
from cow_service.weights.lock import Lock, LockedFile, folder_of
from cow_service.weights.manifests import Source

if TYPE_CHECKING:
    from filelock import FileLock
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoSibling

# Reading one of these can run code that it holds.
PICKLED = (".bin", ".ckpt", ".pickle", ".pkl", ".pt", ".pth")

_LISTING_SECONDS = 30.0  # timeout

_LOG_IN = "Log in with `hf auth login`, or set HF_TOKEN, for an account that may read it"
_REACH = "Check the network, the proxy and HF_ENDPOINT, and run it again"
_AGAIN = "Run it again: files that are whole stay"

# By the names of exceptions: those of the HTTP library, which differs between versions of huggingface_hub, are among
# them. The first that fits is told: the reason, then the remedy.
REASONS: tuple[tuple[str, str, str], ...] = (
    ("GatedRepoError", "its owner has not granted access", f"Ask for it on the repository's page. {_LOG_IN}"),
    ("RepositoryNotFoundError", "the hub knows no such repository, or it is private", f"Check the name. {_LOG_IN}"),
    ("RevisionNotFoundError", "it has no revision '{revision}'", "Name one that it has, such as --revision main"),
    ("RemoteEntryNotFoundError", "a file is no longer there", "Choose another revision, such as --revision main"),
    ("DisabledRepoError", "the hub has disabled it", "Choose another revision or another model"),
    ("OfflineModeIsEnabled", "HF_HUB_OFFLINE is set", "Unset it to download"),
    ("FileMetadataError", "what answered does not speak like the hub", "Check HF_ENDPOINT, the proxy and the firewall"),
    ("TimeoutException", "the hub did not answer in time", _AGAIN),
    ("TimeoutError", "the hub did not answer in time", _AGAIN),
    ("TransportError", "the hub cannot be reached", _REACH),
    ("ConnectionError", "the hub cannot be reached", _REACH),
)


@dataclass(frozen=True)
class DownloadProgress:
    """How far one file has come. `done` and `size` are bytes; a file in the state `done` has the recorded digest."""

    repository: str
    file: str
    state: Literal["downloading", "checking", "done"]
    done: int
    size: int


ProgressCallback = Callable[[DownloadProgress], None]


@dataclass(frozen=True)
class Download:
    """What is to be downloaded: the record to write, the files of the source, and those that are not here yet."""

    lock: Lock
    files: tuple[LockedFile, ...]
    pending: tuple[LockedFile, ...]

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(file.size for file in self.files)

    @property
    def pending_size(self) -> int:
        """Bytes to download."""
        return sum(file.size for file in self.pending)


def resolve(source: Source, weights_dir: Path, revision: str | None = None, *, endpoint: str | None = None) -> Download:
    """What is missing of a source. The hub is asked only for what is not recorded. Raises `WeightsUnavailable`.

    `revision` is a branch, tag or commit; by default the recorded one, or at first the newest. `endpoint` is the hub's
    address, by default HF_ENDPOINT or the public one.
    """
    lock = weights.read_lock(weights_dir, source.repository)
    if lock is None or revision not in (None, lock.revision) or not {*source.files} <= {*lock.patterns}:
        wanted = revision or (lock.revision if lock else None)
        lock = _listed(source, wanted, lock.patterns if lock else (), endpoint)
    files = weights.chosen(lock, source.files)
    wrong = {finding.file for finding in weights.examine(lock, files, weights_dir)}
    return Download(lock, files, tuple(file for file in files if file.path in wrong))


def download(
    downloads: Sequence[Download],
    weights_dir: Path,
    progress: ProgressCallback = lambda progress: None,
    *,
    endpoint: str | None = None,
) -> None:
    """Downloads from different repositories. Raises `WeightsUnavailable`, before the first byte if disks are full."""
    downloads = [
        each for each in downloads if each.pending or each.lock != weights.read_lock(weights_dir, each.lock.repository)
    ]
    if not downloads:
        return
    hub = _hub(endpoint)
    with ExitStack() as held:
        for each in downloads:
            held.callback(_locked(folder_of(weights_dir, each.lock.repository), each.lock.repository).release)
        _check_free_space(downloads, weights_dir)
        for each in downloads:
            repository = each.lock.repository
            with weights.disk_errors(repository):  # another download may have ended meanwhile
                weights.write_lock(weights_dir, weights.merged(weights.read_lock(weights_dir, repository), each.lock))
            for file in each.pending:
                _download_file(hub, each.lock, file, weights_dir, progress)


def _download_file(hub: HfApi, lock: Lock, file: LockedFile, weights_dir: Path, progress: ProgressCallback) -> None:
    folder = folder_of(weights_dir, lock.repository)

    def report(state: Literal["downloading", "checking", "done"], done: int) -> None:
        progress(DownloadProgress(lock.repository, file.path, state, done, file.size))

    report("downloading", 0)
    with _hub_errors(lock.repository, lock.revision):
        # The library trusts an existing file by its modification time; this one has a wrong digest.
        (folder / file.path).unlink(missing_ok=True)
        hub.hf_hub_download(
            lock.repository,
            file.path,
            revision=lock.revision,
            local_dir=folder,
            tqdm_class=cast(Any, _progress_bar(lambda done: report("downloading", done))),
        )
    report("checking", file.size)
    for finding in weights.examine(lock, (file,), weights_dir):
        with weights.disk_errors(lock.repository):
            (folder / file.path).unlink(missing_ok=True)
        why = f"what came is not what the hub lists: {finding.message}"
        raise _unavailable(lock.repository, why, "The file was deleted: run it again")
    report("done", file.size)


def _listed(source: Source, revision: str | None, others: tuple[str, ...], endpoint: str | None) -> Lock:
    """The repository's files at a revision that match the source, and those that other sources of it have chosen."""
    hub = _hub(endpoint)
    with _hub_errors(source.repository, revision):
        info = hub.model_info(source.repository, revision=revision, files_metadata=True, timeout=_LISTING_SECONDS)
        siblings = {sibling.rfilename: sibling for sibling in info.siblings or ()}
        names: set[str] = set()
        for pattern in source.files:
            names |= _matching(source.repository, pattern, siblings)
        kept = {other: _safe(siblings, other) for other in others if other not in source.files}
        files = [_recorded(source.repository, siblings[name]) for name in sorted(names.union(*kept.values()))]
        patterns = (*source.files, *(other for other, matching in kept.items() if matching))
        return Lock(repository=source.repository, revision=info.sha or "", patterns=patterns, files=tuple(files))


def _matching(repository: str, pattern: str, siblings: dict[str, RepoSibling]) -> set[str]:
    found = _safe(siblings, pattern)
    if not found:
        pickled = any(fnmatchcase(name, pattern) for name in siblings)
        why = "only pickled files, which can run code when they are read, match" if pickled else "no file matches"
        raise _unavailable(repository, f"{why} '{pattern}'", "Choose a revision that has such files as safetensors")
    return found


def _safe(siblings: dict[str, RepoSibling], pattern: str) -> set[str]:
    return {name for name in siblings if fnmatchcase(name, pattern) and not name.lower().endswith(PICKLED)}


def _recorded(repository: str, sibling: RepoSibling) -> LockedFile:
    try:
        path = weights.inside(sibling.rfilename)
    except ValueError as error:
        raise _unavailable(repository, f"in its listing, {error}", "Do not use this repository") from error
    if sibling.lfs is not None:  # files in large-file storage, xet included
        return LockedFile(path=path, size=sibling.lfs.size, algorithm="sha256", digest=sibling.lfs.sha256)
    if sibling.size is None or sibling.blob_id is None:
        raise _unavailable(repository, f"the hub lists no size or no digest of '{path}'", "Run it again")
    return LockedFile(path=path, size=sibling.size, algorithm="git-sha1", digest=sibling.blob_id)


def _check_free_space(downloads: Sequence[Download], weights_dir: Path) -> None:
    needed: Counter[int] = Counter()
    for each in downloads:
        with weights.disk_errors(each.lock.repository):
            folder = folder_of(weights_dir, each.lock.repository)  # which may be a link to another disk
            device, free = folder.stat().st_dev, shutil.disk_usage(folder).free
        needed[device] += each.pending_size
        if needed[device] > free:
            why = f"its disk has {free / 1e9:.1f} GB free, and {needed[device] / 1e9:.1f} GB are needed"
            raise _unavailable(each.lock.repository, why, "Free some space, or set COW_MODELS_DIR to a larger disk")


def _locked(folder: Path, repository: str) -> FileLock:
    """Locks the folder against other downloads, and deletes what killed downloads have left incomplete."""
    from filelock import FileLock, Timeout  # noqa: PLC0415

    kept = folder / ".cache"
    with weights.disk_errors(repository):
        kept.mkdir(parents=True, exist_ok=True)
        lock = FileLock(kept / "cow.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout as error:
            raise _unavailable(repository, "another pull is downloading it", "Wait for that to end") from error
        # Their names are unique to one download: the library never resumes them.
        for left in kept.rglob("*.*.*.incomplete"):
            left.unlink(missing_ok=True)
        return lock


def _hub(endpoint: str | None) -> HfApi:
    try:
        from huggingface_hub import HfApi  # noqa: PLC0415
    except ImportError as error:
        why = 'Downloading weights needs huggingface_hub, which is not installed: pip install "cow-service[wan]".'
        raise WeightsUnavailable(why) from error
    return HfApi(endpoint=endpoint, library_name="cow-service", library_version=__version__)


def _progress_bar(report: Callable[[int], None]) -> type:
    """A stand-in for tqdm that passes the bytes so far to `report`, and shows nothing."""

    class Bar:
        def __init__(self, *args: Any, initial: int = 0, total: int | None = None, **options: Any) -> None:
            self.n, self.total = initial, total

        def __enter__(self) -> Bar:
            return self

        def __exit__(self, *error: object) -> None:
            pass

        def update(self, count: float = 1) -> None:
            self.n += int(count)
            report(self.n)

        def _ignore(self, *args: Any, **options: Any) -> None:
            pass

        # Having `update_transfer`, it gets one bar per file, and not a second one for bytes on the network.
        update_transfer = set_transfer_postfix_str = set_postfix_str = refresh = close = _ignore

    return Bar


@contextmanager
def _hub_errors(repository: str, revision: str | None) -> Generator[None]:
    """Turns whatever the library raises into `WeightsUnavailable` with the reason and a remedy."""
    try:
        yield
    except CowError:
        raise
    except Exception as error:
        reason, remedy = _reason(_root(error))
        raise _unavailable(repository, reason.format(revision=revision or "main"), remedy) from error


def _unavailable(repository: str, reason: str, remedy: str) -> WeightsUnavailable:
    """The error that says why a repository cannot be downloaded, and the remedy."""
    return WeightsUnavailable(f"'{repository}' cannot be downloaded: {reason}. {remedy}.")


def _root(error: BaseException) -> BaseException:
    """The network error behind `LocalEntryNotFoundError`, by which the library replaces it."""
    while type(error).__name__ == "LocalEntryNotFoundError" and error.__cause__ is not None:
        error = error.__cause__
    return error


def _reason(error: BaseException) -> tuple[str, str]:
    kinds = {kind.__name__ for kind in type(error).__mro__}
    for name, reason, remedy in REASONS:
        if name in kinds:
            return reason, remedy
    status = getattr(getattr(error, "response", None), "status_code", None)
    if status in (401, 403):
        return f"it is not open to this account (HTTP {status})", _LOG_IN
    if status is not None:
        return f"the hub answered with HTTP {status}", "Wait a little and run it again"
    if isinstance(error, OSError) and error.errno:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return "the disk is full", "Free some space, or set COW_MODELS_DIR to a folder on a larger disk"
        return f"the folder for weights cannot be used ({errno.errorcode.get(error.errno)})", "Make it writable"
    return f"the download failed ({type(error).__name__})", _AGAIN
