"""One running engine for all tests of this process: DBOS, which keeps calls of webhooks, is one per process."""

from __future__ import annotations

import atexit
import base64
import tempfile
from functools import cache
from pathlib import Path

from fastapi import FastAPI
from job_rows import open_jobs
from waiting import eventually

from cow_service.api.app import create_app
from cow_service.jobs.calls import Calls
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.webhooks import Webhooks
from cow_service.observability.metrics import Metrics
from cow_service.service import Service
from cow_service.settings import Settings

SECRET = f"whsec_{base64.b64encode(bytes(32)).decode()}"
FRESH = {"Cache-Control": "no-cache"}  # for requests that must not find what another test came to


@cache
def running_engine() -> JobEngine:
    """The engine, with a database of its own."""
    folder = tempfile.TemporaryDirectory(prefix="cow-tests-")
    engine = JobEngine(Service(Settings(data_dir=Path(folder.name), shutdown_grace=0, webhook_secret=SECRET)))
    engine.start()

    calls = engine.calls

    def end() -> None:
        engine.calls = calls  # tests exchange it; only this one ends what was started
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
    use_webhooks(service.settings, service.metrics)
    return create_app(engine, closing=False)


@cache
def webhooks() -> Webhooks:
    """Those that the engine was started with."""
    calls = running_engine().calls
    assert isinstance(calls, Webhooks)
    return calls


def use_webhooks(settings: Settings, metrics: Metrics) -> None:
    """Signs with the secret of other settings, and counts elsewhere; or makes no calls where they have none."""
    hooks, engine = webhooks(), running_engine()
    engine.calls = Calls()
    if settings.webhook_secret is not None:
        hooks._secret, hooks._metrics, engine.calls = settings.webhook_secret, metrics, hooks
    engine.jobs._on_end = engine.calls.enqueue


def end_jobs(engine: JobEngine) -> None:
    """Cancels the jobs that an earlier test left behind, and waits until no process works on them.

    Else they would go on with the next test's service, and ask its multimodal LLM about another image.
    """

    def ended() -> bool:
        left = open_jobs(engine.database)
        for job_id in left:
            engine.cancel(job_id, None)
        return not left and not engine.active.runs()

    eventually(ended)
