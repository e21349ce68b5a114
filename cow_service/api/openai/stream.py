"""Chats as server-sent events: progress while a job runs, then the reply."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import aclosing, suppress
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from anyio import to_thread
from sse_starlette import EventSourceResponse
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from cow_service.api.openai.parsing import ChatAnswer, Chunks, ParsedChat
from cow_service.api.openai.records import ChatError, ChatProblem
from cow_service.api.problems import MEDIA_TYPE
from cow_service.api.routes.jobs import PING_SECONDS
from cow_service.api.submission import Submission, Submitter
from cow_service.errors import CowError
from cow_service.jobs.engine import JobEngine
from cow_service.jobs.events import QUEUED, follow
from cow_service.records import TERMINAL, Job, Problem
from cow_service.settings import Settings

ROOT = "/v1/"
TYPES = {
    HTTPStatus.UNAUTHORIZED: "authentication_error",
    HTTPStatus.FORBIDDEN: "permission_error",
    HTTPStatus.TOO_MANY_REQUESTS: "rate_limit_error",
}


def chat_problem(problem: Problem) -> ChatProblem:
    """A problem with what OpenAI's clients read."""
    other = "server_error" if problem.status >= HTTPStatus.INTERNAL_SERVER_ERROR else "invalid_request_error"
    error = ChatError(
        message=problem.detail,
        type=TYPES.get(HTTPStatus(problem.status), other),
        param=_parameter(problem.errors[0].pointer) if problem.errors else None,
        code=problem.code,
    )
    return ChatProblem(**dict(problem), error=error)


class ChatProblems:
    """ASGI middleware, the outermost: adds the member `error` to every problem under `/v1`."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Passes a request on; a response that is a problem is buffered and extended."""
        if scope["type"] != "http" or not scope["path"].startswith(ROOT):
            await self.app(scope, receive, send)
            return
        start: Message | None = None
        body = b""

        async def extended(message: Message) -> None:
            nonlocal start, body
            if message["type"] == "http.response.start" and _is_problem(message):
                start = message
            elif start is None:
                await send(message)
            else:
                body += message.get("body", b"")
                if not message.get("more_body", False):
                    text = chat_problem(Problem.model_validate_json(body)).model_dump_json().encode()
                    MutableHeaders(scope=start)["Content-Length"] = str(len(text))
                    await send(start)
                    await send({**message, "body": text})

        await self.app(scope, receive, extended)


def document_problems(document: dict[str, Any]) -> None:
    """Puts their shape into the contract."""
    reference = f"#/components/schemas/{ChatProblem.__name__}"
    for path, operations in document["paths"].items():
        for operation in operations.values() if path.startswith(ROOT) else ():
            for response in operation["responses"].values():
                if problem := response.get("content", {}).get(MEDIA_TYPE):
                    problem["schema"] = {"$ref": reference}


def _is_problem(start: Message) -> bool:
    return Headers(raw=start["headers"]).get("content-type") == MEDIA_TYPE


def _parameter(pointer: str) -> str | None:
    """A JSON Pointer as OpenAI writes places: messages[0].content."""
    parts = [part.replace("~1", "/").replace("~0", "~") for part in pointer.split("/")[1:]]
    written = "".join(f"[{part}]" if re.fullmatch("[0-9]+", part) else f".{part}" for part in parts)
    return written.lstrip(".") or None


MIN_PROGRESS_SECONDS = 0.25  # between two chunks of progress
CLOSING_SECONDS = 2.0  # for the last event of a stream, after the grace period of a server that stops
DONE = "[DONE]"


async def nothing() -> None:
    """Does nothing."""


def unchanged(error: CowError) -> CowError:
    """The error itself."""
    return error


@dataclass(frozen=True)
class Streamed:
    """A reply as it is streamed: server-sent events, each whole, with the blank line at its end."""

    events: AsyncGenerator[bytes]
    located: Callable[[CowError], CowError] = unchanged  # an error, pointing into what the caller sent
    left: Callable[[], Awaitable[None]] = nothing  # to be called where the caller has disconnected
    close: Callable[[], Awaitable[None]] = nothing  # to be called at the end, however it came


