"""The work on one job, inside its workflow: given to who computes it, with progress and an end."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from dbos import DBOS

from cow_service.errors import Canceled, CowError, unforeseen
from cow_service.jobs import state
from cow_service.jobs.active import ActiveJob
from cow_service.jobs.computing import Computer, Work
from cow_service.jobs.news import JobNews, News
from cow_service.jobs.open_jobs import OpenJobs
from cow_service.jobs.outages import Outages
from cow_service.jobs.spec import JobSpec
from cow_service.jobs.webhooks import Webhooks
from cow_service.observability import logging as context
from cow_service.observability import tracing
from cow_service.requests import Stage

POLL_SECONDS, MAX_POLLS = 0.1, 100  # until the database has the end of a webhook's job

log = logging.getLogger("cow_service")


class JobAborted(BaseException):
    """The work on a job ends here without an outcome. No `Exception`: DBOS must not record it as one."""


class Worker:
    """Does the work of an engine's jobs. Thread-safe."""

    def __init__(
        self,
        open_jobs: OpenJobs,
        webhooks: Webhooks,
        computer: Computer,
        news: News,
        on_work_ended: Callable[[str], None],
    ) -> None:
        self._open_jobs = open_jobs
        self._webhooks = webhooks
        self._computer = computer
        self._news = news
        self._on_work_ended = on_work_ended

    def run(self, job_id: str, spec: dict[str, Any]) -> str:
        """Does the work of a job; returns the result as JSON.

        Raises the `CowError` that the job fails with, and `JobAborted` where it was canceled: then it has no outcome.
        """
        job = JobSpec.model_validate(spec)
        try:
            with (
                context.bound(request=job.request_id, job=job_id),
                tracing.span(f"job {job.kind}", parent=job.traceparent, job_id=job_id),
                self._open_jobs.active.running(job_id, job.kind) as running,
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
            outcome = self._computer.compute(self._work(job_id, spec, running))
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
            raise unforeseen() from error
        for stage, seconds in outcome.timings.items():
            metrics.stage(stage, seconds)
        metrics.job(spec.kind, "succeeded")
        ended()
        return outcome.result

    def _work(self, job_id: str, spec: JobSpec, running: ActiveJob) -> Work:
        active = self._open_jobs.active

        def progress(stage: Stage | None, done: float) -> None:
            active.progress(job_id, running, stage, done)
            if stage is not None:
                self._news.tell(JobNews("progress", job_id, stage, done))

        return Work(
            job_id=job_id,
            spec=spec.model_copy(update={"traceparent": context.traceparent()}),
            owner=DBOS.authenticated_user,
            image=lambda: active.take_image(job_id, spec.image),
            progress=progress,
            check=running.check,
            looked_for=self._open_jobs.service.metrics.stage_cache,
        )
