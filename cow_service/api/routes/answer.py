"""`POST /answer`."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from cow_service.api.body import body_of
from cow_service.api.problems import documented
from cow_service.api.routes.simulate import ACCEPTED, FAILURES, STATED
from cow_service.api.submission import Submitting
from cow_service.records import Answer
from cow_service.requests import AnswerRequest


def answer_routes(submitting: Submitting) -> APIRouter:
    """The operation, bound to an engine."""
    router = APIRouter()

    @router.post(
        "/answer",
        operation_id="answer",
        response_model=Answer,
        tags=["answering"],
        summary="Look, then answer",
        responses={**ACCEPTED, **documented(*FAILURES)},
        openapi_extra={"requestBody": body_of(AnswerRequest), "parameters": STATED},
    )
    async def answer(request: Request) -> Response:
        """Imagines the future of the image, then has the reader answer the question from the image and those frames.

        A simulation that fails does not lose the answer: it is then given from the image alone, and `warnings` says so.
        """
        return await submitting.run(request, "answer", AnswerRequest)

    return router
