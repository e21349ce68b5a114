"""Errors on the wire: RFC 9457 `application/problem+json`, one shape for all."""

import logging
import math
import re
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import Field, ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match
from starlette.types import Scope

from cow_service import errors
from cow_service.records import Problem, Record
from cow_service.requests import field_errors

MEDIA_TYPE = "application/problem+json"
OPENAI_ROOT = "/v1/"  # of the paths of operations that OpenAI's clients call
OPENAI_TYPES = {
    HTTPStatus.UNAUTHORIZED: "authentication_error",
    HTTPStatus.FORBIDDEN: "permission_error",
    HTTPStatus.TOO_MANY_REQUESTS: "rate_limit_error",
}

log = logging.getLogger("cow_service")


def invalid(
    error: ValidationError | RequestValidationError, placed: Callable[[str], str] = lambda pointer: pointer
) -> errors.InvalidRequest:
    """A pydantic error as ours, with a JSON Pointer per field; `placed` says where that stands in the request."""
    found = error.errors()
    if any(item["type"] in ("json_invalid", "model_type") and not item["loc"] for item in found):
        return errors.MalformedBody(f"The body is not a JSON object: {found[0]['msg']}.")
    fields = field_errors(found, placed)
    summary = "; ".join(f"{field.pointer or 'the body'}: {field.detail}" for field in fields[:5])
    return errors.InvalidRequest(f"{summary}. /openapi.json describes the request.", errors=fields)


class ChatError(Record):
    """An error as OpenAI's clients read it."""

    message: str = Field(description="`detail` of the problem.")
    type: str
    param: str | None = Field(description="The first invalid field.")
    code: str = Field(description="The last segment of the problem's `type`.")


class ChatProblem(Problem):
    """Why a request under `/v1` failed: a problem (RFC 9457), and the same as OpenAI's clients read it."""

    error: ChatError


def openai_error(error: errors.CowError) -> dict[str, Any]:
    """An error as OpenAI's clients read it: a `ChatError`. Where the MLLM refused a call, as it did."""
    status = openai_status(error)
    other = "server_error" if status >= HTTPStatus.INTERNAL_SERVER_ERROR else "invalid_request_error"
    param = None
    if error.errors:  # a JSON Pointer as OpenAI writes places: messages[0].content
        steps = [step.replace("~1", "/").replace("~0", "~") for step in error.errors[0].pointer.split("/")[1:]]
        param = "".join(f"[{step}]" if re.fullmatch("[0-9]+", step) else f".{step}" for step in steps).lstrip(".")
    return {
        "message": str(error) if error.refusal is None else error.refusal["message"],
        "type": OPENAI_TYPES.get(HTTPStatus(status), other),
        "param": param or None,
        "code": error.code,
    }


def openai_status(error: errors.CowError) -> int:
    """The status of an error for OpenAI's clients: the MLLM's own, where it refused a call."""
    return error.status if error.refusal is None else error.refusal["status"]


def chat_problem(error: errors.CowError) -> dict[str, Any]:
    """An error as `ChatProblem`."""
    return error.as_problem() | {"status": openai_status(error), "error": openai_error(error)}


def respond(error: errors.CowError, scope: Scope) -> JSONResponse:
    """The HTTP response for an error, which OpenAI's clients, too, can read where the request is one of theirs."""
    problem = chat_problem(error) if scope["path"].startswith(OPENAI_ROOT) else error.as_problem()
    headers = {"Retry-After": "5"} if error.status == HTTPStatus.SERVICE_UNAVAILABLE else {}
    if error.refusal is not None and (seconds := error.refusal.get("retry_after")) is not None:
        headers = {"Retry-After": f"{math.ceil(seconds)}"}
    return JSONResponse(problem, problem["status"], headers=headers | error.headers, media_type=MEDIA_TYPE)


def install_problem_handlers(app: FastAPI) -> None:
    """Makes every error of the app a problem, those of the framework and unforeseen ones included."""

    @app.exception_handler(errors.CowError)
    async def cow_error(request: Request, error: errors.CowError) -> Response:
        return respond(error, request.scope)

    @app.exception_handler(RequestValidationError)
    async def validation_error(request: Request, error: RequestValidationError) -> Response:
        return respond(invalid(error), request.scope)

    @app.exception_handler(HTTPException)
    async def framework_error(request: Request, error: HTTPException) -> Response:
        path, status = errors.shortened(request.url.path), error.status_code
        if status == HTTPStatus.NOT_FOUND:
            ours = errors.NotFound(f"Nothing is served at {path}. GET /openapi.json lists the endpoints.")
        elif status == HTTPStatus.METHOD_NOT_ALLOWED:
            ours = errors.MethodNotAllowed(f"{path} does not support {request.method}.")
        else:
            is_theirs = HTTPStatus.BAD_REQUEST <= status < HTTPStatus.INTERNAL_SERVER_ERROR
            ours = (errors.MalformedBody if is_theirs else errors.InternalError)(f"{error.detail}.")
        response = respond(ours, request.scope)
        response.headers.update(error.headers or {})
        if status == HTTPStatus.METHOD_NOT_ALLOWED:
            # Several routes may share the address; the framework names only the methods of the first one.
            routers = (getattr(each, "original_router", None) for each in app.routes)
            routes = [*app.routes, *(route for router in routers if router is not None for route in router.routes)]
            fitting = (route for route in routes if route.matches(request.scope)[0] is not Match.NONE)
            methods = {method for route in fitting for method in getattr(route, "methods", None) or ()}
            response.headers["Allow"] = ", ".join(sorted(methods))
        return response

    @app.exception_handler(ClientDisconnect)
    async def gone(request: Request, error: ClientDisconnect) -> Response:
        log.info("%s %s: the caller disconnected before its body was complete", request.method, request.url.path)
        return Response(status_code=HTTPStatus.BAD_REQUEST)

    @app.exception_handler(Exception)
    async def any_other(request: Request, error: Exception) -> Response:
        log.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return respond(errors.unforeseen(), request.scope)


def documented(*errors: type[errors.CowError]) -> dict[int | str, dict[str, Any]]:
    """The `responses` of an operation that can fail in these ways, for the OpenAPI document."""
    by_status: dict[int | str, dict[str, Any]] = {}
    for status in sorted({error.status for error in errors}):
        codes = sorted(error.code for error in errors if error.status == status)
        by_status[status] = {
            "description": ", ".join(f"`{code}`" for code in codes),
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
    return by_status
