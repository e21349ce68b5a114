"""`POST /answer`."""

from __future__ import annotations

from anyio import CapacityLimiter
from fastapi import APIRouter, Request, Response

from cow_service.api.intake import body_of
from cow_service.api.problems import documented
from cow_service.api.running import run
from cow_service.api.simulate import FAILURES
from cow_service.records import Answer
from cow_service.requests import AnswerRequest
from cow_service.service import Service


def answer_routes(service: Service, limiter: CapacityLimiter) -> APIRouter:
    """The operation, bound to a service. It shares its threads with the simulations."""
    router = APIRouter()

    @router.post(
        "/answer",
        operation_id="answer",
        response_model=Answer,
        tags=["answering"],
        summary="Look, then answer",
        responses=documented(*FAILURES),
        openapi_extra={"requestBody": body_of(AnswerRequest)},
    )
    async def answer(request: Request) -> Response:
        """Imagines the future of the image, then has the reader answer the question from the image and those frames.

        A simulation that fails does not lose the answer: it is then given from the image alone, and `warnings` says so.
        """
        return await run(request, AnswerRequest, service.answer, service, limiter)

    return router
