"""`GET /jobs`, `GET /jobs/{id}`, its cancellation and deletion."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response
from pydantic import AwareDatetime

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.api.submission import json_response, owner_of
from cow_service.jobs.engine import Engine
from cow_service.jobs.reports import Filters
from cow_service.records import Job, JobKind, JobPage, JobStatus

JobId = Annotated[str, Path(max_length=64, pattern=r"^[A-Za-z0-9-]+$", description="As the job says.")]
GONE = (errors.JobNotFound, errors.InvalidRequest, errors.StorageUnavailable)


def job_routes(engine: Engine) -> APIRouter:
    """The operations, bound to an engine. A caller sees the jobs of its own key alone."""
    router = APIRouter(tags=["jobs"])

    @router.get(
        "/jobs",
        operation_id="jobs",
        summary="Jobs, newest first",
        responses=documented(errors.InvalidRequest, errors.StorageUnavailable),
    )
    def jobs(
        request: Request,
        status: Annotated[list[JobStatus] | None, Query(description="May be repeated.")] = None,
        kind: Annotated[JobKind | None, Query()] = None,
        created_after: Annotated[AwareDatetime | None, Query(description="RFC 3339; included.")] = None,
        created_before: Annotated[AwareDatetime | None, Query(description="RFC 3339; included.")] = None,
        limit: Annotated[int, Query(ge=1, le=500)] = 50,
        cursor: Annotated[
            str | None, Query(max_length=40_000, pattern=r"^[A-Za-z0-9_-]*$", description="`next` of the page before.")
        ] = None,
    ) -> JobPage:
        """Without their results. Jobs that come or go between two pages are neither shown twice nor hide others."""
        filters = Filters(tuple(status or ()), kind, created_after, created_before, limit, cursor)
        return engine.page(owner_of(request), filters)

    @router.get("/jobs/{id}", operation_id="job", summary="A job", response_model=Job, responses=documented(*GONE))
    def job(request: Request, id: JobId) -> Response:
        """How far it is; its result or problem once it has ended."""
        return json_response(engine.find(id, owner_of(request)).as_json())

    @router.post(
        "/jobs/{id}/cancel",
        operation_id="cancel",
        summary="End a job",
        response_model=Job,
        responses=documented(*GONE),
    )
    def cancel(request: Request, id: JobId) -> Response:
        """Whoever works on it stops at the next step. A job that has ended stays as it is."""
        return json_response(engine.cancel(id, owner_of(request)).as_json())

    @router.delete(
        "/jobs/{id}",
        operation_id="delete",
        summary="Delete a job and what only it holds",
        status_code=204,
        responses=documented(*GONE),
    )
    def delete(request: Request, id: JobId) -> None:
        """Ends it first where it has not ended. Its artifacts go unless another job holds them."""
        engine.delete(id, owner_of(request))

    return router
