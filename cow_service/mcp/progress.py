"""The job of one tool call, with progress reported to the caller."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from typing import Any, TypeAlias

import anyio
from anyio.streams.memory import MemoryObjectReceiveStream

from cow_service.client import AsyncAnswer, AsyncClient, AsyncSimulation, CowError, ImageLike
from cow_service.client.progress import describe
from cow_service.mcp.inputs import ToolName
from cow_service.records import Job

Report: TypeAlias = Callable[[float, str], Awaitable[None]]  # the share that is done, 0 to 1, and the stage
MIN_STEP = 1e-4  # the protocol wants progress that grows, and a stage may begin without any


async def result_of(
    client: AsyncClient, tool: ToolName, image: ImageLike, question: str, options: dict[str, Any], report: Report
) -> AsyncSimulation | AsyncAnswer:
    """The result of a tool's job. Raises what it failed with. A call that is canceled cancels its job."""
    call: Callable[..., Awaitable[AsyncSimulation | AsyncAnswer]]
    call = client.simulate if tool == "simulate" else client.answer
    outcome: AsyncSimulation | AsyncAnswer | CowError | None = None
    updates, updated = anyio.create_memory_object_stream[Job](math.inf)
    async with anyio.create_task_group() as tasks:
        tasks.start_soon(_report_all, updated, report)
        with updates:
            try:
                outcome = await call(image, question, progress=updates.send_nowait, **options)
            except CowError as error:  # raised below: the group would wrap it
                outcome = error
    if isinstance(outcome, CowError):
        raise outcome
    assert outcome is not None
    return outcome


async def _report_all(jobs: MemoryObjectReceiveStream[Job], report: Report) -> None:
    done, stage = -MIN_STEP, ""
    with jobs:
        async for job in jobs:
            now = describe(job)
            if job.progress > done or now != stage:
                done, stage = max(job.progress, done + MIN_STEP), now
                await report(done, stage)
