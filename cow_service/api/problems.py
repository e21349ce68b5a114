"""Errors on the wire: RFC 9457 `application/problem+json`, one shape for all."""

from __future__ import annotations

import logging
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import ValidationError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from cow_service.errors import (
    CowError,
    InternalError,
    InvalidRequest,
    MalformedBody,
    MethodNotAllowed,
    NotFound,
    shortened,
    unforeseen,
)
from cow_service.requests.values import SHOWN_CHARACTERS, field_errors

MEDIA_TYPE = "application/problem+json"

log = logging.getLogger("cow_service")


def invalid(
    error: ValidationError | RequestValidationError, placed: Callable[[str], str] = lambda pointer: pointer
) -> InvalidRequest:
    """A pydantic error as ours, with a JSON Pointer per field; `placed` says where that stands in the request."""
    if any(item["type"] in ("json_invalid", "model_type") and not item["loc"] for item in error.errors()):
        return MalformedBody(f"The body is no JSON object: {error.errors()[0]['msg']}.")
    fields = field_errors(error.errors(), placed)
    summary = "; ".join(f"{field.pointer or 'the body'}: {field.detail}" for field in fields[:5])
    return InvalidRequest(f"{summary}. See /openapi.json for what the request may hold.", errors=fields)


def respond(error: CowError) -> JSONResponse:
    """The HTTP response for an error."""
    headers = {"Retry-After": "5"} if error.status == HTTPStatus.SERVICE_UNAVAILABLE else {}
    return JSONResponse(error.as_problem(), error.status, headers=headers | error.headers, media_type=MEDIA_TYPE)


def install_problem_handlers(app: FastAPI) -> None:
    """Makes every error of the app a problem, those of the framework and unforeseen ones included."""

    async def cow_error(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, CowError)
        return respond(error)

    async def framework_error(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, HTTPException)
        response = respond(_translated(error, request))
        response.headers.update(error.headers or {})
        if response.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
            response.headers["Allow"] = ", ".join(sorted(_methods(request)))
        return response

    async def validation_error(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        return respond(invalid(error))

    async def any_other(request: Request, error: Exception) -> JSONResponse:
        log.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return respond(unforeseen())

    async def gone(request: Request, _: Exception) -> Response:
        log.info("%s %s: the caller left before its body was in", request.method, request.url.path)
        return Response(status_code=HTTPStatus.BAD_REQUEST)

    app.add_exception_handler(ClientDisconnect, gone)
    app.add_exception_handler(CowError, cow_error)
    app.add_exception_handler(HTTPException, framework_error)
    app.add_exception_handler(RequestValidationError, validation_error)
    app.add_exception_handler(Exception, any_other)


def documented(*errors: type[CowError]) -> dict[int | str, dict[str, Any]]:
    """The `responses` of an operation that can fail in these ways, for the OpenAPI document."""
    by_status: dict[int | str, dict[str, Any]] = {}
    for status in sorted({error.status for error in errors}):
        codes = sorted(error.code for error in errors if error.status == status)
        by_status[status] = {
            "description": ", ".join(f"`{code}`" for code in codes),
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
    return by_status


def _translated(error: HTTPException, request: Request) -> CowError:
    if error.status_code == HTTPStatus.NOT_FOUND:
        return NotFound(f"Nothing is served at {_path(request)}. GET /openapi.json lists what is.")
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        return MethodNotAllowed(f"{_path(request)} does not take {request.method}.")
    if HTTPStatus.BAD_REQUEST <= error.status_code < HTTPStatus.INTERNAL_SERVER_ERROR:
        return MalformedBody(f"{error.detail}.")
    return InternalError(f"{error.detail}.")


def _methods(request: Request) -> set[str]:
    """What the address takes: several routes may have it, of which the framework names the first one's methods."""
    routers = (getattr(each, "original_router", None) for each in request.app.routes)
    routes = [*request.app.routes, *(route for router in routers if router is not None for route in router.routes)]
    fitting = (route for route in routes if route.matches(request.scope)[0] is not Match.NONE)
    return {method for route in fitting for method in getattr(route, "methods", None) or ()}


def _path(request: Request) -> str:
    return shortened(request.url.path, SHOWN_CHARACTERS)
