"""Errors on the wire: RFC 9457 `application/problem+json`, one shape for all."""

from __future__ import annotations

import json
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

from cow_service.errors import (
    CowError,
    FieldError,
    InternalError,
    InvalidRequest,
    MalformedBody,
    MethodNotAllowed,
    NotFound,
    pointer_part,
    shortened,
)

MEDIA_TYPE = "application/problem+json"
SHOWN_CHARACTERS = 80  # of what the caller sent

log = logging.getLogger("cow_service")


def invalid(
    error: ValidationError | RequestValidationError, placed: Callable[[str], str] = lambda pointer: pointer
) -> InvalidRequest:
    """A pydantic error as ours, with a JSON Pointer per field; `placed` says where that stands in the request."""
    fields: dict[str, FieldError] = {}
    if any(item["type"] in ("json_invalid", "model_type") and not item["loc"] for item in error.errors()):
        return MalformedBody(f"The body is no JSON object: {error.errors()[0]['msg']}.")
    for item in error.errors():
        pointer = placed("".join("/" + pointer_part(part) for part in _location(item["loc"])))
        fields.setdefault(pointer, FieldError(pointer, _with_value(str(item["msg"]), item["input"])))
    summary = "; ".join(f"{field.pointer or 'the body'}: {field.detail}" for field in list(fields.values())[:5])
    return InvalidRequest(f"{summary}. See /openapi.json for what the request may hold.", errors=tuple(fields.values()))


def respond(error: CowError) -> JSONResponse:
    """The HTTP response for an error."""
    headers = {"Retry-After": "5"} if error.status == HTTPStatus.SERVICE_UNAVAILABLE else {}
    return JSONResponse(error.as_problem(), error.status, headers=headers | error.headers, media_type=MEDIA_TYPE)


def unforeseen_error() -> InternalError:
    """The error for an exception that no code expects."""
    return InternalError("The server met an error that it did not foresee; its log has the trace.")


def install_problem_handlers(app: FastAPI) -> None:
    """Makes every error of the app a problem, those of the framework and unforeseen ones included."""

    async def cow_error(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, CowError)
        return respond(error)

    async def framework_error(request: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, HTTPException)
        response = respond(_translated(error, request))
        response.headers.update(error.headers or {})
        return response

    async def validation_error(_: Request, error: Exception) -> JSONResponse:
        assert isinstance(error, RequestValidationError)
        return respond(invalid(error))

    async def unforeseen(request: Request, error: Exception) -> JSONResponse:
        log.error("%s %s failed", request.method, request.url.path, exc_info=error)
        return respond(unforeseen_error())

    async def gone(request: Request, _: Exception) -> Response:
        log.info("%s %s: the caller left before its body was in", request.method, request.url.path)
        return Response(status_code=HTTPStatus.BAD_REQUEST)

    app.add_exception_handler(ClientDisconnect, gone)
    app.add_exception_handler(CowError, cow_error)
    app.add_exception_handler(HTTPException, framework_error)
    app.add_exception_handler(RequestValidationError, validation_error)
    app.add_exception_handler(Exception, unforeseen)


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


def _path(request: Request) -> str:
    return shortened(request.url.path, SHOWN_CHARACTERS)


def _with_value(message: str, value: Any) -> str:
    """A validator's message with the value; our own messages name it where it helps."""
    ours = message.removeprefix("Value error, ")
    if ours != message or not isinstance(value, str | int | float):
        return ours
    reason = message.partition(", got ")[0]  # a kind of number, in place of the number
    if isinstance(value, str) and len(value) > SHOWN_CHARACTERS:
        return f"{reason}, got {len(value)} characters"
    return f"{reason}, got {shortened(json.dumps(value), SHOWN_CHARACTERS)}"


def _location(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """A pydantic location without the names of union branches and validators, which callers cannot see."""
    hidden = ("function-", "constrained-", "is-instance")
    shown = [p for p in loc if not (isinstance(p, str) and (p.startswith(hidden) or p in _UNION_BRANCHES))]
    return tuple(shown)


_UNION_BRANCHES = frozenset({"ImageArtifact", "ImageUrl", "str"})
