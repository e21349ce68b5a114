"""What all parts of a job engine share: the service, the database, and the open jobs."""

from __future__ import annotations

import threading
from collections import defaultdict
from dataclasses import dataclass, replace

from dbos import DBOS

from cow_service.errors import CowError, StorageUnavailable
from cow_service.jobs import state
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.database import Database, database_errors
from cow_service.jobs.pace import Pace
from cow_service.jobs.state import JobState, OpenJob
from cow_service.jobs.turns import moves, next_turn, step_of
from cow_service.jobs.webhooks import attempt_ids
from cow_service.requests import Priority
from cow_service.service import Service


@dataclass(frozen=True)
class Turn:
    """When a new job comes to work, and whether jobs of its owner move back by `step` for it."""

    number: int
    step: int
    moves_others: bool


class OpenJobs:
    """Knows which jobs are open: queued or running, in this process or another. It starts none."""

    def __init__(self, service: Service) -> None:
        self.service = service
        self.database = Database(service.settings)
        self.active = ActiveJobs()
        self.lock = threading.RLock()
        self._open: dict[str, OpenJob] = {}
        self._paces: defaultdict[str, Pace] = defaultdict(Pace)
        self._changes: list[tuple[str, OpenJob | None]] | None = None  # to the open jobs, while `recount` reads them

    def __len__(self) -> int:
        return len(self._open)

    def count(self, queue: str) -> int:
        """How many jobs of a queue are open, in it or at work."""
        with self.lock:
            return sum(each.queue == queue for each in self._open.values())

    def count_of(self, owner: str | None) -> int:
        """How many jobs of an owner are open."""
        with self.lock:
            return sum(each.owner == owner for each in self._open.values())

    def find(self, job_id: str, *, full: bool = True) -> JobState | None:
        """A job by its id: with its result or problem unless `full` is false, with its place while it waits."""
        found = state.find(job_id, self.active, full=full)
        if found is None:
            return None
        if found.result is not None:
            result = self.database.whole(job_id, found.result)
            return None if result is None else replace(found, result=result)
        if found.job.status == "queued":
            return replace(found, job=found.job.model_copy(update=self._place_in_line(job_id)))
        return found

    def take_turn(self, owner: str | None, queue: str, priority: Priority) -> Turn:
        """The turn of an owner's next job in a queue; moves back what comes behind it, here and not in the database."""
        with self.lock:
            step = step_of(self.service.settings.key_weights.get(owner or "", 1.0))
            jobs = [each for each in self._open.values() if each.queue == queue]
            turn = next_turn(jobs, owner, priority, step)
            behind = [
                (job_id, each)
                for job_id, each in self._open.items()
                if each.queue == queue and moves(each, owner, priority, turn)
            ]
            for job_id, each in behind:
                self.record(job_id, replace(each, turn=each.turn + step))
        return Turn(turn, step, bool(behind))

    def record(self, job_id: str, job: OpenJob | None) -> None:
        """A job is open, or, with None, no longer open."""
        with self.lock:
            if self._changes is not None:
                self._changes.append((job_id, job))
            if job is None:
                ended = self._open.pop(job_id, None)
                if ended is not None:
                    self._paces[ended.queue].note()
            else:
                self._open[job_id] = job

    def recount(self) -> None:
        """Reads the open jobs from the database, those of other processes included."""
        with self.lock:
            self._changes = []
        found = state.open_jobs()
        with self.lock:
            changes, self._changes = self._changes, None
            self._open = found
            for job_id, job in changes or ():  # what happened while the database was asked
                self.record(job_id, job)

    def ended(self, job_id: str, outcome: str | CowError | None, created_at: str | None = None) -> None:
        """The database says that a job has ended. `outcome` and `created_at` as in `ActiveJobs.notify_ended`."""
        self.record(job_id, None)
        if isinstance(outcome, str):
            try:
                outcome = self.database.whole(job_id, outcome)
            except StorageUnavailable:
                outcome = None  # who waits for it reads it when the database is back
        self.active.notify_ended(job_id, outcome, created_at)

    def remove(self, jobs: list[str], untouched_since: float) -> None:
        """Removes jobs that have ended, and those of their artifacts that were not used since (Unix time, s)."""
        with database_errors():
            DBOS.delete_workflows([*jobs, *(attempt for job_id in jobs for attempt in attempt_ids(job_id))])
        for sha256 in self.database.remove_jobs(jobs):
            self.service.artifacts.delete(sha256, untouched_since + 1)

    def _place_in_line(self, job_id: str) -> dict[str, float | None]:
        """`position` and `expected_wait` of a queued job."""
        with self.lock:
            own = self._open.get(job_id)
            if own is None:
                return {}
            before = sum(
                (each.turn, each.created_at) < (own.turn, own.created_at) and self.active.at(other) is None
                for other, each in self._open.items()
                if each.queue == own.queue
            )
            pace = self._paces[own.queue].jobs_per_second()
        return {"position": before, "expected_wait": None if pace is None else round((before + 1) / pace, 1)}
