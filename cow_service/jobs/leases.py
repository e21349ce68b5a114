"""The executor id of this process in the job database: the same after a restart, and never that of a live process.

Each process holds one numbered lock file of its data folder, which the operating system releases however the process
ends. A restart finds its old number free, and with it the jobs that were interrupted there.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from filelock import FileLock, Timeout

from cow_service.errors import StorageUnavailable

MAX_EXECUTORS = 256  # processes on one data folder


class ExecutorLease:
    """The lease of this process on an executor id, and a view of those that have expired."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock: FileLock | None = None

    def acquire(self) -> str:
        """Takes the first free id and returns it. Raises `StorageUnavailable`."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            for number in range(MAX_EXECUTORS):
                self._lock = self._try_lock(number)
                if self._lock is not None:
                    return self._executor_id(number)
        except OSError as error:
            raise StorageUnavailable("The data folder cannot be written: no place for this process.") from error
        raise StorageUnavailable(
            f"{MAX_EXECUTORS} processes use this data folder; give this one another by COW_DATA_DIR."
        )

    @contextmanager
    def expired(self) -> Generator[list[str]]:
        """The ids of processes that have ended. No other process can acquire them inside the block."""
        locks: dict[int, FileLock] = {}
        try:
            for path in self._folder.glob("*.lock"):
                # The lock of this process cannot be taken twice, so its own id is never among them.
                if path.stem.isdigit() and (lock := self._try_lock(int(path.stem))) is not None:
                    locks[int(path.stem)] = lock
            yield [self._executor_id(number) for number in locks]
        finally:
            for lock in locks.values():
                lock.release()

    def release(self) -> None:
        """Gives the id back."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _try_lock(self, number: int) -> FileLock | None:
        lock = FileLock(self._folder / f"{number}.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return None
        return lock

    def _executor_id(self, number: int) -> str:
        """Unique to the data folder: other machines may use the same database."""
        return f"{self.folder_id}-{number}"

    @property
    def folder_id(self) -> str:
        """Names the data folder, wherever it is mounted."""
        path = self._folder / "name"
        with FileLock(self._folder / "name.lock"):
            if not path.exists():
                path.write_text(uuid4().hex)
            return path.read_text()
