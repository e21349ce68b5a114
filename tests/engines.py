"""Applications without a server: their job engine runs in this process. One of them is at work at a time."""

from __future__ import annotations

import atexit
from contextlib import suppress

from fastapi import FastAPI
from job_rows import open_jobs
from waiting import eventually

from cow_service.api.app import create_app
from cow_service.errors import StorageUnavailable
from cow_service.jobs.engine import JobEngine
from cow_service.service import Service

FRESH = {"Cache-Control": "no-cache"}  # for requests that must not find what another test came to

_running: list[JobEngine] = []  # the one that is at work, if there is one


def app_for(service: Service) -> FastAPI:
    """An application whose jobs are this service's. The one of another service ends, with its jobs."""
    if _running and running_engine().service is service:
        _end_jobs(running_engine())
    else:
        end_engine()
        _running.append(JobEngine(service))
        with suppress(StorageUnavailable):  # its application says so
            running_engine().start()
    return create_app(running_engine(), closing=False)


def running_engine() -> JobEngine:
    """The engine of the last application."""
    return _running[0]


@atexit.register
def end_engine() -> None:
    """Ends the engine that is at work, and closes its service."""
    if _running:
        engine = _running.pop()
        if engine.is_running:
            _end_jobs(engine)
            engine.close()
        engine.service.close()


def _end_jobs(engine: JobEngine) -> None:
    """Cancels the jobs that an earlier test left behind, and waits until no thread works on them.

    Else they would go on, and ask the next test's multimodal LLM about another image.
    """

    def ended() -> bool:
        left = open_jobs(engine.database)
        for job_id in left:
            engine.cancel(job_id, None)
        return not left and not engine.active.runs()

    eventually(ended)
