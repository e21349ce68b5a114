"""Keeps the stages of one job: each is a step of its workflow, and its result is found again by what decided it."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

from dbos import DBOS

from cow_service.errors import ArtifactNotFound, Canceled
from cow_service.jobs.database import Database
from cow_service.records import Record
from cow_service.requests import Stage
from cow_service.service import Service
from cow_service.stages.results import digest_of

POLL = 0.1  # seconds between looks at whether somebody who waits for the same work is still wanted
# Stages that are steps of the workflow: those that ask others or take long. What any stage comes to is kept the moment
# it is there, and found after a crash, so that nothing is done again; a step on top takes 3 ms, longer than the rest.
STEPS: tuple[Stage, ...] = ("grounding", "generation", "answering")

Result = TypeVar("Result", bound=Record)
_SHA256 = re.compile(r'"sha256":"([0-9a-f]{64})"')


class Left(BaseException):
    """The work on a job ends here without an outcome. No `Exception`: DBOS must not record it as one."""


@dataclass
class Flights:
    """Work that is under way in this process, so that the same is not begun twice."""

    _lock: threading.Lock = field(default_factory=threading.Lock)
    _held: dict[str, tuple[threading.Lock, int]] = field(default_factory=dict[str, tuple[threading.Lock, int]])

    @contextmanager
    def alone_with(
        self, key: str, elsewhere: Callable[[], AbstractContextManager[None]], still_wanted: Callable[[], None]
    ) -> Generator[None]:
        """Holds a key. Whoever waits for it lets others compute."""
        with self._lock:
            lock, users = self._held.get(key, (threading.Lock(), 0))
            self._held[key] = (lock, users + 1)
        try:
            if not lock.acquire(blocking=False):
                with elsewhere():
                    while not lock.acquire(timeout=POLL):
                        still_wanted()
            try:
                yield
            finally:
                lock.release()
        finally:
            with self._lock:
                lock, users = self._held[key]
                self._held[key] = (lock, users - 1)
                if users == 1:
                    del self._held[key]


@dataclass
class JobCheckpoints:
    """The `Checkpoints` of one job."""

    job: str
    rank: str  # of the job among those that want to compute
    fresh: bool  # nothing of other jobs is taken
    service: Service
    database: Database
    flights: Flights
    still_wanted: Callable[[], None]

    def __call__(
        self, stage: Stage, inputs: Mapping[str, Any] | None, model: type[Result], compute: Callable[[], Result]
    ) -> tuple[Result, bool]:
        """The stage's result, computed or found again, and whether it is another job's."""
        own = {"job": self.job} if self.fresh or inputs is None else {}
        key = digest_of({"stage": stage, **own, **(inputs or {})})
        made: list[tuple[Result, bool]] = []

        def step() -> list[Any]:
            try:
                made.append(self._made(stage, key, model, compute))
            except Canceled as error:
                raise Left from error
            return [key, made[0][1]]

        if stage not in STEPS:
            step()
            return made[0]
        key, reused = DBOS.run_step({"name": stage}, step)
        if made:
            return made[0]
        # This step was done before the process ended; another one may have replaced or lost what it came to.
        kept = self._kept(key, model)
        return (self._keep(stage, key, compute()) if kept is None else kept[0]), bool(reused)

    def _made(self, stage: Stage, key: str, model: type[Result], compute: Callable[[], Result]) -> tuple[Result, bool]:
        elsewhere = partial(self.service.slots.left, self.rank)
        with self.flights.alone_with(key, elsewhere, self.still_wanted):
            kept = self._kept(key, model)
            if kept is not None:
                result, job, artifacts = kept
                self.service.metrics.stage_cache(stage, hit=job != self.job)
                if job != self.job:
                    self.database.add_references(self.job, artifacts)
                return result, job != self.job
            self.service.metrics.stage_cache(stage, hit=False)
            return self._keep(stage, key, compute()), False

    def _keep(self, stage: Stage, key: str, result: Result) -> Result:
        text = result.model_dump_json()
        self.database.save(key, self.job, stage, text, artifacts_of(text))
        return result

    def _kept(self, key: str, model: type[Result]) -> tuple[Result, str, list[str]] | None:
        """A result that is kept, the job that came to it, and its artifacts, all of which are there."""
        found = self.database.find(key)
        if found is None:
            return None
        job, text = found
        artifacts = artifacts_of(text)
        try:
            for sha256 in artifacts:
                self.service.artifacts.touch(sha256)
        except ArtifactNotFound:
            return None
        return model.model_validate_json(text), job, artifacts


def artifacts_of(text: str) -> list[str]:
    """The artifacts that a record, as JSON, speaks of."""
    return _SHA256.findall(text)
