"""The computation of one job: its stages, each result stored as soon as it is there. In any process that has a service.

A job engine gives its jobs to a `Computer`: its own process (`in_process.py`), or others (`cow_service.workers`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from cow_service.jobs.database import Database
from cow_service.jobs.kept_apart import without
from cow_service.jobs.outages import Outages
from cow_service.jobs.spec import JobSpec
from cow_service.jobs.stage_cache import HoldKey, StoredStep
from cow_service.media.images import DecodedImage
from cow_service.pipeline import answer, simulate
from cow_service.records import GpuMemory
from cow_service.requests import AnswerRequest, ImageArtifact, Stage
from cow_service.service import Service
from cow_service.stages.run import Progress


@dataclass(frozen=True)
class Work:
    """One job to be computed, and who hears of it."""

    job_id: str
    spec: JobSpec
    owner: str | None
    image: Callable[[], DecodedImage | None]  # its pixels where they are at hand: given away by the first call
    progress: Progress  # raises `Canceled` where nobody wants the result any more
    check: Callable[[], None]  # raises `Canceled` as well, and says nothing
    looked_for: Callable[[Stage, bool], None]  # a stage was looked for among stored results, and whether it was there


@dataclass(frozen=True)
class Outcome:
    """What a job came to: the result as JSON, and the time of each stage that was computed for it, s.

    A trajectory that was kept apart (`kept_apart.py`) is not in it.
    """

    result: str
    timings: dict[str, float]


@dataclass(frozen=True)
class WorkerState:
    """What computes jobs, as it is now."""

    name: str
    queue: str | None  # whose jobs it computes; None: of all queues
    pid: int
    memory_bytes: int
    jobs_done: int
    jobs: tuple[str, ...]  # at hand
    gpus: tuple[GpuMemory, ...] = ()


class Computer(Protocol):
    """Computes jobs, some at the same time."""

    def start(self) -> None:
        """Makes ready for jobs. Returns at once."""
        ...

    def close(self) -> None:
        """Lets go of what it holds. No job is at work any more."""
        ...

    def capacity(self, queue: str) -> int:
        """How many jobs of a queue are taken at the same time; 0 where none is."""
        ...

    def compute(self, work: Work) -> Outcome:
        """Computes one job. Raises the `CowError` that it fails with, `Canceled` where it was canceled."""
        ...

    def workers(self) -> tuple[WorkerState, ...]:
        """What computes the jobs."""
        ...


class Elsewhere:
    """Computes no jobs: worker processes that share the job database take them from its queues."""

    def start(self) -> None:
        """Does nothing."""

    def close(self) -> None:
        """Does nothing."""

    def capacity(self, queue: str) -> int:
        """None."""
        return 0

    def compute(self, work: Work) -> Outcome:
        """Is never called, as no job is taken."""
        raise NotImplementedError

    def workers(self) -> tuple[WorkerState, ...]:
        """None."""
        return ()


def compute(work: Work, service: Service, database: Database, hold_key: HoldKey) -> Outcome:
    """Computes one job with the backends of a service; stages that are stored already are taken from the database."""
    spec = work.spec
    outages = Outages(service.settings.outage_budget, work.check)
    step = StoredStep(
        job_id=work.job_id,
        owner=work.owner,
        fresh=spec.fresh,
        database=database,
        artifacts=service.artifacts,
        looked_for=work.looked_for,
        hold_key=hold_key,
        outages=outages,
    )
    request = spec.parsed()
    assert isinstance(request.image, ImageArtifact), "the image of a job is kept before the job is taken"
    given = work.progress, work.image(), step, outages.wait_through, work.job_id, spec.created_at, spec.turn
    seen = None if spec.fresh else service.seen
    if isinstance(request, AnswerRequest):
        with outages.wait_through(lambda: service.prepare(request, *given)).with_images(seen, work.owner) as run:
            result = answer(run)
    else:
        with outages.wait_through(lambda: service.prepare(request, *given)).with_images(seen, work.owner) as run:
            result = simulate(run)
    computed = {stage: seconds for stage, seconds in result.timings.items() if stage not in result.reused}
    text = result.model_dump_json()
    return Outcome(text if step.trajectory is None else without(text, "trajectory", *step.trajectory), computed)
