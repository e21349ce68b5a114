"""A chat completion as server-sent events: progress while the job runs, then the answer."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from contextlib import aclosing, suppress

from anyio import to_thread
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.types import Message

from cow_service.api.openai.errors import chat_problem
from cow_service.api.openai.parsing import ParsedChat
from cow_service.api.openai.replies import ChatAnswer, Chunks
from cow_service.api.routes.jobs import PING_SECONDS
from cow_service.api.submission import Submission, Submitter
from cow_service.errors import CowError
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.events import QUEUED, follow
from cow_service.records import TERMINAL, Job, Problem

MIN_PROGRESS_SECONDS = 0.25  # between two chunks of progress
CLOSING_SECONDS = 2.0  # for the last event of a stream, after the grace period of a server that stops
DONE = "[DONE]"


def stream(
    submitter: Submitter, submission: Submission, chat: ParsedChat, created_at: str | None
) -> EventSourceResponse:
    """Streams the job of a chat. A caller who disconnects cancels it by the same rule as for a whole answer."""

    async def disconnected(_: Message) -> None:
        with suppress(CowError):
            await submitter.leave(submission, created_at)

    return EventSourceResponse(
        _events(submitter, submission, chat, created_at),
        ping=PING_SECONDS,
        sep="\n",
        headers={"Cache-Control": "no-store"},
        client_close_handler_callable=disconnected,
        # Else the stream would end early and look complete.
        shutdown_grace_period=submitter.engine.service.settings.shutdown_grace + CLOSING_SECONDS,
    )


async def _events(
    submitter: Submitter, submission: Submission, chat: ParsedChat, created_at: str | None
) -> AsyncGenerator[ServerSentEvent]:
    """The events of a stream; the last may be the problem with which the job failed."""
    try:
        async with aclosing(_chunks(submitter, submission, chat, created_at)) as chunks:
            async for chunk in chunks:
                yield ServerSentEvent(chunk, sep="\n")
    except CowError as error:
        problem = Problem(**chat.pointers.translate_error(error).as_problem())
        yield ServerSentEvent(chat_problem(problem).model_dump_json(), sep="\n")


async def _chunks(
    submitter: Submitter, submission: Submission, chat: ParsedChat, created_at: str | None
) -> AsyncGenerator[str]:
    engine = submitter.engine
    job = (await to_thread.run_sync(lambda: engine.find(submission.job_id, submission.owner, full=False))).job
    chunks = Chunks(job.id, job.created_at, chat.model)
    last = chunks.progress(job)
    yield chunks.first(job)
    updates: asyncio.Queue[Job | None] = asyncio.Queue()

    def over(task: asyncio.Future[str | None]) -> None:
        if not task.cancelled():
            task.exception()  # else asyncio logs it as never retrieved where the caller has disconnected
        updates.put_nowait(None)

    with engine.active.waiting(job.id) as waiter:
        listening = asyncio.ensure_future(_listen(engine, submission, updates))
        gone = asyncio.Event()  # never set: the response itself notices that the caller has disconnected
        ending = asyncio.ensure_future(submitter.outcome(submission, waiter, created_at, gone, may_have_ended=True))
        ending.add_done_callback(over)
        try:
            while (job := await _newest(updates)) is not None:
                if (chunk := chunks.progress(job)) != last:
                    last = chunk
                    yield chunk
                await asyncio.wait({ending}, timeout=MIN_PROGRESS_SECONDS)
            result = await ending
        finally:
            listening.cancel()
            ending.cancel()
    assert result is not None, "it waits as long as it takes"
    for chunk in await to_thread.run_sync(lambda: chunks.answer(ChatAnswer.parse(chat, result))):
        yield chunk
    yield DONE


async def _listen(engine: JobEngine, submission: Submission, updates: asyncio.Queue[Job | None]) -> None:
    """Puts progress into the queue, until the end of the job."""
    with suppress(CowError):
        async with aclosing(follow(engine, submission.job_id, submission.owner, QUEUED)) as events:
            async for event in events:
                if event.job is not None and event.job.status not in TERMINAL:
                    updates.put_nowait(event.job)


async def _newest(updates: asyncio.Queue[Job | None]) -> Job | None:
    """The latest update; None once the job has ended."""
    news = [await updates.get()]
    while not updates.empty():
        news.append(updates.get_nowait())
    return None if None in news else news[-1]
