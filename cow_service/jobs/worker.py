"""The work on one job, inside its workflow: the service's stages, with progress, checkpoints and an end."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from dbos import DBOS

from cow_service.errors import Canceled, CowError, InternalError
from cow_service.jobs import reports
from cow_service.jobs.ledger import Ledger
from cow_service.jobs.live import Running
from cow_service.jobs.orders import Order
from cow_service.jobs.stage_cache import KeyLocks, StoredStep
from cow_service.jobs.webhooks import Webhooks
from cow_service.observability import tracing
from cow_service.observability.context import bound, parse_traceparent
from cow_service.pipeline import answer, simulate
from cow_service.records import Answer, Simulation
from cow_service.requests import AnswerRequest, Stage

WAIT, WAITS = 0.1, 100  # seconds between looks, and how many, until a webhook's job has ended

log = logging.getLogger("cow_service")


class Left(BaseException):
    """The work on a job ends here without an outcome. No `Exception`: DBOS must not record it as one."""


class Worker:
    """Does the work of an engine's jobs, in whatever threads it is called."""

    def __init__(self, ledger: Ledger, webhooks: Webhooks, left: Callable[[str], None]) -> None:
        self._ledger = ledger
        self._webhooks = webhooks
        self._left = left  # the work on a job is over
        self._locks = KeyLocks()

    def run(self, job_id: str, order: dict[str, Any]) -> str:
        """Does what an order says; returns the result as JSON.

        Raises the `CowError` that the job fails with. `Left` where somebody wants it to end: then it has no outcome.
        """
        told = Order.model_validate(order)
        trace = None if told.traceparent is None else parse_traceparent(told.traceparent)
        try:
            with (
                bound(request=told.request_id, job=job_id, trace_context=trace),
                tracing.span(f"job {told.kind}", parent=told.traceparent, job_id=job_id),
                self._ledger.live.running(job_id) as running,
            ):
                return self._outcome(job_id, told, running)
        finally:
            self._left(job_id)

    def deliver(self, job_id: str, url: str, attempt: int) -> None:
        """Calls a webhook, and sees to another attempt where that failed."""
        # As a step: in a workflow, every question to the database would be one, and its answer kept.
        wait: float | None = DBOS.run_step({"name": "deliver"}, lambda: self._delivered(job_id, url, attempt))
        if wait is not None:
            self._webhooks.attempt(job_id, url, attempt + 1, delay=wait)

    def _delivered(self, job_id: str, url: str, attempt: int) -> float | None:
        """Seconds until another attempt is to follow, where one is."""
        for _ in range(WAITS):
            found = reports.find(job_id, self._ledger.live)
            if found is None:
                return None  # deleted: there is nothing to tell any more
            if found.ended is not None:
                return self._webhooks.send(found.job, url, attempt)
            time.sleep(WAIT)
        return self._webhooks.wait_after(job_id, attempt, "the job had not ended")  # a crash came between

    def _outcome(self, job_id: str, order: Order, running: Running) -> str:
        metrics = self._ledger.service.metrics
        try:
            result = self._result(job_id, order, running)
        except Canceled as error:
            raise Left from error
        except CowError as error:
            log.info("job %s failed: %s", job_id, error.code)  # its detail may hold what was asked
            metrics.job(order.kind, "failed")
            self._webhooks.job_ended(job_id, order.webhook)
            raise
        except Exception as error:
            log.exception("job %s failed", job_id)
            metrics.job(order.kind, "failed")
            self._webhooks.job_ended(job_id, order.webhook)
            raise InternalError("The server met an error that it did not foresee; its log has the trace.") from error
        for stage, seconds in result.timings.items():
            if stage not in result.reused:
                metrics.stage(stage, seconds)
        metrics.job(order.kind, "succeeded")
        self._webhooks.job_ended(job_id, order.webhook)
        return result.model_dump_json()

    def _result(self, job_id: str, order: Order, running: Running) -> Simulation | Answer:
        ledger = self._ledger

        def progress(stage: Stage | None, done: float) -> None:
            ledger.live.progress(job_id, running, stage, done)

        step = StoredStep(
            job_id=job_id,
            fresh=order.fresh,
            database=ledger.database,
            artifacts=ledger.service.artifacts,
            metrics=ledger.service.metrics,
            locks=self._locks,
            check_canceled=running.check,
        )
        image = ledger.live.image(job_id)
        run = ledger.service.prepare(order.parsed(), progress, image, step, job_id, order.created_at)
        return answer(run) if isinstance(run.request, AnswerRequest) else simulate(run)
