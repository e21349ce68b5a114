"""The computation of one job: its stages, each result stored at once. Runs in any process with a service.

A job engine gives its jobs to a `Computer`: its own process, or others (`cow_service.workers`).
"""

import logging
import os
import threading
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast
from weakref import WeakValueDictionary

import psutil
from pydantic import ValidationError
from pydantic_core import to_json

from cow_service.adaptive import FIRST as FIRST_CALLS
from cow_service.errors import ArtifactNotFound, CowError, StorageUnavailable
from cow_service.jobs.active import ActiveJobs
from cow_service.jobs.database import Database, StoredResult
from cow_service.jobs.job_table import JobTable, TakenJob
from cow_service.media.artifacts import ArtifactStore
from cow_service.observability.metrics import gpu_memory
from cow_service.pipeline import answer, simulate
from cow_service.records import STAGES, Answer, Stage, WorkerInfo, verdict_of
from cow_service.requests import AnswerRequest, ImageArtifact
from cow_service.service import Service
from cow_service.settings import Settings, usable_memory
from cow_service.stages.keys import RESULT_TYPES, StageKey, StageResult, digest_of
from cow_service.stages.run import Progress, Run

CANCEL_POLL_SECONDS = 0.1  # how often a job that waits for another one's result checks whether it was canceled
FIRST_WAIT, LONGEST_WAIT = 0.1, 2.0  # seconds between two tries
BYTES_PER_PIXEL = 4.5  # of an image, that a job holds while it waits for an MLLM
SHARE_WAITING = 0.5  # of the memory, that such jobs may take all together if their images are the largest

Value = TypeVar("Value")
HoldKey = Callable[[str, Callable[[], None]], AbstractContextManager[None]]
"""Holds the lock of a key; what the second argument raises ends the wait for it."""

log = logging.getLogger("cow_service")


@dataclass(frozen=True)
class Outages:
    """How long a job waits for storage, and how it learns that its result is no longer wanted."""

    budget: float  # seconds, of each outage
    check_canceled: Callable[[], None]

    def wait_through(self, work: Callable[[], Value]) -> Value:
        """What `work` returns, tried again while storage is away.

        Raises `StorageUnavailable` if it is away for longer than the budget, and what `check_canceled` raises.
        """
        began, wait = time.monotonic(), FIRST_WAIT
        while True:
            try:
                return work()
            except StorageUnavailable as error:
                left = began + self.budget - time.monotonic()
                if left <= 0:
                    raise
                log.warning("a job waits: %s", error.detail)
                until = time.monotonic() + min(wait, left)
                while (rest := until - time.monotonic()) > 0:
                    self.check_canceled()
                    time.sleep(min(FIRST_WAIT, rest))
                wait = min(2 * wait, LONGEST_WAIT)


