"""The life of a job as a stream of events, each with a number that is the same however often it is read.

Numbers come from what the database keeps: 1 queued, 2 running, then one for each stage that is done, 100 for the end.
Progress in between is told without a number: it is not repeated to whoever comes back.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncGenerator
from dataclasses import dataclass

from anyio import to_thread

from cow_service.errors import JobNotFound
from cow_service.jobs.engine import Engine
from cow_service.jobs.live import share_done
from cow_service.jobs.reports import Found
from cow_service.records import TERMINAL, Job

TOLD = ("grounding", "generation", "answering")  # stages whose end is an event; the others take milliseconds
QUEUED, RUNNING, FIRST_STAGE, END = 1, 2, 3, 100
LOOK = 1.0  # seconds between looks at the database: another process may run the job


@dataclass(frozen=True)
class Event:
    """One thing that happened to a job; `number` is None for progress."""

    name: str  # queued, running, stage, progress, succeeded, failed, canceled, deleted
    number: int | None
    job: Job | None


async def follow(engine: Engine, job_id: str, owner: str | None, after: int) -> AsyncGenerator[Event]:
    """The events of a job after a number, until its end. Raises `JobNotFound` where there is none to begin with."""
    found = await to_thread.run_sync(engine.find, job_id, owner)
    sent, told = after, (None, 0.0)
    with engine.live.waiting(job_id) as waiting:
        while True:
            waiting.changed.clear()
            for event in await to_thread.run_sync(_durable, engine, found):
                if event.number is not None and event.number > sent:
                    sent = event.number
                    yield event
            if found.job.status in TERMINAL:
                return
            now = (found.job.stage, found.job.progress)
            if now != told and found.job.status == "running":
                told = now
                yield Event("progress", None, found.job)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(waiting.changed.wait(), LOOK)
            try:
                found = await to_thread.run_sync(engine.find, job_id, owner)
            except JobNotFound:
                yield Event("deleted", END, None)
                return


def _durable(engine: Engine, found: Found) -> list[Event]:
    """What has happened to a job so far, by number."""
    job = found.job
    begun = job.model_copy(
        update={"status": "running", "progress": 0.0, "stage": None, "problem": None, "finished_at": None}
    )
    events = [Event("queued", QUEUED, begun.model_copy(update={"status": "queued"}))]
    done = engine.database.finished_stages(job.id)
    stages = [stage for stage in TOLD if stage in done]
    if job.status == "running" or stages or job.status in ("succeeded", "failed"):
        events.append(Event("running", RUNNING, begun))
    for place, stage in enumerate(stages):
        at_end = begun.model_copy(update={"stage": stage, "progress": share_done(job.kind, stage, 1.0)})
        events.append(Event("stage", FIRST_STAGE + place, at_end))
    if job.status in TERMINAL:
        events.append(Event(job.status, END, job))
    return events
