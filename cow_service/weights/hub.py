"""Downloads weights from the Hugging Face hub, or a server that speaks like it (HF_ENDPOINT), and checks every file.

A pull is planned first, which changes nothing here, and then fetched. What it is going to bring is recorded before the
first file, so that a pull that was interrupted goes on with the same revision, and with the files that it had not got.
"""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

from cow_service import __version__
from cow_service.errors import WeightsUnavailable
from cow_service.weights import lock as weights
from cow_service.weights.hub_errors import download_told, refused
from cow_service.weights.lock import Lock, LockedFile, folder_of
from cow_service.weights.manifests import Source

if TYPE_CHECKING:
    from filelock import FileLock
    from huggingface_hub import HfApi
    from huggingface_hub.hf_api import RepoSibling

# Reading one of these can run code that it holds.
PICKLED = (".bin", ".ckpt", ".pickle", ".pkl", ".pt", ".pth")

_LISTING_SECONDS = 30.0


@dataclass(frozen=True)
class Step:
    """How far one file has come. `done` and `size` are bytes; a file that is `done` has the digest that it should."""

    repository: str
    file: str
    state: Literal["downloading", "checking", "done"]
    done: int
    size: int


Listener = Callable[[Step], None]


@dataclass(frozen=True)
class Plan:
    """What a pull brings: the record that it will write, the files of the source, and those that are not here yet."""

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


def pull(
    source: Source,
    weights_dir: Path,
    revision: str | None = None,
    progress: Listener = lambda step: None,
    *,
    endpoint: str | None = None,
) -> Path:
    """Downloads what is missing of a source, checks it, and returns its folder.

    `revision` is a branch, tag or commit; without it, it is the recorded one, or at first the newest. `endpoint` is
    the hub's address, by default HF_ENDPOINT or the public one. Raises `WeightsUnavailable`.
    """
    fetch([plan(source, weights_dir, revision, endpoint=endpoint)], weights_dir, progress, endpoint=endpoint)
    return folder_of(weights_dir, source.repository)


def plan(source: Source, weights_dir: Path, revision: str | None = None, *, endpoint: str | None = None) -> Plan:
    """What `pull` would do. The hub is asked only for what is not recorded. Raises `WeightsUnavailable`."""
    lock = weights.read_lock(weights_dir, source.repository)
    if lock is None or revision not in (None, lock.revision) or not {*source.files} <= {*lock.patterns}:
        wanted = revision or (lock.revision if lock else None)
        lock = _listed(source, wanted, lock.patterns if lock else (), endpoint)
    files = weights.chosen(lock, source.files)
    wrong = {finding.file for finding in weights.examine(lock, files, weights_dir)}
    return Plan(lock, files, tuple(file for file in files if file.path in wrong))


def fetch(
    plans: Sequence[Plan],
    weights_dir: Path,
    progress: Listener = lambda step: None,
    *,
    endpoint: str | None = None,
) -> None:
    """Carries out plans of different repositories. Raises `WeightsUnavailable`, at once where the disk is too small."""
    plans = [
        each for each in plans if each.pending or each.lock != weights.read_lock(weights_dir, each.lock.repository)
    ]
    if not plans:
        return
    hub = _hub(endpoint)
    with ExitStack() as held:
        for each in plans:
            held.callback(_hold(folder_of(weights_dir, each.lock.repository), each.lock.repository).release)
        _find_room(plans, weights_dir)
        for each in plans:
            repository = each.lock.repository
            with weights.disk_told(repository):  # another pull may have ended since this one was planned
                weights.write_lock(weights_dir, weights.merged(weights.read_lock(weights_dir, repository), each.lock))
            for file in each.pending:
                _bring(hub, each.lock, file, weights_dir, progress)


