"""The work on one job, inside its workflow: the service's stages, with progress, checkpoints and an end."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from dbos import DBOS

from cow_service.errors import Canceled, CowError, InternalError
from cow_service.jobs import state
from cow_service.jobs.active import ActiveJob
from cow_service.jobs.open_jobs import OpenJobs
from cow_service.jobs.outages import Outages
from cow_service.jobs.spec import JobSpec
from cow_service.jobs.stage_cache import KeyLocks, StoredStep
from cow_service.jobs.webhooks import Webhooks
from cow_service.observability import tracing
from cow_service.observability.context import bound
from cow_service.pipeline import answer, simulate
from cow_service.records import Answer, Simulation
from cow_service.requests import AnswerRequest, ImageArtifact, Stage

POLL_SECONDS, MAX_POLLS = 0.1, 100  # until the database has the end of a webhook's job

log = logging.getLogger("cow_service")


class JobAborted(BaseException):
    """The work on a job ends here without an outcome. No `Exception`: DBOS must not record it as one."""


class Worker:
    """Does the work of an engine's jobs. Thread-safe."""

    def __init__(self, open_jobs: OpenJobs, webhooks: Webhooks, on_work_ended: Callable[[str], None]) -> None:
        self._open_jobs = open_jobs
        self._webhooks = webhooks
        self._on_work_ended = on_work_ended
        self._locks = KeyLocks()

    def run(self, job_id: str, spec: dict[str, Any]) -> str:
        """Does the work of a job; returns the result as JSON.

        Raises the `CowError` that the job fails with, and `JobAborted` where it was canceled: then it has no outcome.
        """
        job = JobSpec.model_validate(spec)
        try:
            with (
                bound(request=job.request_id, job=job_id),
                tracing.span(f"job {job.kind}", parent=job.traceparent, job_id=job_id),
                self._open_jobs.active.running(job_id) as running,
            ):
                return self._outcome(job_id, job, running)
        finally:
            self._on_work_ended(job_id)

    def deliver(self, job_id: str, url: str, attempt: int) -> None:
        """Calls a webhook, and sees to another attempt where that failed."""
        # As a step: in a workflow, every question to the database would be one, and its answer kept.
        wait: float | None = DBOS.run_step({"name": "deliver"}, lambda: self._delivered(job_id, url, attempt))
        if wait is not None:
            self._webhooks.enqueue(job_id, url, attempt + 1, delay=wait)

    def _delivered(self, job_id: str, url: str, attempt: int) -> float | None:
        """Seconds until another attempt is to follow, where one is."""
        for _ in range(MAX_POLLS):
            found = state.find(job_id, self._open_jobs.active)
            if found is None:
                return None  # deleted: there is nothing to tell any more
            if found.ended is not None:
                return self._webhooks.send(found.job, url, attempt)
            time.sleep(POLL_SECONDS)
        return self._webhooks.wait_after(job_id, attempt, "the job had not ended")  # a crash came between

    def _outcome(self, job_id: str, spec: JobSpec, running: ActiveJob) -> str:
        metrics = self._open_jobs.service.metrics
        outages = Outages(self._open_jobs.service.settings.outage_budget, running.check)

        def ended() -> None:
            outages.wait_through(lambda: self._webhooks.job_ended(job_id, spec.webhook))

        try:
            result = self._result(job_id, spec, running, outages)
        except Canceled as error:
            raise JobAborted from error
        except CowError as error:
            log.info("job %s failed: %s", job_id, error.code)  # its detail may hold what was asked
            metrics.job(spec.kind, "failed")
            ended()
            raise
        except Exception as error:
            log.exception("job %s failed", job_id)
            metrics.job(spec.kind, "failed")
            ended()
            raise InternalError("The server met an error that it did not foresee; its log has the trace.") from error
        for stage, seconds in result.timings.items():
            if stage not in result.reused:
                metrics.stage(stage, seconds)
        metrics.job(spec.kind, "succeeded")
        ended()
        return result.model_dump_json()

    def _result(self, job_id: str, spec: JobSpec, running: ActiveJob, outages: Outages) -> Simulation | Answer:
        open_jobs, service = self._open_jobs, self._open_jobs.service

        def progress(stage: Stage | None, done: float) -> None:
            open_jobs.active.progress(job_id, running, stage, done)

        step = StoredStep(
            job_id=job_id,
            owner=DBOS.authenticated_user,
            fresh=spec.fresh,
            database=open_jobs.database,
            artifacts=service.artifacts,
            metrics=service.metrics,
            locks=self._locks,
            outages=outages,
        )
        request = spec.parsed()
        assert isinstance(request.image, ImageArtifact), "the image of a job is kept before the job is taken"
        image = open_jobs.active.take_image(job_id, request.image.artifact)
        given = progress, image, step, job_id, spec.created_at, spec.turn
        if isinstance(request, AnswerRequest):
            return answer(outages.wait_through(lambda: service.prepare(request, *given)))
        return simulate(outages.wait_through(lambda: service.prepare(request, *given)))
