"""`POST /simulate`."""

from __future__ import annotations

from anyio import CapacityLimiter, to_thread
from fastapi import APIRouter, Request, Response

from cow_service import errors
from cow_service.api.intake import BODY, Posted, check, receive
from cow_service.api.problems import documented
from cow_service.records import Simulation
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
    errors.CannotReadDirection,
    errors.ReaderUnavailable,
    errors.GeneratorUnavailable,
    errors.StorageUnavailable,
)


def simulate_routes(service: Service) -> APIRouter:
    """The operation, bound to a service. Computation runs in threads, at most `COW_CONCURRENCY` at a time."""
    router = APIRouter()
    limiter = CapacityLimiter(service.settings.concurrency)

    def run(posted: Posted) -> str:
        asked, image = check(posted, service)
        # Written here and not by the framework, which would check the record's thousands of numbers once more.
        return service.simulate(asked, image=image).model_dump_json()

    @router.post(
        "/simulate",
        operation_id="simulate",
        response_model=Simulation,
        tags=["simulation"],
        summary="Imagine the future of an image",
        responses=documented(*FAILURES),
        openapi_extra={"requestBody": BODY},
    )
    async def simulate(request: Request) -> Response:
        """Finds what moves, reads its motion, computes its trajectory, renders it, and returns everything at once."""
        posted = await receive(request)
        body = await to_thread.run_sync(run, posted, limiter=limiter)
        return Response(body, media_type="application/json")

    return router