class KeyLocks:
    """A lock for each key in use: what one job computes, another one waits for."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._locks: WeakValueDictionary[str, threading.Lock] = WeakValueDictionary()  # waiters keep their lock alive

    @contextmanager
    def held(self, key: str, check_canceled: Callable[[], None]) -> Generator[None]:
        """Holds the lock of a key. What `check_canceled` raises ends the wait for it."""
        with self._guard:
            lock = self._locks.setdefault(key, threading.Lock())
        while not lock.acquire(timeout=CANCEL_POLL_SECONDS):
            check_canceled()
        try:
            yield
        finally:
            lock.release()


@dataclass
class StoredStep:
    """The `Step` of one job: stored results are not computed again. Its stages may run in several threads.

    Results of quick stages are stored together, before the next one that may take long, or by `flush`: a transaction
    costs more than they do. One that waits for that is computed again by a job that wants the same at this moment. What
    a multimodal LLM has said is stored at once: it would not say the same again.
    """

    job_id: str
    owner: str | None  # only results of this owner may be reused, so that keys cannot learn about each other
    fresh: bool  # results of other jobs are not taken
    database: Database
    artifacts: ArtifactStore
    looked_for: Callable[[Stage, bool], None]  # hears whether a stage was found
    hold_key: HoldKey
    outages: Outages
    trajectory_key: str | None = None  # of this job's trajectory, where it computed one
    stages: set[str] = field(default_factory=set[str])  # whose results are stored, or wait for that
    waiting: list[StoredResult] = field(default_factory=list[StoredResult])  # to be stored
    guard: threading.Lock = field(default_factory=threading.Lock)  # of `waiting`

    def __call__(
        self, stage: Stage, key: StageKey, compute: Callable[[], StageResult[Any]]
    ) -> tuple[StageResult[Any], bool]:
        """The stage's result, and whether another job had computed it.

        A job that computes one of `key.also` at this moment is not waited for: it reads more than is wanted here.
        """
        scope: dict[str, str] = {}  # of those that may find the result, where not all jobs may
        if self.fresh or not key.shareable:
            scope = {"job": self.job_id}
        elif self.owner is not None:
            scope = {"owner": self.owner}
        digest, *also = (digest_of({**scope, "key": each}) if scope else each for each in (key.digest, *key.also))
        is_quick, is_beside = STAGES[stage].is_quick, STAGES[stage].is_beside
        with nullcontext() if is_beside else self.hold_key(digest, self.outages.check_canceled):
            found = None
            with self.guard:
                if not (is_quick and self.waiting):
                    found = self.outages.wait_through(
                        lambda: next((each for key in (digest, *also) if (each := self._find(stage, key))), None)
                    )
            self.looked_for(stage, found is not None and found[1])
            if found is None:
                found = result, _ = self.outages.wait_through(compute), False
                text, trajectory = result.model_dump_json(exclude={"value"} if stage == "trajectory" else None), None
                if stage == "trajectory":
                    trajectory, self.trajectory_key = result.value.model_dump_json(), digest
                with self.guard:
                    self.waiting.append(StoredResult(digest, stage, text, result.artifacts, trajectory))
                    if result.usage.calls or not is_quick:
                        self.flush()
            self.stages.add(stage)
            return found

    def flush(self) -> None:
        """Stores what waits for it. Raises `Canceled` if the job was deleted or canceled."""
        self.outages.check_canceled()  # nothing may be stored for a job that was deleted
        if self.waiting:
            self.outages.wait_through(lambda: self.database.store_results(self.job_id, self.waiting))
            self.waiting = []

    def _find(self, stage: Stage, digest: str) -> tuple[StageResult[Any], bool] | None:
        """A stored result all of whose artifacts are there, and whether it is another job's."""
        row = self.database.find_result(digest, self.job_id, self.waiting)
        self.waiting = []
        if row is None:
            return None
        job_id, values = row
        try:
            result = RESULT_TYPES[stage].model_validate_json(to_json(values))
            if job_id != self.job_id:  # before looking for its artifacts, so that they are not removed meanwhile
                self.database.reuse_result(self.job_id, stage, result.artifacts)
            self.artifacts.touch(*result.artifacts)
        except (ArtifactNotFound, ValidationError):  # lost, or of another version
            return None
        return result, job_id != self.job_id


@dataclass
class EngineParts:
    """What all parts of a job engine share."""

    service: Service
    database: Database
    jobs: JobTable
    active: ActiveJobs
    executor: str = ""  # the id of this process while the engine runs


@dataclass(frozen=True)
class Work:
    """One job to be computed, and who hears of it."""

    job: TakenJob
    progress: Progress  # raises `Canceled` if the result is no longer wanted
    check: Callable[[], None]  # raises `Canceled` as well, and says nothing
    looked_for: Callable[[Stage, bool], None]  # a stage was looked for among stored results, and whether it was there


@dataclass(frozen=True)
class JobOutcome:
    """The result of a job, and the time of each stage that was computed for it, s."""

    result: str  # JSON, without the trajectory where that is stored under `trajectory_key`
    trajectory_key: str | None
    timings: dict[str, float]
    stages: set[str]  # of the job; all are stored
    answer: str  # in words


