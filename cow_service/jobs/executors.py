"""Who this process is to the job database: the same after a restart, and never somebody who still runs.

Each process holds one numbered place of its data folder by a file lock, which the operating system takes back however
the process ends. A restart finds its old place free, and so the jobs that were under way there.
"""

from __future__ import annotations

from pathlib import Path
from uuid import uuid4

from filelock import FileLock, Timeout

from cow_service.errors import StorageUnavailable

PLACES = 256  # processes on one data folder


class Executors:
    """The places of one data folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._held: FileLock | None = None
        self._place = -1

    def take(self) -> str:
        """Takes the first free place; returns the name of whoever holds it. Raises `StorageUnavailable`."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            for place in range(PLACES):
                lock = self._lock(place)
                if lock is not None:
                    self._held, self._place = lock, place
                    return self._name(place)
        except OSError as error:
            raise StorageUnavailable("The data folder cannot be written: no place for this process.") from error
        raise StorageUnavailable(f"{PLACES} processes use this data folder; give this one another by COW_DATA_DIR.")

    def dead(self) -> list[tuple[str, FileLock]]:
        """Others that have ended: their names, and the locks of their places, held until they are released."""
        found: list[tuple[str, FileLock]] = []
        for path in self._folder.glob("*.lock"):
            if path.stem.isdigit() and int(path.stem) != self._place:
                lock = self._lock(int(path.stem))
                if lock is not None:
                    found.append((self._name(int(path.stem)), lock))
        return found

    def leave(self) -> None:
        """Gives the place back."""
        if self._held is not None:
            self._held.release()
            self._held = None

    def _lock(self, place: int) -> FileLock | None:
        lock = FileLock(self._folder / f"{place}.lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return None
        return lock

    def _name(self, place: int) -> str:
        """Of the data folder and the place in it: other machines may use the same database."""
        path = self._folder / "name"
        with FileLock(self._folder / "name.lock"):
            if not path.exists():
                path.write_text(uuid4().hex)
            return f"{path.read_text()}-{place}"
