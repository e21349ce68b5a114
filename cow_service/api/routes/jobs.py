"""`GET /jobs`, `GET /jobs/{id}`, its request and events, cancellation and deletion. Callers see only their own jobs."""

from collections.abc import AsyncGenerator
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Header, Path, Query, Request, Response
from sse_starlette import EventSourceResponse, ServerSentEvent

from cow_service import errors
from cow_service.api.problems import documented
from cow_service.api.routes.simulate import RETURN
from cow_service.api.submission import MINIMAL_APPLIED, Engine, Owner, json_response, minimize, preferences_of
from cow_service.jobs.job_table import JobFilters
from cow_service.jobs.subscriptions import END, follow
from cow_service.records import TERMINAL, AcceptedRequest, Job, JobPage

JobId = Annotated[str, Path(max_length=64, pattern=r"^[A-Za-z0-9-]+$", description="The `id` of a job.")]
GONE = (errors.JobNotFound, errors.InvalidRequest, errors.StorageUnavailable)
PING_SECONDS = 15  # between comments that keep the connection open

EVENT: dict[str, Any] = {
    "type": "object",
    "required": ["event", "data"],
    "properties": {
        "event": {"enum": ["queued", "running", "stage", "progress", "succeeded", "failed", "canceled", "deleted"]},
        "id": {"type": "string", "description": "Not of `progress`."},
        "data": {"type": "string", "contentMediaType": "application/json", "description": "A `Job`, or `{}`."},
    },
}

router = APIRouter(tags=["jobs"])


@router.get(
    "/jobs", summary="Jobs, newest first", responses=documented(errors.InvalidRequest, errors.StorageUnavailable)
)
def jobs(engine: Engine, owner: Owner, filters: Annotated[JobFilters, Query()]) -> JobPage:
    """Without their results. Jobs that come or go between two pages are neither shown twice nor hide others."""
    return engine.page(owner, filters)


@router.get(
    "/jobs/{id}",
    summary="A job",
    response_model=Job,
    responses=documented(*GONE),
    openapi_extra={"parameters": [RETURN]},
)
def job(request: Request, engine: Engine, owner: Owner, id: JobId) -> Response:
    """How far it is; its result or problem once it has ended."""
    found = engine.find(id, owner).as_json()
    if not preferences_of(request.headers).minimal:
        return json_response(found)
    return json_response(minimize(found), headers=MINIMAL_APPLIED)


@router.get("/jobs/{id}/request", summary="The request that became a job", responses=documented(*GONE))
def request_of(engine: Engine, owner: Owner, id: JobId) -> AcceptedRequest:
    """As it was accepted, to be sent again or changed: its image need not be sent with it."""
    return engine.request_of(id, owner)


@router.post("/jobs/{id}/cancel", summary="End a job", response_model=Job, responses=documented(*GONE))
def cancel(engine: Engine, owner: Owner, id: JobId) -> Response:
    """The process that computes it stops at the next step. A job that has ended stays as it is."""
    return json_response(engine.cancel(id, owner).as_json())


@router.delete(
    "/jobs/{id}", summary="Delete a job and what only it holds", status_code=204, responses=documented(*GONE)
)
def delete(engine: Engine, owner: Owner, id: JobId) -> None:
    """Cancels the job first if it has not ended. Its artifacts are removed unless another job uses them."""
    engine.delete(id, owner)


@router.get(
    "/jobs/{id}/events",
    summary="Follow a job",
    response_class=Response,
    responses={
        200: {
            "description": "`queued`, `running`, `stage` (one is done), `progress`, then `succeeded`, `failed`, "
            "`canceled` or `deleted`. The data is the job without its result.",
            "content": {"text/event-stream": {"schema": EVENT}},
        },
        204: {"description": "The job has ended, and the caller has heard of it: no need to come back."},
        **documented(*GONE),
    },
)
async def events(
    engine: Engine,
    owner: Owner,
    id: JobId,
    last_event_id: Annotated[str | None, Header(description="The id of the last event that was heard.")] = None,
) -> Response:
    """Events have ids, the same after a restart of the server; progress has none and is not repeated."""
    found = await to_thread.run_sync(lambda: engine.find(id, owner, full=False))
    seen = last_event_id or ""
    after = int(seen) if seen.isascii() and seen.isdigit() and len(seen) < 10 else 0
    if after >= END and found.job.status in TERMINAL:
        return Response(status_code=204)

    async def stream() -> AsyncGenerator[ServerSentEvent]:
        async for event in follow(engine, id, after):
            number = None if event.number is None else str(event.number)
            yield ServerSentEvent(event.data, event=event.name, id=number, sep="\n")

    return EventSourceResponse(stream(), ping=PING_SECONDS, sep="\n", headers={"Cache-Control": "no-store"})
