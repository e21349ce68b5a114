"""The life of a job as a stream of events, each with a number that is the same however often it is read.

Numbers follow from what the database keeps: 1 queued, 2 running, then one for each long stage that is done, 100 for
the end. Progress in between has no number: it is not repeated to a client that reconnects.
"""

import asyncio
import contextlib
from collections.abc import AsyncGenerator
from dataclasses import dataclass, replace

from cow_service.errors import JobNotFound
from cow_service.jobs.engine import JobEngine
from cow_service.records import STAGES, TERMINAL, Job, share_done

QUEUED, RUNNING, FIRST_STAGE, END = 1, 2, 3, 100
POLL_SECONDS = 1.0  # another process may run the job


@dataclass(frozen=True)
class JobEvent:
    """One thing that happened to a job; `number` is None for progress."""

    name: str  # queued, running, stage, progress, succeeded, failed, canceled, deleted
    number: int | None
    job: Job | None

    @property
    def data(self) -> str:
        """The job as JSON."""
        return "{}" if self.job is None else self.job.model_dump_json()


async def follow(engine: JobEngine, job_id: str, after: int) -> AsyncGenerator[JobEvent]:
    """The events of a job after a number, until its end; `deleted` where there is none, or none any more.

    Whether the caller may hear of it was found out before: here is no way left to refuse it.
    """
    sent, told = after, (None, 0.0)  # the last number; the last stage, and the progress, which never goes back
    with engine.active.waiting(job_id) as waiter:
        while True:
            waiter.changed.clear()
            job, events = await asyncio.to_thread(state_of, engine, job_id)
            for event in events:
                now = told if event.job is None else (event.job.stage, max(event.job.progress, told[1]))
                is_new = now != told if event.number is None else event.number > sent
                if is_new:
                    sent, told = event.number or sent, now
                    yield replace(event, job=event.job and event.job.model_copy(update={"progress": told[1]}))
            if job is None or job.status in TERMINAL:
                return
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(waiter.changed.wait(), POLL_SECONDS)


def state_of(engine: JobEngine, job_id: str) -> tuple[Job | None, list[JobEvent]]:
    """A job as the database has it, and its events so far."""
    try:
        job = engine.find(job_id, None, full=False).job
    except JobNotFound:
        return None, [JobEvent("deleted", END, None)]
    begun = job.model_copy(
        update={"status": "running", "progress": 0.0, "stage": None, "problem": None, "finished_at": None}
    )
    events = [JobEvent("queued", QUEUED, begun.model_copy(update={"status": "queued"}))]
    finished = engine.database.finished_stages(job.id)
    stages = [stage for stage, traits in STAGES.items() if traits.has_event and stage in finished]
    if job.status == "running" or stages or job.status in ("succeeded", "failed"):
        events.append(JobEvent("running", RUNNING, begun))
    for place, stage in enumerate(stages):
        done = begun.model_copy(update={"stage": stage, "progress": share_done(job.kind, stage, 1.0)})
        events.append(JobEvent("stage", FIRST_STAGE + place, done))
    if job.status in TERMINAL:
        events.append(JobEvent(job.status, END, job))
    if job.status == "running":
        events.append(JobEvent("progress", None, job))
    return job, events