def waiting_jobs(settings: Settings) -> int:
    """Jobs that may wait for an MLLM at the same time, and compute nothing: as many as calls, if memory allows."""
    if not settings.mllm:
        return 0
    memory = usable_memory()
    if settings.worker_memory_mb is not None:
        memory = min(memory, settings.worker_memory_mb * 1e6 * settings.concurrency)
    fitting = int(SHARE_WAITING * memory / (settings.max_image_megapixels * 1e6 * BYTES_PER_PIXEL))
    return min(settings.mllm_concurrency, max(FIRST_CALLS, fitting))


class Computer:
    """Computes jobs, some at the same time: this one none, which is for worker processes on the same job database."""

    def start(self) -> None:
        """Makes ready for jobs. Returns at once."""

    def close(self) -> None:
        """Releases what it holds. No job is running any more."""

    def capacity(self, queue: str) -> int:
        """How many jobs of a queue are taken at the same time; 0 where none is."""
        return 0

    def compute(self, work: Work) -> JobOutcome:
        """Computes one job. Raises the `CowError` that it fails with, `Canceled` where it was canceled."""
        raise NotImplementedError

    def workers(self, active: ActiveJobs) -> tuple[WorkerInfo, ...]:
        """Those that are alive, with their jobs as `active` knows them."""
        return ()


class InProcess(Computer):
    """Computes jobs in the threads that ask for it."""

    def __init__(self, parts: EngineParts) -> None:
        self._parts, self._locks, self._jobs_done = parts, KeyLocks(), 0

    def capacity(self, queue: str) -> int:
        """Those that compute, and those that wait for an MLLM."""
        settings = self._parts.service.settings
        return settings.concurrency + waiting_jobs(settings)

    def compute(self, work: Work) -> JobOutcome:
        """As the base class says."""
        try:
            return compute(work, self._parts.service, self._parts.database, self._locks.held)
        finally:
            self._jobs_done += 1

    def workers(self, active: ActiveJobs) -> tuple[WorkerInfo, ...]:
        """The process itself."""
        own = WorkerInfo(
            name="server",
            queue=None,
            pid=os.getpid(),
            memory_mb=round(psutil.Process().memory_info().rss / 1e6, 1),
            jobs_done=self._jobs_done,
            jobs=active.describe(active.runs()),
            gpus=gpu_memory(),
            load=self._parts.service.load(),
        )
        return (own,)


def compute(work: Work, service: Service, database: Database, hold_key: HoldKey) -> JobOutcome:
    """Computes one job with the backends of a service; stages that are stored already are taken from the database."""
    job, spec, outages = work.job, work.job.spec, Outages(service.settings.outage_budget, work.check)
    step = StoredStep(job.id, job.owner, spec.fresh, database, service.artifacts, work.looked_for, hold_key, outages)
    request = spec.parsed()
    assert isinstance(request.image, ImageArtifact), "the image of a job is kept before the job is taken"
    given = work.progress, step, outages.wait_through, job.id, spec.created_at, spec.turn
    seen = None if spec.fresh else service.seen
    run = outages.wait_through(lambda: service.prepare(request, *given))
    run.share(seen, job.owner)
    run.until = spec.until
    try:
        result = answer(cast("Run[AnswerRequest]", run)) if isinstance(request, AnswerRequest) else simulate(run)
    except CowError:  # the stages before the one that failed are found by the next try
        with suppress(CowError):
            step.flush()
        raise
    step.flush()
    computed = {stage: seconds for stage, seconds in result.timings.items() if stage not in result.reused}
    simulation, verdict = result.simulation if isinstance(result, Answer) else result, verdict_of(result)
    trajectory_key = None if simulation is None else step.trajectory_key
    if trajectory_key is not None and simulation is not None:
        bare = simulation.model_copy(update={"trajectory": None})
        result = result.model_copy(update={"simulation": bare}) if isinstance(result, Answer) else bare
    return JobOutcome(result.model_dump_json(warnings=False), trajectory_key, computed, step.stages, verdict)