class EventsResponse(EventSourceResponse):
    """Sends the events of a reply. A failure becomes the last event."""

    def __init__(self, streamed: Streamed, settings: Settings) -> None:
        async def disconnected(_: Message) -> None:
            with suppress(CowError):
                await streamed.left()

        self._close = streamed.close
        super().__init__(
            _told_to_the_end(streamed),
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


async def _told_to_the_end(streamed: Streamed) -> AsyncGenerator[bytes]:
    """The events; the last may be the problem that they ended with."""
    try:
        async with aclosing(streamed.events) as events:
            async for event in events:
                yield event
    except CowError as error:
        yield event_of(problem_of(streamed.located(error)))


def problem_of(error: CowError) -> str:
    """An error as `ChatProblem`, JSON on one line."""
    return chat_problem(Problem(**error.as_problem())).model_dump_json()


def event_of(data: str, name: str | None = None) -> bytes:
    """A server-sent event whose data is one line."""
    head = "" if name is None else f"event: {name}\n"
    return f"{head}data: {data}\n\n".encode()


async def answer_events(
    submitter: Submitter, submission: Submission, chat: ParsedChat, created_at: str | None
) -> AsyncGenerator[bytes]:
    """The chunks of an answer job: progress first. Raises what the job fails with."""
    async with aclosing(follow_job(submitter, submission, created_at)) as news:
        job = await anext(news)
        assert isinstance(job, Job), "the job itself comes first"
        chunks = Chunks(job.id, job.created_at, chat.model)
        last = chunks.progress(job)
        yield event_of(chunks.first(job))
        async for update in news:
            if isinstance(update, str):
                told = await to_thread.run_sync(lambda result=update: chunks.answer(ChatAnswer.parse(chat, result)))
                for chunk in told:
                    yield event_of(chunk)
            elif (chunk := chunks.progress(update)) != last:
                last = chunk
                yield event_of(chunk)
    yield event_of(DONE)


async def follow_job(submitter: Submitter, submission: Submission, created_at: str | None) -> AsyncGenerator[Job | str]:
    """The job as it is now, then as it goes on, a few times a second; last its result as JSON.

    Raises what the job fails with.
    """
    engine = submitter.engine
    yield (await to_thread.run_sync(lambda: engine.find(submission.job_id, submission.owner, full=False))).job
    updates: asyncio.Queue[Job | None] = asyncio.Queue()

    def over(task: asyncio.Future[str | None]) -> None:
        if not task.cancelled():
            task.exception()  # else asyncio logs it as never retrieved where the caller has disconnected
        updates.put_nowait(None)

    with engine.active.waiting(submission.job_id) as waiter:
        listening = asyncio.ensure_future(_listen(engine, submission, updates))
        gone = asyncio.Event()  # never set: the response itself notices that the caller has disconnected
        ending = asyncio.ensure_future(submitter.outcome(submission, waiter, created_at, gone, may_have_ended=True))
        ending.add_done_callback(over)
        try:
            while (job := await _newest(updates)) is not None:
                yield job
                await asyncio.wait({ending}, timeout=MIN_PROGRESS_SECONDS)
            result = await ending
        finally:
            listening.cancel()
            ending.cancel()
    assert result is not None, "it waits as long as it takes"
    yield result


async def _listen(engine: JobEngine, submission: Submission, updates: asyncio.Queue[Job | None]) -> None:
    """Puts progress into the queue, until the end of the job."""
    with suppress(CowError):
        async with aclosing(follow(engine, submission.job_id, QUEUED)) as events:
            async for event in events:
                if event.job is not None and event.job.status not in TERMINAL:
                    updates.put_nowait(event.job)


async def _newest(updates: asyncio.Queue[Job | None]) -> Job | None:
    """The latest update; None once the job has ended."""
    news = [await updates.get()]
    while not updates.empty():
        news.append(updates.get_nowait())
    return None if None in news else news[-1]
