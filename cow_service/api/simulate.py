"""`POST /simulate`."""

from __future__ import annotations

import asyncio
from threading import Event

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
    errors.WeightsUnavailable,
    errors.CheckpointInvalid,
    errors.GeneratorOutOfMemory,
    errors.StorageUnavailable,
)


def simulate_routes(service: Service) -> APIRouter:
    """The operation, bound to a service. Computation runs in threads, at most `COW_CONCURRENCY` at a time."""
    router = APIRouter()
    limiter = CapacityLimiter(service.settings.concurrency)

    def run(posted: Posted, left: Event) -> str:
        def still_wanted(stage: str, done: float) -> None:
            if left.is_set():
                raise errors.Canceled("The caller went away before the simulation was done.")

        asked, image = check(posted, service)
        # Written here and not by the framework, which would check the record's thousands of numbers once more.
        return service.simulate(asked, still_wanted, image).model_dump_json()

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
        """Finds what moves, reads its motion, computes its trajectory, renders it, and returns everything at once.

        A caller who closes the connection ends the work: a video model stops after the step that it is in.
        """
        posted = await receive(request)
        left = Event()
        watcher = asyncio.create_task(_watch(request, left))
        try:
            body = await to_thread.run_sync(run, posted, left, limiter=limiter, abandon_on_cancel=True)
        finally:
            left.set()  # also when the server stops: the thread is not waited for
            watcher.cancel()
        return Response(body, media_type="application/json")

    return router


async def _watch(request: Request, left: Event) -> None:
    """Sets `left` when the caller has closed the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass  # an empty rest of the body
    left.set()
