"""Completes chats, on the job engine and with the MLLM behind a model.

With an MLLM, what can be imagined is added to the chat, the MLLM is asked (once, unless the model's name has it vote),
and its reply comes back as it is.
Without one, the chat is a job as of `POST /answer`, and its result becomes the reply.
"""

import asyncio
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import AsyncExitStack, aclosing, suppress
from dataclasses import replace
from functools import partial
from typing import Any, cast

from anyio import to_thread
from fastapi import Request, Response

from cow_service import errors
from cow_service.api import submission as submitting
from cow_service.api.body import read_object
from cow_service.api.openai import records, stream
from cow_service.api.openai.answering import answer_events, completion_of, parse_chat
from cow_service.api.openai.chats import EXTENSION, Chat, check_passed_on, fetch_pictures, locate_in_chat, media_urls
from cow_service.api.openai.forwarding import Events, Forwarder
from cow_service.api.openai.imagining import EnrichedChat, WhatIf, find_what_if
from cow_service.jobs.engine import new_job_id
from cow_service.readers.chat import ChatReader, ChatTurn
from cow_service.readers.mllm.replies import ReplyError
from cow_service.readers.options import read_choices
from cow_service.records import AnswerOption, Job
from cow_service.requests import SimulateRequest

DEFAULT_WAIT_SECONDS = 60.0  # from a chat's arrival; after it, no refused call of the imagination is repeated


