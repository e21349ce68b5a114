"""Replies as server-sent events: OpenAI's chunks, progress while a job runs, and a failure as the last event."""

import asyncio
import json
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator
from contextlib import aclosing, suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import Any, cast

from anyio import to_thread
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.types import Message, Receive, Scope, Send

from cow_service.api.openai.chats import EXTENSION, as_json
from cow_service.api.openai.forwarding import DONE, Events
from cow_service.api.openai.records import ChatProgress
from cow_service.api.problems import chat_problem
from cow_service.api.routes.jobs import PING_SECONDS
from cow_service.api.submission import Submission, Submitter, do_nothing
from cow_service.errors import CowError
from cow_service.jobs.subscriptions import POLL_SECONDS
from cow_service.records import TERMINAL, Job
from cow_service.settings import Settings

MIN_PROGRESS_SECONDS = 0.25  # between two chunks of progress
CLOSING_SECONDS = 2.0  # for the last event of a stream, after the grace period of a server that stops
LAST_EVENT = ServerSentEvent(DONE, sep="\n")
HEAD = ("id", "created", "model", "system_fingerprint", "service_tier")  # the same in a completion and its chunks


def event_of(data: dict[str, Any], name: str | None = None) -> ServerSentEvent:
    """A server-sent event that holds a JSON object."""
    return ServerSentEvent(as_json(data), event=name, sep="\n")


def data_of(event: ServerSentEvent) -> dict[str, Any]:
    """The JSON object of a server-sent event; empty for the end."""
    value: Any = None
    with suppress(ValueError):
        value = json.loads(event.data or "")
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}


def head_of(reply: dict[str, Any]) -> dict[str, Any]:
    """What all chunks share with a completion, or with another chunk of the same stream."""
    return {name: reply[name] for name in HEAD if name in reply} | {"object": "chat.completion.chunk"}


def job_head(job_id: str, created_at: str, model: str) -> dict[str, Any]:
    """What a completion and its chunks share where a job makes them."""
    return {
        "id": f"chatcmpl-{job_id}",
        "object": "chat.completion.chunk",
        "created": int(datetime.fromisoformat(created_at).timestamp()),
        "model": model,
    }


def chunk_of(
    head: dict[str, Any], delta: dict[str, Any], finish_reason: Any = None, index: int = 0, **others: Any
) -> dict[str, Any]:
    """A chunk that adds `delta` to the message of one choice."""
    logprobs = others.pop("logprobs", None)
    choice = {"index": index, "delta": delta, "finish_reason": finish_reason, "logprobs": logprobs}
    return head | {"choices": [choice]} | others


def chunks_of(completion: dict[str, Any], *, with_usage: bool) -> Iterator[dict[str, Any]]:
    """The chunks of a whole completion: `cow`, each choice's message, each choice's end, and usage where it is wanted.

    An error is its only chunk.
    """
    if "error" in completion:
        yield {"error": completion["error"]}
        return
    head = head_of(completion)
    if EXTENSION in completion:
        yield chunk_of(head, {}, cow=completion[EXTENSION])
    choices = completion.get("choices")
    for place, each in enumerate(cast("list[Any]", choices) if isinstance(choices, list) else ()):
        choice = cast("dict[str, Any]", each) if isinstance(each, dict) else {}
        index = choice.get("index", place)
        message = {name: value for name, value in (choice.get("message") or {}).items() if value is not None}
        if calls := message.get("tool_calls", ()):
            message["tool_calls"] = [{"index": number, **call} for number, call in enumerate(calls)]
        yield chunk_of(head, message, None, index, logprobs=choice.get("logprobs"))
        yield chunk_of(head, {}, choice.get("finish_reason"), index)
    if with_usage and "usage" in completion:
        yield head | {"choices": [], "usage": completion["usage"]}


def progress_of(job: Job) -> dict[str, Any]:
    """How far a job is: `cow` of a chunk."""
    return ChatProgress(job=job.id, status=job.status, stage=job.stage, progress=job.progress).model_dump()


def progress_chunk(job: Job, head: dict[str, Any], delta: dict[str, Any] | None = None) -> ServerSentEvent:
    """How far a job is, as an event."""
    return event_of(chunk_of(head, delta or {}, cow=progress_of(job)))


@dataclass(frozen=True)
class Streamed:
    """A reply as it is streamed."""

    events: Events
    locate: Callable[[CowError], CowError] = lambda error: error  # an error, pointing into what the caller sent
    leave: Callable[[], Awaitable[None]] = do_nothing  # to be called where the caller has disconnected
    close: Callable[[], Awaitable[None]] = do_nothing  # to be called at the end, however it came


class EventsResponse(EventSourceResponse):
    """Sends the events of a reply. A failure becomes the last event."""

    def __init__(self, streamed: Streamed, settings: Settings) -> None:
        async def disconnected(_: Message) -> None:
            with suppress(CowError):
                await streamed.leave()

        async def events() -> Events:
            try:
                async with aclosing(streamed.events) as own:
                    async for event in own:
                        yield event
            except CowError as error:
                yield event_of(chat_problem(streamed.locate(error)))

        self._close = streamed.close
        super().__init__(
            events(),
            ping=PING_SECONDS,
            sep="\n",
            headers={"Cache-Control": "no-store"},
            client_close_handler_callable=disconnected,
            # Else the stream would end early and look complete.
            shutdown_grace_period=settings.shutdown_grace + CLOSING_SECONDS,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Sends, then closes: also where not one event was asked for."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            await self._close()


async def follow_job(submitter: Submitter, submission: Submission, created_at: str | None) -> AsyncGenerator[Job | str]:
    """The job now and at each progress, a few times a second; finally its result as JSON.

    Raises what the job fails with.
    """
    engine = submitter.engine
    find = partial(engine.find, submission.job_id, submission.owner, full=False)
    job = (await to_thread.run_sync(find)).job
    yield job
    shown = progress_of(job)
    with engine.active.waiting(submission.job_id) as waiter:
        ending = asyncio.ensure_future(submitter.outcome(submission, waiter, created_at, may_have_ended=True))
        try:
            while not ending.done():
                waiter.changed.clear()
                with suppress(CowError):  # reported at the end
                    job = (await to_thread.run_sync(find)).job
                if job.status not in TERMINAL and progress_of(job) != shown:
                    shown = progress_of(job)
                    yield job
                with suppress(TimeoutError):
                    await asyncio.wait_for(waiter.changed.wait(), POLL_SECONDS)
                await asyncio.wait({ending}, timeout=MIN_PROGRESS_SECONDS)
            result = await ending
        finally:
            ending.cancel()
            await asyncio.gather(ending, return_exceptions=True)
    assert result is not None, "it waits as long as it takes"
    yield result
