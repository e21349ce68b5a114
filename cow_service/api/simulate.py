"""`POST /simulate`."""

from __future__ import annotations

from anyio import CapacityLimiter
from fastapi import APIRouter, Request, Response

from cow_service import errors
from cow_service.api.intake import body_of
from cow_service.api.problems import documented
from cow_service.api.running import run
from cow_service.records import Simulation
from cow_service.requests import SimulateRequest
from cow_service.service import Service

FAILURES = (
    errors.MalformedBody,
    errors.InvalidRequest,
    errors.ArtifactNotFound,
    errors.BodyTooLarge,
    errors.BodyTypeUnsupported,
    errors.ImageTooLarge,
    errors.ImageUnreadable,
    errors.ImageTypeUnsupported,
    errors.ImageUrlNotAllowed,
    errors.CannotGround,
    errors.ObjectNotFound,
    errors.CannotReadDirection,
    errors.ReaderUnavailable,
    errors.MllmBadReply,
    errors.MllmUnavailable,
    errors.GeneratorUnavailable,
    errors.WeightsUnavailable,
    errors.CheckpointInvalid,
    errors.GeneratorOutOfMemory,
    errors.StorageUnavailable,
)


def simulate_routes(service: Service, limiter: CapacityLimiter) -> APIRouter:
    """The operation, bound to a service. It runs in threads, as many at a time as `limiter` lets."""
    router = APIRouter()

    @router.post(
        "/simulate",
        operation_id="simulate",
        response_model=Simulation,
        tags=["simulation"],
        summary="Imagine the future of an image",
        responses=documented(*FAILURES),
        openapi_extra={"requestBody": body_of(SimulateRequest)},
    )
    async def simulate(request: Request) -> Response:
        """Finds what moves, reads its motion, computes its trajectory, renders it, and returns everything at once.

        A caller who closes the connection ends the work: a video model stops after the step that it is in.
        """
        return await run(request, SimulateRequest, service.simulate, service, limiter)

    return router
