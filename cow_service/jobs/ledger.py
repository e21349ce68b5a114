"""What all parts of an engine share: the service, the database, and a count of the jobs that wait or run."""

from __future__ import annotations

import threading

from dbos import DBOS

from cow_service.errors import CowError
from cow_service.jobs import reports
from cow_service.jobs.database import Database, database_errors
from cow_service.jobs.live import Live
from cow_service.jobs.webhooks import attempts_of
from cow_service.service import Service


class Ledger:
    """Knows which jobs are open. It starts none."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self.database = Database(service.settings)
        self.live = Live()
        self.guard = threading.RLock()
        self._open: dict[str, str] = {}  # jobs that wait or run anywhere, and the generator of each
        self._changes: list[tuple[str, str | None]] | None = None  # of them, while they are counted anew

    def __len__(self) -> int:
        return len(self._open)

    def of(self, generator: str) -> int:
        """How many of a generator are open."""
        with self.guard:
            return sum(one == generator for one in self._open.values())

    def count(self, job_id: str, generator: str | None) -> None:
        """A job is open with a generator, or no longer."""
        with self.guard:
            if self._changes is not None:
                self._changes.append((job_id, generator))
            if generator is None:
                self._open.pop(job_id, None)
            else:
                self._open[job_id] = generator

    def recount(self) -> None:
        """Counts the jobs that wait or run, those of other processes included."""
        with self.guard:
            self._changes = []
        found = reports.open_jobs()
        with self.guard:
            changes, self._changes = self._changes, None
            self._open = found
            for job_id, generator in changes or ():  # what happened while the database was asked
                self.count(job_id, generator)

    def depth(self) -> dict[tuple[str, str], int]:
        """How many jobs of each generator are queued, and how many running."""
        with self.guard:
            jobs = dict(self._open)
        depth: dict[tuple[str, str], int] = {}
        for job_id, generator in jobs.items():
            running = self.live.look(job_id)
            state = "queued" if running is None or running.stage is None else "running"
            depth[generator, state] = depth.get((generator, state), 0) + 1
        return depth

    def ended(self, job_id: str, outcome: str | CowError | None) -> None:
        """The database says that a job has ended; `outcome` is its result or error where it is at hand."""
        self.count(job_id, None)
        self.live.settled(job_id, outcome)

    def remove(self, jobs: list[str], untouched_since: float) -> None:
        """Removes jobs that have ended, and those of their artifacts that nobody has needed since."""
        with database_errors():
            DBOS.delete_workflows([*jobs, *(attempt for job_id in jobs for attempt in attempts_of(job_id))])
        for sha256 in self.database.forget(jobs):
            self.service.artifacts.delete(sha256, untouched_since + 1)
