"""Stores the result of each stage of a job, and finds it again by its key: after a crash, and for other jobs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Any

from pydantic import ValidationError

from cow_service.errors import ArtifactNotFound
from cow_service.jobs.database import Database
from cow_service.jobs.kept_apart import without
from cow_service.jobs.outages import Outages
from cow_service.media.artifacts import ArtifactStore
from cow_service.requests import Stage
from cow_service.stages.keys import RESULT_TYPES, StageKey, StageResult, digest_of

CANCEL_POLL_SECONDS = 0.1  # how often a job that waits for another one's result checks whether it was canceled

HoldKey = Callable[[str, Callable[[], None]], AbstractContextManager[None]]
"""Holds the lock of a key; what the second argument raises ends the wait for it."""


@dataclass
class KeyLocks:
    """A lock for each key in use: what one job computes, another one waits for."""

    _guard: threading.Lock = field(default_factory=threading.Lock)
    _locks: dict[str, tuple[threading.Lock, int]] = field(default_factory=dict[str, tuple[threading.Lock, int]])

    @contextmanager
    def held(self, key: str, check_canceled: Callable[[], None]) -> Generator[None]:
        """Holds the lock of a key. What `check_canceled` raises ends the wait for it."""
        with self._guard:
            lock, users = self._locks.get(key, (threading.Lock(), 0))
            self._locks[key] = (lock, users + 1)
        try:
            while not lock.acquire(timeout=CANCEL_POLL_SECONDS):
                check_canceled()
            try:
                yield
            finally:
                lock.release()
        finally:
            with self._guard:
                lock, users = self._locks.pop(key)
                if users > 1:
                    self._locks[key] = (lock, users - 1)


@dataclass
class StoredStep:
    """The `Step` of one job: a result is stored as soon as it is there, and not computed again."""

    job_id: str
    owner: str | None  # whose results of other jobs may be taken: nobody learns what another key asked
    fresh: bool  # results of other jobs are not taken
    database: Database
    artifacts: ArtifactStore
    looked_for: Callable[[Stage, bool], None]  # hears whether a stage was found
    hold_key: HoldKey
    outages: Outages
    # As JSON, and its key, once it is kept apart for this job: not where an earlier start did it.
    trajectory: tuple[str, str] | None = None

    def __call__(
        self, stage: Stage, key: StageKey, compute: Callable[[], StageResult[Any]]
    ) -> tuple[StageResult[Any], bool]:
        """The stage's result, and whether another job had computed it.

        A job that computes one of `key.also` at this moment is not waited for: it reads more than is wanted here.
        """
        digest, *also = (self._stored_as(each, key.shareable) for each in (key.digest, *key.also))
        with self.hold_key(digest, self.outages.check_canceled):
            found = self.outages.wait_through(lambda: self._find_any(stage, [digest, *also]))
            if found is not None:
                result, reused = found
                self.looked_for(stage, reused)
                if reused:
                    self.outages.wait_through(lambda: self.database.reuse_result(self.job_id, stage, result.artifacts))
                return result, reused
            self.looked_for(stage, False)
            result = self.outages.wait_through(compute)
            self.outages.check_canceled()  # the job may have been deleted: nothing may be stored for it
            self._store(stage, digest, result)
            return result, False

    def _store(self, stage: Stage, digest: str, result: StageResult[Any]) -> None:
        text, trajectory = result.model_dump_json(), None
        if stage == "trajectory":
            trajectory = result.value.model_dump_json()
            text = without(text, "value", trajectory, digest)
        kept = digest, self.job_id, stage, text, result.artifacts, trajectory
        self.outages.wait_through(lambda: self.database.store_result(*kept))
        self.trajectory = self.trajectory if trajectory is None else (trajectory, digest)

    def _stored_as(self, digest: str, shareable: bool) -> str:
        """What a result is stored under, where not all jobs may find it."""
        if self.fresh or not shareable:
            return digest_of({"job": self.job_id, "key": digest})
        return digest if self.owner is None else digest_of({"owner": self.owner, "key": digest})

    def _find_any(self, stage: Stage, digests: Sequence[str]) -> tuple[StageResult[Any], bool] | None:
        """The first of several results that is there, as `_find` does."""
        found = (self._find(stage, digest) for digest in digests)
        return next((each for each in found if each is not None), None)

    def _find(self, stage: Stage, digest: str) -> tuple[StageResult[Any], bool] | None:
        """A stored result all of whose artifacts are there, and whether it is another job's."""
        row = self.database.find_result(digest)
        if row is None:
            return None
        job_id, text = row
        try:
            result = RESULT_TYPES[stage].model_validate_json(text)
            if result.artifacts and job_id != self.job_id:  # before they are looked for: nobody removes them meanwhile
                self.database.add_references(self.job_id, result.artifacts)
            self.artifacts.touch(*result.artifacts)
        except (ArtifactNotFound, ValidationError):  # lost, or of another version
            return None
        return result, job_id != self.job_id
