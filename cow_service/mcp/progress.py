"""A job for one call of a tool: waited for, told of as it goes on, ended where the call is."""

from __future__ import annotations

import math
import secrets
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any, TypeAlias, cast

import anyio
from anyio.streams.memory import MemoryObjectReceiveStream

from cow_service.client import AsyncAnswer, AsyncClient, AsyncJobHandle, AsyncSimulation, CowError, ImageLike
from cow_service.client.progress import describe
from cow_service.mcp.inputs import ToolName
from cow_service.records import Job

Report: TypeAlias = Callable[[float, str], Awaitable[None]]  # how much of 1 is done, and what is being done
LEAST_STEP = 1e-4  # the protocol wants progress that grows, and a stage may begin without any
TO_CANCEL = 5.0  # seconds to tell the server that nobody waits any more


async def result_of(
    client: AsyncClient, tool: ToolName, image: ImageLike, question: str, options: dict[str, Any], report: Report
) -> AsyncSimulation | AsyncAnswer:
    """The result of a job of its own. Raises what it failed with. A call that is canceled cancels its job."""
    handle: AsyncJobHandle[AsyncSimulation | AsyncAnswer] | None = None
    key = secrets.token_urlsafe(18)

    async def submitted() -> AsyncJobHandle[AsyncSimulation | AsyncAnswer]:
        kind: Any = tool
        job = await client.submit(image, question, kind=kind, idempotency_key=key, **options)
        return cast("AsyncJobHandle[AsyncSimulation | AsyncAnswer]", job)

    try:
        handle = await submitted()
        return await _waited(handle, report)
    except anyio.get_cancelled_exc_class():
        # Within the shield: a canceled scope would end this await, too.
        with anyio.move_on_after(TO_CANCEL, shield=True), suppress(CowError):
            # The same key comes to the same job, where the response that names it had not arrived yet.
            await (handle or await submitted()).cancel()
        raise


async def _waited(
    handle: AsyncJobHandle[AsyncSimulation | AsyncAnswer], report: Report
) -> AsyncSimulation | AsyncAnswer:
    outcome: AsyncSimulation | AsyncAnswer | CowError | None = None
    heard, told = anyio.create_memory_object_stream[Job](math.inf)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_told, told, report)
        with heard:
            try:
                outcome = await handle.wait(progress=heard.send_nowait)
            except CowError as error:  # let out below: the group would wrap it
                outcome = error
    if isinstance(outcome, CowError):
        raise outcome
    assert outcome is not None
    return outcome


async def _told(jobs: MemoryObjectReceiveStream[Job], report: Report) -> None:
    done, doing = -LEAST_STEP, ""
    with jobs:
        async for job in jobs:
            now = describe(job)
            if job.progress > done or now != doing:
                done, doing = max(job.progress, done + LEAST_STEP), now
                await report(done, doing)