def _bring(hub: HfApi, lock: Lock, file: LockedFile, weights_dir: Path, progress: Listener) -> None:
    folder = folder_of(weights_dir, lock.repository)

    def tell(state: Literal["downloading", "checking", "done"], done: int) -> None:
        progress(Step(lock.repository, file.path, state, done, file.size))

    tell("downloading", 0)
    with download_told(lock.repository, lock.revision):
        # The library takes what lies there for right where the date fits; this file has been found wrong.
        (folder / file.path).unlink(missing_ok=True)
        hub.hf_hub_download(
            lock.repository,
            file.path,
            revision=lock.revision,
            local_dir=folder,
            tqdm_class=cast(Any, _bar(lambda done: tell("downloading", done))),
        )
    tell("checking", file.size)
    for finding in weights.examine(lock, (file,), weights_dir):
        with weights.disk_told(lock.repository):
            (folder / file.path).unlink(missing_ok=True)
        why = f"what came is not what the hub lists: {finding.told()}"
        raise refused(lock.repository, why, "The file was deleted: run it again")
    tell("done", file.size)


def _listed(source: Source, revision: str | None, others: tuple[str, ...], endpoint: str | None) -> Lock:
    """The repository's files at a revision that match the source, and those that other sources of it have chosen."""
    hub = _hub(endpoint)
    with download_told(source.repository, revision):
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
        raise refused(repository, f"{why} '{pattern}'", "Choose a revision that has such files as safetensors")
    return found


def _safe(siblings: dict[str, RepoSibling], pattern: str) -> set[str]:
    return {name for name in siblings if fnmatchcase(name, pattern) and not name.lower().endswith(PICKLED)}


def _recorded(repository: str, sibling: RepoSibling) -> LockedFile:
    try:
        path = weights.inside(sibling.rfilename)
    except ValueError as error:
        raise refused(repository, f"in its listing, {error}", "Do not use this repository") from error
    if sibling.lfs is not None:  # files in large-file storage, xet included
        return LockedFile(path=path, size=sibling.lfs.size, algorithm="sha256", digest=sibling.lfs.sha256)
    if sibling.size is None or sibling.blob_id is None:
        raise refused(repository, f"the hub lists no size or no digest of '{path}'", "Run it again")
    return LockedFile(path=path, size=sibling.size, algorithm="git-sha1", digest=sibling.blob_id)


def _find_room(plans: Sequence[Plan], weights_dir: Path) -> None:
    needed: Counter[int] = Counter()
    for each in plans:
        with weights.disk_told(each.lock.repository):
            folder = folder_of(weights_dir, each.lock.repository)  # which may be a link to another disk
            device, free = folder.stat().st_dev, shutil.disk_usage(folder).free
        needed[device] += each.pending_size
        if needed[device] > free:
            why = f"its disk has {free / 1e9:.1f} GB free, and {needed[device] / 1e9:.1f} GB are needed"
            raise refused(each.lock.repository, why, "Free some space, or set COW_MODELS_DIR to a larger disk")


def _hold(folder: Path, repository: str) -> FileLock:
    """Holds the folder against other pulls, and clears what pulls that were killed have left half done."""
    from filelock import FileLock, Timeout  # noqa: PLC0415

    kept = folder / ".cache"
    with weights.disk_told(repository):
        kept.mkdir(parents=True, exist_ok=True)
        lock = FileLock(kept / "cow.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout as error:
            raise refused(repository, "another pull is downloading it", "Wait for that to end") from error
        # These have names of one download only: the library never takes them up again.
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


def _bar(tell: Callable[[int], None]) -> type:
    """What the library takes for a progress bar: it passes bytes on, and shows nothing."""

    class Bar:
        def __init__(self, *args: Any, initial: int = 0, total: int | None = None, **options: Any) -> None:
            self.n, self.total = initial, total

        def __enter__(self) -> Bar:
            return self

        def __exit__(self, *error: object) -> None:
            pass

        def update(self, count: float = 1) -> None:
            self.n += int(count)
            tell(self.n)

        def _ignore(self, *args: Any, **options: Any) -> None:
            pass

        # With `update_transfer`, the library makes one bar for a file, not a second one for bytes on the line.
        update_transfer = set_transfer_postfix_str = set_postfix_str = refresh = close = _ignore

    return Bar
