"""Background work of a job engine: recovers jobs, notices cancellations, and cleans up."""

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable
from contextlib import AbstractContextManager, contextmanager, suppress
from itertools import islice
from pathlib import Path
from typing import Protocol
from uuid import uuid4

from filelock import FileLock, Timeout
from sqlalchemy.exc import SQLAlchemyError

from cow_service.errors import CowError, StorageUnavailable
from cow_service.jobs.active import RestingThread
from cow_service.jobs.calls import Calls
from cow_service.jobs.computing import EngineParts
from cow_service.jobs.database import Database
from cow_service.media.artifacts import PRIVATE, ArtifactStore, ListedArtifact, make_private
from cow_service.service import Service

# For processes that ended, and for jobs that run here and were canceled by another process; the same without any job.
POLL_SECONDS, QUIET_POLL_SECONDS = 1.0, 20.0
STALLED_SECONDS = 10.0  # between checks for stalled jobs
CLEAN_UP_SECONDS = 600.0  # between two rounds
TURN_SECONDS = 0.9 * CLEAN_UP_SECONDS  # since the last one of any process, which may have begun late
# The same where artifacts are listed, which costs seconds for hundreds of thousands. It must be done sooner only where
# they have a budget: without a reference they are kept for an hour anyway.
LISTING_SECONDS = 0.9 * 3600.0
RENEWAL_SECONDS = 60.0  # after which the turn of a listing that goes on is taken again: it may last longer than a turn
MAX_REMOVED_JOBS = 200  # at a time
CHUNK = 1000  # artifacts that are looked at together
JOIN_TIMEOUT_SECONDS = 5.0  # a thread that waits for a database that is down does not keep the process
# Both are longer than an object store's times of use may be wrong.
UNREFERENCED_GRACE_SECONDS = 3600.0  # that an artifact is kept without a reference: a request may be about to name it
BUDGET_GRACE_SECONDS = 900.0  # that it is kept after its last use, whatever the budget: a stage may be about to refer
LEFTOVER_SECONDS = 24 * 3600.0  # that a temporary file is kept after it was last written to

log = logging.getLogger("cow_service")


class Lease(Protocol):
    """What shows that a process has not ended."""

    def acquire(self) -> str:
        """Takes a lease on a new executor id, and returns the id. Raises `StorageUnavailable`."""
        ...

    def ended(self, executors: Iterable[str]) -> AbstractContextManager[list[str]]:
        """The executors whose processes have ended. Inside the block no other process can claim them."""
        ...

    def release(self) -> None:
        """Gives the lease back."""
        ...


