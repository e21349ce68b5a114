"""`GET /livez`, `GET /readyz`, `GET /models` and `GET /metrics`."""

from __future__ import annotations

from typing import Literal

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse, Response
from pydantic import BaseModel

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.readiness import Readiness
from cow_service.observability.metrics import MEDIA_TYPE
from cow_service.records import Models


class Health(BaseModel):
    """A probe's answer."""

    status: Literal["ok"] = "ok"


def health_routes(engine: JobEngine, readiness: Readiness) -> APIRouter:
    """Probes, backends and metrics, bound to an engine and what it needs."""
    router = APIRouter()

    @router.get("/livez", operation_id="livez", tags=["health"], summary="The process answers")
    async def livez() -> Health:
        """For restarts: says nothing about whether work can be done."""
        return Health()

    @router.get(
        "/readyz",
        operation_id="readyz",
        tags=["health"],
        summary="The default request can be served",
        responses=documented(
            errors.NotReady,
            errors.ShuttingDown,
            errors.StorageUnavailable,
            errors.ReaderUnavailable,
            errors.GeneratorUnavailable,
        ),
    )
    def readyz() -> Health:
        """Checks that the database answers, that the data folder can be written and has room, and that the default
        reader and generator are loaded.
        """
        readiness.check()
        engine.check()
        return Health()

    @router.get("/models", operation_id="models", tags=["models"], summary="Readers and generators")
    def models() -> Models:
        """What each is, what it needs, and whether it is ready."""
        return engine.service.models()

    @router.get(
        "/metrics",
        operation_id="metrics",
        tags=["health"],
        summary="Counters for Prometheus",
        response_class=PlainTextResponse,
    )
    def metrics() -> Response:
        """Requests, stages, jobs, queues, memory of the process and of its GPUs, in Prometheus' text format."""
        return Response(engine.service.metrics.exposition(), headers={"Content-Type": MEDIA_TYPE})

    return router
