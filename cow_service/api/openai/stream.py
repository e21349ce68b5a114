"""A chat completion as server-sent events: progress while the job runs, then the answer."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from contextlib import aclosing, suppress

from anyio import to_thread
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.types import Message

from cow_service.api.openai.errors import chat_problem
from cow_service.api.openai.reading import Chat
from cow_service.api.openai.replies import Chunks, Told
from cow_service.api.routes.events import PING
from cow_service.api.submission import Asked, Submitting
from cow_service.errors import CowError
from cow_service.jobs.engine import Engine
from cow_service.jobs.events import QUEUED, follow
from cow_service.problems import problem_of
from cow_service.records import TERMINAL, Job

GAP = 0.25  # seconds between two chunks of progress, at least
BEYOND = 2.0  # seconds after running jobs had their time, when the server stops: to say so
DONE = "[DONE]"


def stream(submitting: Submitting, asked: Asked, chat: Chat, is_new: bool) -> EventSourceResponse:
    """Streams the job of a chat. A caller who leaves ends it by the same rule as one who waits for the whole answer."""

    async def left(_: Message) -> None:
        with suppress(CowError):
            await submitting.leave(asked, is_new)

    return EventSourceResponse(
        _events(submitting, asked, chat),
        ping=PING,
        sep="\n",
        headers={"Cache-Control": "no-store"},
        client_close_handler_callable=left,
        # Else the stream would end without a word, and look like one that is whole.
        shutdown_grace_period=submitting.engine.service.settings.shutdown_grace + BEYOND,
    )


async def _events(submitting: Submitting, asked: Asked, chat: Chat) -> AsyncGenerator[ServerSentEvent]:
    """The events of a stream; what the job fails with is the last."""
    try:
        async with aclosing(_chunks(submitting, asked, chat)) as chunks:
            async for chunk in chunks:
                yield ServerSentEvent(chunk, sep="\n")
    except CowError as error:
        yield ServerSentEvent(chat_problem(problem_of(chat.places.moved(error))).model_dump_json(), sep="\n")


async def _chunks(submitting: Submitting, asked: Asked, chat: Chat) -> AsyncGenerator[str]:
    engine = submitting.engine
    job = (await to_thread.run_sync(lambda: engine.find(asked.job_id, asked.owner, full=False))).job
    chunks = Chunks(job.id, job.created_at, chat.model)
    last = chunks.progress(job)
    yield chunks.first(job)
    heard: asyncio.Queue[Job | None] = asyncio.Queue()

    def over(task: asyncio.Future[str | None]) -> None:
        if not task.cancelled():
            task.exception()  # else asyncio logs it as forgotten where the caller has left meanwhile
        heard.put_nowait(None)

    with engine.live.waiting(job.id) as waiting:
        listening = asyncio.ensure_future(_listen(engine, asked, heard))
        # It may have ended before anybody waited: so it counts as one that is not new.
        ending = asyncio.ensure_future(submitting.outcome(asked, waiting, is_new=False, left=asyncio.Event()))
        ending.add_done_callback(over)
        try:
            while (news := await _newest(heard)) is not None:
                if (chunk := chunks.progress(news)) != last:
                    last = chunk
                    yield chunk
                await asyncio.wait({ending}, timeout=GAP)
            result = await ending
        finally:
            listening.cancel()
            ending.cancel()
    assert result is not None, "it waits as long as it takes"
    for chunk in await to_thread.run_sync(lambda: chunks.answer(Told.of(chat, result))):
        yield chunk
    yield DONE


async def _listen(engine: Engine, asked: Asked, heard: asyncio.Queue[Job | None]) -> None:
    """Passes on how far a job is, until the end. How it ends is told by its outcome."""
    with suppress(CowError):
        async with aclosing(follow(engine, asked.job_id, asked.owner, QUEUED)) as events:
            async for event in events:
                if event.job is not None and event.job.status not in TERMINAL:
                    heard.put_nowait(event.job)


async def _newest(heard: asyncio.Queue[Job | None]) -> Job | None:
    """The last that was heard; None once the job has ended."""
    news = [await heard.get()]
    while not heard.empty():
        news.append(heard.get_nowait())
    return None if None in news else news[-1]
