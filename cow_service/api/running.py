"""Runs what a request asks for in a thread, at most so many at a time, and ends it when the caller has gone."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from threading import Event

from anyio import CapacityLimiter, to_thread
from fastapi import Request, Response
from pydantic import BaseModel

from cow_service.api.intake import Body, Posted, check, receive
from cow_service.errors import Canceled
from cow_service.images import DecodedImage
from cow_service.pipeline import Progress
from cow_service.service import Service

Work = Callable[[Body, Progress, DecodedImage | None], BaseModel]


async def run(
    request: Request, model: type[Body], work: Work[Body], service: Service, limiter: CapacityLimiter
) -> Response:
    """The result of `work` as JSON. The body is checked in the thread, too: it may hold a large image."""
    posted = await receive(request)
    left = Event()
    watcher = asyncio.create_task(_watch(request, left))
    try:
        body = await to_thread.run_sync(
            _run, posted, model, work, service, left, limiter=limiter, abandon_on_cancel=True
        )
    finally:
        left.set()  # also when the server stops: the thread is not waited for
        watcher.cancel()
    return Response(body, media_type="application/json")


def _run(posted: Posted, model: type[Body], work: Work[Body], service: Service, left: Event) -> str:
    def still_wanted(stage: str, done: float) -> None:
        if left.is_set():
            raise Canceled("The caller went away before the work was done.")

    asked, image = check(posted, model, service)
    # Written here and not by the framework, which would check the record's thousands of numbers once more.
    return work(asked, still_wanted, image).model_dump_json()


async def _watch(request: Request, left: Event) -> None:
    """Sets `left` when the caller has closed the connection."""
    while (await request.receive())["type"] != "http.disconnect":
        pass  # an empty rest of the body
    left.set()
