"""Errors on the wire: RFC 9457 `application/problem+json`, one shape for all."""

from __future__ import annotations

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from pydantic import BaseModel, Field, ValidationError
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
)

TYPE_PREFIX = "urn:cow:problem:"  # a name, not an address: README.md explains every code
MEDIA_TYPE = "application/problem+json"

log = logging.getLogger("cow_service")


class ProblemField(BaseModel):
    """One invalid field."""

    pointer: str = Field(description="JSON Pointer (RFC 6901) into the request.")
    detail: str


class Problem(BaseModel):
    """Why a request failed (RFC 9457)."""

    type: str = Field(description="Stable URI; its last segment is the code.")
    title: str = Field(description="The kind of error, the same for every occurrence.")
    status: int
    detail: str = Field(description="What was wrong, with the value, and what to do.")
    errors: list[ProblemField] = Field(default_factory=list[ProblemField])


def problem_of(error: CowError) -> Problem:
    """The problem that a `CowError` is on the wire."""
    fields = [ProblemField(pointer=field.pointer, detail=field.detail) for field in error.errors]
    return Problem(
        type=TYPE_PREFIX + error.code, title=error.title, status=error.status, detail=error.detail, errors=fields
    )


def invalid(error: ValidationError | RequestValidationError) -> InvalidRequest:
    """A pydantic error as ours, with a JSON Pointer per field."""
    fields: dict[str, FieldError] = {}
    if any(item["type"] in ("json_invalid", "model_type") and not item["loc"] for item in error.errors()):
        return MalformedBody(f"The body is no JSON object: {error.errors()[0]['msg']}.")
    for item in error.errors():
        pointer = "".join("/" + pointer_part(part) for part in _location(item["loc"]))
        fields.setdefault(pointer, FieldError(pointer, str(item["msg"]).removeprefix("Value error, ")))
    told = "; ".join(f"{field.pointer or 'the body'}: {field.detail}" for field in list(fields.values())[:5])
    return InvalidRequest(f"{told}. See /openapi.json for what the request may hold.", errors=tuple(fields.values()))


def respond(error: CowError) -> JSONResponse:
    """The HTTP response for an error."""
    headers = {"Retry-After": "5"} if error.status == HTTPStatus.SERVICE_UNAVAILABLE else {}
    body = problem_of(error).model_dump(mode="json")
    return JSONResponse(body, error.status, headers=headers | error.headers, media_type=MEDIA_TYPE)


def install_problem_handlers(app: FastAPI) -> None:
    """Makes every error of the app a problem, also those of the framework and those that nobody foresaw."""

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
        return respond(InternalError("The server met an error that it did not foresee; its log has the trace."))

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
        return NotFound(f"Nothing is served at {request.url.path}. GET /openapi.json lists what is.")
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        return MethodNotAllowed(f"{request.url.path} does not take {request.method}.")
    if HTTPStatus.BAD_REQUEST <= error.status_code < HTTPStatus.INTERNAL_SERVER_ERROR:
        return MalformedBody(f"{error.detail}.")
    return InternalError(f"{error.detail}.")


def _location(loc: tuple[int | str, ...]) -> tuple[int | str, ...]:
    """A pydantic location without the names of union branches and validators, which callers cannot see."""
    hidden = ("function-", "constrained-", "is-instance")
    shown = [p for p in loc if not (isinstance(p, str) and (p.startswith(hidden) or p in _UNION_BRANCHES))]
    return tuple(shown)


_UNION_BRANCHES = frozenset({"ImageArtifact", "ImageUrl", "str"})