class Completer:
    """Completes chats."""

    def __init__(self, submitter: submitting.Submitter) -> None:
        self._submitter = submitter
        self.service = submitter.engine.service
        self._forwarder = Forwarder(self.service.settings)
        self.started = int(time.time())

    async def close(self) -> None:
        """Closes connections."""
        await self._forwarder.close()

    async def read_body(self, request: Request) -> dict[str, Any]:
        """The JSON object that a request holds. Raises `BodyTypeUnsupported`, `MalformedBody`."""
        media_type = request.headers.get("content-type", "none").partition(";")[0].strip().lower()
        if media_type != "application/json" and not media_type.endswith("+json"):
            shown = errors.shortened(media_type)
            raise errors.BodyTypeUnsupported(f"The body has the media type '{shown}'. Send application/json.")
        return await self._submitter.in_thread(
            submitting.owner_of(request), partial(read_object, await request.body(), "The body")
        )

    async def complete(
        self, request: Request, chat: Chat, *, stored: bool = True
    ) -> ChatTurn | stream.Streamed | Response:
        """The reply, streamed where the chat says so; a response where the caller takes the job instead, which needs
        `stored`.

        Raises `ModelNotFound`, `InvalidRequest` for what COW itself is told, what a job fails with, unless the chat
        goes on without imagination, and `MllmUnavailable` and `MllmBadReply` for the MLLM's server. What that server
        refuses comes back as a reply.
        """
        answerer = records.find_answerer(self.service, chat.model)
        reader = await to_thread.run_sync(self.service.chat_reader, answerer.reader)
        if reader is None:
            return await self._answer(request, chat, answerer, stored=stored)
        prefer, submitter = preferences_without_key(request), self._submitter
        owner = submitting.owner_of(request)
        seconds = submitting.preferences_of(request.headers).wait
        until = time.time() + (DEFAULT_WAIT_SECONDS if seconds is None else seconds)
        if reader.upstream is not None:
            check_passed_on(chat, self.service.settings.chat_fields)
        predicted = media_urls(chat.fields.get("prediction"), "/prediction")
        if urls := [*media_urls(chat.messages), *predicted]:
            await submitter.fetch(owner, partial(fetch_pictures, urls, self.service))
        what_if = await submitter.in_thread(owner, partial(find_what_if, chat, answerer))
        if isinstance(what_if, records.ChatImagination):
            return await self._forward(request, EnrichedChat(chat, answerer, chat.messages, what_if), reader)
        submitter.engine.check_capacity(owner)
        try:
            wanted: SimulateRequest | None = what_if.request
            while wanted is not None:
                submission = submitting.Submission("simulate", owner, prefer, new_job_id(owner, None), until=until)
                if chat.stream:
                    created_at = await submitter.submit(submission, wanted)
                    return self._stream(submission, created_at, what_if, reader)
                result = await submitter.result(request, submission, wanted)
                assert result is not None, "this request waits without a limit"
                wanted = await to_thread.run_sync(what_if.take, result, self.service.artifacts)
            enriched = await to_thread.run_sync(what_if.enriched, self.service.artifacts, reader.takes)
        except errors.CowError as error:
            enriched = what_if.without(error)
        return await self._forward(request, enriched, reader)

    async def _answer(
        self, request: Request, chat: Chat, answerer: records.Answerer, *, stored: bool
    ) -> ChatTurn | stream.Streamed | Response:
        """The reply of a model without an MLLM."""
        submitter = self._submitter
        submission = submitter.submission(request, "answer")
        if not stored:
            submission = replace(submission, prefer=preferences_without_key(request))
        parsed = await submitter.in_thread(submission.owner, partial(parse_chat, chat, answerer))
        try:
            if chat.stream:
                created_at = await submitter.submit(submission, parsed.request)
                return stream.Streamed(
                    answer_events(submitter, submission, parsed, created_at),
                    locate=lambda error: locate_in_chat(error, parsed.pointers),
                    leave=partial(submitter.leave, submission, created_at),
                )
            result = await submitter.result(request, submission, parsed.request)
            if result is None:
                return await submitter.accepted(submission)
            return ChatTurn(await to_thread.run_sync(completion_of, parsed, result))
        except errors.CowError as error:
            raise locate_in_chat(error, parsed.pointers) from error

    def _stream(
        self, submission: submitting.Submission, created_at: str | None, what_if: WhatIf, reader: ChatReader
    ) -> stream.Streamed:
        """Progress while the simulations run (the first is submitted); then the reply's own events."""
        stack, running = AsyncExitStack(), (submission, created_at)

        async def events() -> Events:
            nonlocal running
            wanted: SimulateRequest | None = what_if.request
            try:
                while wanted is not None:
                    result = ""
                    async with aclosing(stream.follow_job(self._submitter, *running)) as updates:
                        async for update in updates:
                            if isinstance(update, Job):
                                head = stream.job_head(update.id, update.created_at, what_if.chat.model)
                                yield stream.progress_chunk(update, head)
                            else:
                                result = update
                    wanted = await to_thread.run_sync(what_if.take, result, self.service.artifacts)
                    if wanted is not None:
                        following = replace(submission, job_id=new_job_id(submission.owner, None))
                        running = following, await self._submitter.submit(following, wanted)
                enriched = await to_thread.run_sync(what_if.enriched, self.service.artifacts, reader.takes)
            except errors.CowError as error:
                enriched = what_if.without(error)
            enriched = enriched.adapted(reader)
            async for event in _events_of(await self._ask(enriched, reader, stack), enriched):
                yield event

        async def leave() -> None:
            await self._submitter.leave(*running)

        return stream.Streamed(events(), leave=leave, close=stack.aclose)

    async def _forward(
        self, request: Request, enriched: EnrichedChat, reader: ChatReader
    ) -> ChatTurn | stream.Streamed:
        """The reply of the MLLM. It is given up where the caller goes away before it has begun."""
        enriched = enriched.adapted(reader)
        async with AsyncExitStack() as stack:
            reply = await submitting.unless_disconnected(request, self._ask(enriched, reader, stack))
            refused = isinstance(reply, ChatTurn) and not reply.succeeded
            if enriched.chat.stream and not refused:
                return stream.Streamed(_events_of(reply, enriched), close=stack.pop_all().aclose)
        return _whole(reply)

    async def _ask(self, enriched: EnrichedChat, reader: ChatReader, stack: AsyncExitStack) -> ChatTurn | Events:
        """What the MLLM replies, with `cow` in a whole reply. A stream stays open until the stack is closed."""
        body = {name: value for name, value in enriched.chat.fields.items() if name != EXTENSION}
        if isinstance(body.get("messages"), list):
            body["messages"] = enriched.messages
        if enriched.answerer.votes > 1:
            return await self._vote(body, enriched, reader)
        reply = await self._send(body, reader, stack)
        if not isinstance(reply, ChatTurn) or not reply.succeeded:
            return reply
        return replace(reply, body=reply.body | {EXTENSION: enriched.extension(*reply.warnings)})

    async def _send(self, body: dict[str, Any], reader: ChatReader, stack: AsyncExitStack) -> ChatTurn | Events:
        if reader.upstream is None:
            return await reader.chat(body)
        return await stack.enter_async_context(
            self._forwarder.send(reader.upstream, body | {"model": reader.upstream.model})
        )

    async def _vote(self, body: dict[str, Any], enriched: EnrichedChat, reader: ChatReader) -> ChatTurn:
        """The reply of most votes, all asked at the same time. A vote that fails fails the chat."""
        body = {name: value for name, value in body.items() if name not in ("stream", "stream_options")}

        async def ask() -> ChatTurn:
            async with AsyncExitStack() as stack:
                return _whole(await self._send(body, reader, stack))

        tasks = [asyncio.ensure_future(ask()) for _ in range(enriched.answerer.votes)]
        try:
            replies = await asyncio.gather(*tasks)
        finally:
            for task in tasks:
                task.cancel()
        if refused := next((reply for reply in replies if not reply.succeeded), None):
            return refused
        winner, votes, warnings = await to_thread.run_sync(elect, enriched.chat, replies)
        extension = enriched.extension(*winner.warnings, *warnings, votes=votes)
        return replace(winner, body=winner.body | {EXTENSION: extension})


