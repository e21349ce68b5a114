"""`GET /metrics`."""

from __future__ import annotations

from fastapi import APIRouter
from fastapi.responses import PlainTextResponse, Response

from cow_service.observability.metrics import MEDIA_TYPE, Metrics


def metrics_routes(metrics: Metrics) -> APIRouter:
    """The operation, bound to what the service counts."""
    router = APIRouter()

    @router.get(
        "/metrics",
        operation_id="metrics",
        tags=["health"],
        summary="Counters for Prometheus",
        response_class=PlainTextResponse,
    )
    def exposition() -> Response:
        """Requests, stages, jobs, queues, memory of the process and of its GPUs, in Prometheus' text format."""
        return Response(metrics.exposition(), headers={"Content-Type": MEDIA_TYPE})

    return router
