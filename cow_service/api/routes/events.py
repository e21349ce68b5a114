"""`GET /jobs/{id}/events`: the life of a job as server-sent events."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from typing import Annotated, Any

from anyio import to_thread
from fastapi import APIRouter, Header, Request, Response
from sse_starlette import EventSourceResponse, ServerSentEvent

from cow_service.api.problems import documented
from cow_service.api.routes.jobs import GONE, JobId
from cow_service.api.submission import owner_of
from cow_service.jobs.engine import Engine
from cow_service.jobs.events import END, follow
from cow_service.records import TERMINAL

PING = 15  # seconds between comments that keep the connection open

EVENT: dict[str, Any] = {
    "type": "object",
    "required": ["event", "data"],
    "properties": {
        "event": {
            "enum": ["queued", "running", "stage", "progress", "succeeded", "failed", "canceled", "deleted"],
        },
        "id": {"type": "string", "description": "Not of `progress`."},
        "data": {"type": "string", "contentMediaType": "application/json", "description": "A `Job`, or `{}`."},
    },
}


def event_routes(engine: Engine) -> APIRouter:
    """The operation, bound to an engine."""
    router = APIRouter(tags=["jobs"])

    @router.get(
        "/jobs/{id}/events",
        operation_id="events",
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
        request: Request,
        id: JobId,
        last_event_id: Annotated[str | None, Header(description="The id of the last event that was heard.")] = None,
    ) -> Response:
        """Events have ids, the same after a restart of the server; progress has none and is not repeated."""
        owner = owner_of(request)
        found = await to_thread.run_sync(lambda: engine.find(id, owner, full=False))
        heard = last_event_id or ""
        after = int(heard) if heard.isascii() and heard.isdigit() and len(heard) < 10 else 0
        if after >= END and found.job.status in TERMINAL:
            return Response(status_code=204)

        async def told() -> AsyncGenerator[ServerSentEvent]:
            async for event in follow(engine, id, owner, after):
                data = "{}" if event.job is None else event.job.model_dump_json()
                number = None if event.number is None else str(event.number)
                yield ServerSentEvent(data, event=event.name, id=number, sep="\n")

        return EventSourceResponse(told(), ping=PING, sep="\n", headers={"Cache-Control": "no-store"})

    return router