def _whole(reply: ChatTurn | Events) -> ChatTurn:
    """The reply of a chat that asked for no stream. Raises `MllmBadReply` for one."""
    if isinstance(reply, ChatTurn):
        return reply
    detail = "The server of the multimodal LLM streamed its reply, which the chat did not ask for."
    raise errors.MllmBadReply(detail)


def preferences_without_key(request: Request) -> submitting.Preferences:
    """What counts of the caller's preferences. Raises `InvalidRequest` for an idempotency key."""
    prefer = submitting.preferences_of(request.headers)
    if prefer.key is not None:
        raise errors.InvalidRequest(
            "The header `Idempotency-Key` has no effect here: a chat with a multimodal LLM is not a stored job. "
            "Leave it out; it works with /simulate and /answer."
        )
    return submitting.Preferences(fresh=prefer.fresh)


async def _events_of(reply: ChatTurn | Events, enriched: EnrichedChat) -> Events:
    """A reply as events: its own, behind one that carries `cow`; of a whole reply, chunks made of it."""
    if isinstance(reply, ChatTurn):
        for chunk in stream.chunks_of(reply.body, with_usage=enriched.chat.with_usage):
            yield stream.event_of(chunk)
        if reply.succeeded:
            yield stream.LAST_EVENT
        return
    is_first = True
    async with aclosing(reply) as events:
        async for event in events:
            if is_first and "choices" in (chunk := stream.data_of(event)):
                is_first = False
                yield stream.event_of(stream.chunk_of(stream.head_of(chunk), {}, cow=enriched.extension()))
            yield event


def elect(chat: Chat, replies: Sequence[ChatTurn]) -> tuple[ChatTurn, dict[str, int], tuple[str, ...]]:
    """The first reply with the most frequent answer (of equals the first), with the usage of all; votes and warnings.

    Where no reply can be read, the first one is taken. CPU work.
    """
    options = read_choices(chat.question()[1], None)
    answers = [answer_in(reply, options) for reply in replies]
    votes = Counter(answer for answer in answers if answer is not None)
    most = max(votes.values(), default=0)
    tied = [answer for answer, count in votes.items() if count == most]
    warnings: list[str] = []
    if lost := answers.count(None):
        warnings.append(f"{lost} of {len(replies)} votes could not be read and do not count.")
    if len(tied) > 1:
        warnings.append(f"The votes are tied between {' and '.join(tied)}; the first one given was taken.")
    winner = replies[answers.index(tied[0])] if tied else replies[0]
    usages = [usage for reply in replies if isinstance(usage := reply.body.get("usage"), dict)]
    body = winner.body | ({"usage": _total(cast("list[dict[str, Any]]", usages))} if usages else {})
    return replace(winner, body=body), dict(votes), tuple(warnings)


def answer_in(reply: ChatTurn, options: Sequence[AnswerOption]) -> str | None:
    """The letter that a reply gives; None if it gives none, or several."""
    from cow_service.readers.mllm.answer import read_answer  # noqa: PLC0415 # an extra, which the reader has imported

    match reply.body:
        case {"choices": [{"message": {"content": str(text)}}, *_]}:
            with suppress(ReplyError):
                return read_answer(text, options).answer
        case _:
            pass
    return None


def _total(usages: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The sum of token counts, also of nested ones. What is no number stays as the first reply has it."""
    total = dict(usages[0])
    for name, first in total.items():
        values = [usage.get(name) for usage in usages]
        if isinstance(first, dict):
            total[name] = _total([value for value in values if isinstance(value, dict)])
        elif isinstance(first, int | float):
            total[name] = sum(value for value in values if isinstance(value, int | float))
    return total