class FolderLease:
    """The lease of a process on SQLite: a lock file, which the operating system releases however the process ends."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock: FileLock | None = None
        self._executor = ""

    def acquire(self) -> str:
        """As `Lease` says."""
        self._executor = uuid4().hex
        try:
            make_private(self._folder)
            self._lock = FileLock(self._folder / f"{self._executor}.lock", mode=PRIVATE)
            self._lock.acquire(timeout=0)
        except OSError as error:
            raise StorageUnavailable("Cannot write to the data folder: check its permissions.") from error
        return self._executor

    @contextmanager
    def ended(self, executors: Iterable[str]) -> Generator[list[str]]:
        """As `Lease` says."""
        locks: dict[str, FileLock] = {}
        try:
            for executor in set(executors) - {self._executor}:
                lock = FileLock(self._folder / f"{executor}.lock")
                with suppress(Timeout):
                    lock.acquire(timeout=0)
                    locks[executor] = lock
            yield list(locks)
        finally:
            for lock in locks.values():
                lock.release()
                Path(lock.lock_file).unlink(missing_ok=True)

    def release(self) -> None:
        """As `Lease` says."""
        if self._lock is not None:
            self._lock.release()
            Path(self._lock.lock_file).unlink(missing_ok=True)
            self._lock = None


class Maintenance(RestingThread):
    """A background thread of an engine. `remove` removes jobs, and those of their artifacts not used since a time;
    `offer` tells that jobs are back in their queues.
    """

    def __init__(
        self,
        parts: EngineParts,
        calls: Calls,
        lease: Lease,
        remove: Callable[[list[str], float], None],
        offer: Callable[[], None],
    ) -> None:
        super().__init__("cow-maintenance", parts.active, JOIN_TIMEOUT_SECONDS)
        self._parts, self._calls, self._lease, self._remove = parts, calls, lease, remove
        self._offer = offer
        self._idle: set[str] = set()  # jobs of this process that no thread worked on at the last check
        self._was_quiet = False

    def run(self) -> None:
        """Does the work, that which may take minutes in a thread of its own: jobs are recovered meanwhile."""
        cleaning = {self._clean_up_in_turn: CLEAN_UP_SECONDS}
        cleaner = threading.Thread(target=self._repeat, args=(cleaning,), name="cow-clean-up", daemon=True)
        cleaner.start()
        self._repeat(
            {
                self._recover: 0.0,
                self._notice_cancellations: 0.0,
                self._release_stalled: STALLED_SECONDS,
                self._close_idle_connections: 0.0,
            }
        )
        cleaner.join()

    def _repeat(self, kinds: dict[Callable[[], None], float]) -> None:
        """Does each kind of work when it is due. Errors are logged only: maintenance continues whatever happens."""
        begun = dict.fromkeys(kinds, time.monotonic())  # recovered jobs refer to their artifacts before any are removed
        while not self._stop.is_set():
            for work, seconds in kinds.items():
                now = time.monotonic()
                if now - begun[work] < seconds:
                    continue
                begun[work] = now
                try:
                    work()
                except (CowError, SQLAlchemyError) as error:
                    log.warning("maintenance: %s", getattr(error, "detail", type(error).__name__))
                except Exception:
                    log.exception("maintenance failed")
            self.rest(POLL_SECONDS, QUIET_POLL_SECONDS)

    def _close_idle_connections(self) -> None:
        """Once there are no jobs for a while."""
        was_quiet, self._was_quiet = self._was_quiet, self._active.is_quiet
        if self._was_quiet and not was_quiet:
            self._parts.database.close_idle()

    def _recover(self) -> None:
        """Has the jobs of processes that have ended done by others."""
        executors = self._parts.jobs.executors() | self._calls.busy_executors()
        if not (others := executors - {self._parts.executor}):
            return
        self._active.stir()  # while others have jobs, it is looked often whether they have ended
        with self._lease.ended(others) as ended:
            if ended:
                for job_id in (recovered := self._parts.jobs.recover(ended)):
                    log.info("recovering %s", job_id)
                if recovered:
                    self._offer()
                self._calls.recover(ended)

    def _notice_cancellations(self) -> None:
        """Another process may have canceled or deleted a job that runs here, or taken it while this one was frozen."""
        active = self._parts.active
        if running := active.runs():
            ours = self._parts.jobs.taken_by(self._parts.executor)
            for job_id, run in running.items():
                if ours.get(job_id) != run:
                    active.request_cancel(job_id)

    def _release_stalled(self) -> None:
        """Gives back jobs of this process that no thread works on: they could not be started, for example."""
        taken = self._parts.jobs.taken_by(self._parts.executor)
        idle = taken.keys() - self._parts.active.runs().keys()
        for job_id in idle & self._idle:  # idle at the last check, too: it is not just being started
            log.warning("job %s stalled and goes back to its queue", job_id)
            if self._parts.jobs.release(job_id, taken[job_id]):
                self._offer()
        self._idle = idle

    def _clean_up_in_turn(self) -> None:
        """Does what no other process has done lately."""
        database, settings = self._parts.database, self._parts.service.settings
        if database.take_turn("jobs", TURN_SECONDS):
            self.clean_up_jobs()
        seconds = LISTING_SECONDS if settings.artifacts_max_gb is None else TURN_SECONDS
        if self._stop.is_set() or not database.take_turn("artifacts", seconds):
            return

        def stop() -> bool:  # between two chunks
            database.take_turn("artifacts", RENEWAL_SECONDS)
            return self._stop.is_set()

        is_done = False
        try:
            collect_artifacts(self._parts.service, database, stop)
            is_done = not self._stop.is_set()
        finally:
            if not is_done:
                database.give_turn_back("artifacts")  # an hour is long

    def clean_up_jobs(self) -> None:
        """Removes jobs past their retention, and older records of webhook calls."""
        before = time.time() - 3600.0 * self._parts.service.settings.job_retention_hours
        while not self._stop.is_set() and (jobs := self._parts.jobs.ended_before(before, MAX_REMOVED_JOBS)):
            self._remove(jobs, before)
        self._calls.clean_up(before, self._stop.is_set)
        if not self._stop.is_set():
            self._parts.database.give_room_back(self._stop.is_set)


def collect_artifacts(service: Service, database: Database, stop: Callable[[], bool], now: float | None = None) -> None:
    """Removes what is no longer needed, as of `now` (Unix time, s; by default the clock's), until `stop` says so.

    The store is listed in chunks, one in memory at a time; a second listing finds the least recently used.

    What is used meanwhile stays, however long this takes: whoever refers to an artifact has used it within the grace
    before that. One without a reference in the database, whose last use, looked up again right before it is deleted,
    was before the grace of the start, has got none since.
    """
    now = time.time() if now is None else now
    store, max_gb = service.artifacts, service.settings.artifacts_max_gb
    store.remove_leftovers(now - LEFTOVER_SECONDS)
    max_bytes = math.inf if max_gb is None else max_gb * 1e9
    # Those of jobs that become open later are protected by their last use. A queue's limit keeps these few.
    in_use = set[str]() if max_gb is None else database.referenced_by_open_jobs()
    grace, removed, total = now - UNREFERENCED_GRACE_SECONDS, 0, 0
    removable: Counter[int] = Counter()  # bytes that the budget may remove, by the class of their age
    for chunk in _chunks(store, stop):
        old = {one.sha256 for one in chunk if one.used_at <= grace}
        deleted = store.delete(old - database.referenced(old), grace)
        removed += len(deleted)
        for one in chunk:
            if one.sha256 not in deleted:
                total += one.size
                if one.used_at <= now - BUDGET_GRACE_SECONDS and one.sha256 not in in_use:
                    removable[_age_class(now - one.used_at)] += one.size
    if removed:
        log.info("removed %d artifacts that no job refers to", removed)
    if total > max_bytes and not stop():
        total -= _remove_longest_unused(store, stop, now, in_use, removable, total - max_bytes)
        if total > max_bytes:
            shown = total / 1e9, max_gb
            log.warning("artifacts have %.1f GB, more than COW_ARTIFACTS_MAX_GB=%g: the rest is in use", *shown)


def _remove_longest_unused(
    store: ArtifactStore,
    stop: Callable[[], bool],
    now: float,
    in_use: Collection[str],
    removable: Counter[int],
    excess: float,
) -> int:
    """Removes artifacts of the highest classes of ages, of the last class as many as it takes; returns their bytes."""
    for last_class in sorted(removable, reverse=True):
        if removable[last_class] >= excess:
            break
        excess -= removable[last_class]
    else:
        last_class = -1  # not even all of them are enough
    removed = removed_bytes = 0
    for chunk in _chunks(store, stop) if removable else ():
        sizes: dict[str, int] = {}
        for one in chunk:
            age_class = _age_class(now - one.used_at)
            if age_class < last_class or one.used_at > now - BUDGET_GRACE_SECONDS or one.sha256 in in_use:
                continue
            if age_class == last_class:
                if excess <= 0:
                    continue
                excess -= one.size
            sizes[one.sha256] = one.size
        deleted = store.delete(sizes, now - BUDGET_GRACE_SECONDS)
        removed += len(deleted)
        removed_bytes += sum(sizes[sha256] for sha256 in deleted)
    log.info("removed %d artifacts for COW_ARTIFACTS_MAX_GB", removed)
    return removed_bytes


def _chunks(store: ArtifactStore, stop: Callable[[], bool]) -> Generator[list[ListedArtifact]]:
    """All artifacts of a store, until `stop` says so."""
    listed = store.listed()
    while not stop() and (chunk := list(islice(listed, CHUNK))):
        yield chunk


def _age_class(seconds: float) -> int:
    """Ages that differ by less than a hundredth are of one class: some two thousand classes are all there are."""
    return int(64 * math.log2(max(seconds, 1.0)))
