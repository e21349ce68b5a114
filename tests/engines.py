"""One running engine for all tests of this process: DBOS is one per process, and starting it for each test is slow."""

from __future__ import annotations

import atexit
import tempfile
import time
from functools import cache
from pathlib import Path

from conftest import SLOWNESS
from fastapi import FastAPI
from job_rows import open_jobs

from cow_service.api.app import create_app
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.webhooks import Webhooks
from cow_service.observability.metrics import Metrics
from cow_service.service import Service
from cow_service.settings import Settings

FRESH = {"Cache-Control": "no-cache"}  # for requests that must not find what another test came to


@cache
def running_engine() -> JobEngine:
    """The engine, with a database of its own."""
    folder = tempfile.TemporaryDirectory(prefix="cow-tests-")
    engine = JobEngine(Service(Settings(data_dir=Path(folder.name), shutdown_grace=0)))
    engine.start()

    def end() -> None:
        engine.close()
        folder.cleanup()

    atexit.register(end)
    return engine


def app_for(service: Service) -> FastAPI:
    """An application whose jobs are this service's from now on. Only one service is at work at a time."""
    engine = running_engine()
    end_jobs(engine)
    if engine.service is not service:
        engine.service.close()  # its connections to an MLLM
    engine._parts.service = service
    use_webhooks(engine.webhooks, service.settings, service.metrics)
    return create_app(engine, closing=False)


def use_webhooks(webhooks: Webhooks, settings: Settings, metrics: Metrics) -> None:
    """Signs with the secret of other settings, and counts elsewhere."""
    webhooks._secret, webhooks._metrics = settings.webhook_secret, metrics


def end_jobs(engine: JobEngine, seconds: float = 30.0 * SLOWNESS) -> None:
    """Cancels the jobs that an earlier test left behind, and waits until nobody works on them.

    Else they would go on with the next test's service, and ask its multimodal LLM about another image.
    """
    until = time.monotonic() + seconds
    while (left := open_jobs(engine.database)) or engine.active.runs():
        for job_id in left:
            engine.cancel(job_id, None)
        assert time.monotonic() < until, "the work on an earlier test's job does not end"
        time.sleep(0.01)
