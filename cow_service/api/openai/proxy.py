"""Chats with an MLLM: what can be imagined is added, the MLLM is asked once, and its reply comes back as it is."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import AsyncGenerator, Awaitable
from contextlib import AsyncExitStack, aclosing, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

from anyio import to_thread
from fastapi import Request
from pydantic import ValidationError

from cow_service import errors
from cow_service.api.openai import stream
from cow_service.api.openai.chats import EXTENSION, Chat, ImagePart, images_of, locate_in_chat, other_parts, wrong
from cow_service.api.openai.forwarding import Events, Forwarder, Whole
from cow_service.api.openai.records import WITHOUT, Answerer, ChatImagination
from cow_service.api.problems import invalid
from cow_service.api.submission import Preferences, Submission, Submitter, disconnected, owner_of, preferences_of
from cow_service.errors import Canceled, CowError, InvalidRequest, MllmBadReply
from cow_service.jobs.engine import new_job_id
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import decode_own, encode_png
from cow_service.readers.base import Imagined
from cow_service.readers.chat import ChatReader
from cow_service.readers.mllm.hypothesis import hypothesis, pictures
from cow_service.readers.prompts import load_prompt
from cow_service.records import Job, Simulation, Usage
from cow_service.requests import SimulateRequest

Made = TypeVar("Made")
NOTE = "imagined-frames"  # name in prompts/
FIELDS_OF_CHAT = ("image", "question")  # of a `SimulateRequest`: from messages
OF_ANSWERS = {  # fields of an `AnswerRequest`, and what does the same for a chat
    "votes": "the MLLM replies once: ask with `n`, or again",
    "baseline": "ask the model of the same name with :no-imagination",
    "imagine": "is said by `model`",
    "options": "the MLLM reads them in the messages",
}
# Why something cannot be imagined from a chat that the MLLM may still answer. Other errors are faults of the server, or
# of what the caller told COW itself: those are not passed over, or a figure would be that of another condition.
PASSED_OVER = (
    errors.InvalidRequest, errors.CannotGround, errors.CannotReadDirection, errors.MllmBadReply, errors.ImageTooLarge,
    errors.ImageUnreadable, errors.ImageTypeUnsupported, errors.ImageUrlNotAllowed, errors.ImageUrlUnreachable,
)  # fmt: skip


class Proxy:
    """Stands in for the MLLM behind a model."""

    def __init__(self, submitter: Submitter) -> None:
        self._submitter = submitter
        self._artifacts = submitter.engine.service.artifacts
        self._forwarder = Forwarder(submitter.engine.service.settings)

    async def close(self) -> None:
        """Closes its connections."""
        await self._forwarder.close()

    async def complete(
        self, request: Request, chat: Chat, answerer: Answerer, reader: ChatReader
    ) -> Whole | stream.Streamed:
        """The reply to a chat, streamed where it says so.

        Raises `InvalidRequest` for what COW itself is told, the errors of a simulation that are not those of the chat,
        and `MllmUnavailable` and `MllmBadReply` for the MLLM's server. What that server refuses comes back as a reply.
        """
        prefer = preferences_without_key(request)
        what_if = find_what_if(chat, answerer)
        if isinstance(what_if, ChatImagination):
            return await self._forward(request, EnrichedChat(chat, chat.messages, what_if), reader)
        owner = owner_of(request)
        self._submitter.engine.check_capacity(owner)
        submission = Submission("simulate", owner, prefer, new_job_id(owner, None))
        try:
            if chat.stream:
                created_at = await self._submitter.submit(submission, what_if.request, None)
                return self._stream(submission, created_at, chat, what_if, reader)
            result = await self._submitter.result(request, submission, what_if.request, None)
        except CowError as error:
            enriched = EnrichedChat(chat, chat.messages, what_if.explain(error))
        else:
            assert result is not None, "it waits as long as it takes"
            enriched = await to_thread.run_sync(add_frames, chat, what_if, result, self._artifacts)
        return await self._forward(request, enriched, reader)

    def _stream(
        self, submission: Submission, created_at: str | None, chat: Chat, what_if: WhatIf, reader: ChatReader
    ) -> stream.Streamed:
        """Progress while the simulation runs, then the reply's own events."""
        stack = AsyncExitStack()

        async def events() -> AsyncGenerator[bytes]:
            result = ""
            try:
                async with aclosing(stream.follow_job(self._submitter, submission, created_at)) as updates:
                    async for update in updates:
                        if isinstance(update, Job):
                            yield stream.progress_chunk(
                                update, stream.job_head(update.id, update.created_at, chat.model)
                            )
                        else:
                            result = update
                enriched = await to_thread.run_sync(add_frames, chat, what_if, result, self._artifacts)
            except CowError as error:
                enriched = EnrichedChat(chat, chat.messages, what_if.explain(error))
            async for event in _events_of(await self._ask(enriched, reader, stack), enriched):
                yield event

        return stream.Streamed(
            events(), leave=partial(self._submitter.leave, submission, created_at), close=stack.aclose
        )

    async def _forward(self, request: Request, enriched: EnrichedChat, reader: ChatReader) -> Whole | stream.Streamed:
        """The reply of the MLLM. It is given up where the caller goes away before it has begun."""
        stack = AsyncExitStack()
        try:
            async with disconnected(request) as gone:
                reply = await _unless(gone, self._ask(enriched, reader, stack))
        except BaseException:
            await stack.aclose()
            raise
        if enriched.chat.stream and (isinstance(reply, Events) or reply.succeeded):
            return stream.Streamed(_events_of(reply, enriched), close=stack.aclose)
        await stack.aclose()
        if isinstance(reply, Events):
            raise MllmBadReply("The server of the multimodal LLM streamed its reply, which the chat did not ask for.")
        return reply

    async def _ask(self, enriched: EnrichedChat, reader: ChatReader, stack: AsyncExitStack) -> Whole | Events:
        """What the MLLM replies, with `cow` in a whole reply. A stream stays open until the stack is closed."""
        body = {name: value for name, value in enriched.chat.fields.items() if name != EXTENSION}
        if isinstance(body.get("messages"), list):
            body["messages"] = enriched.messages
        if reader.upstream is None:
            turn = await reader.chat(body)
            reply, warnings = Whole(turn.body, turn.status, turn.headers), turn.warnings
        else:
            body["model"] = reader.upstream.model
            reply, warnings = await stack.enter_async_context(self._forwarder.send(reader.upstream, body)), ()
        if isinstance(reply, Events) or not reply.succeeded:
            return reply
        return replace(reply, body=reply.body | {EXTENSION: enriched.extension(*warnings)})


def preferences_without_key(request: Request) -> Preferences:
    """What counts of the caller's preferences. Raises `InvalidRequest` for an idempotency key."""
    prefer = preferences_of(request.headers)
    if prefer.key is not None:
        raise InvalidRequest(
            "The header `Idempotency-Key` cannot be kept here: a chat with an MLLM is not a stored job, and the same "
            "key would not bring the same reply. Leave it out; with /simulate and /answer it counts."
        )
    return Preferences(fresh=prefer.fresh)


@dataclass(frozen=True)
class WhatIf:
    """A simulation that a chat asks for."""

    request: SimulateRequest
    message: int  # place of the message whose question it is: frames are added to it
    image: ImagePart
    given: frozenset[str]  # fields of `cow` in the request

    def explain(self, error: CowError) -> ChatImagination:
        """Why nothing was imagined, where the chat goes on without. Raises what the caller is to hear instead."""
        own = {"/image": self.image.url_pointer, "/question": f"/messages/{self.message}/content"}
        located = locate_in_chat(error, own)
        given = {f"/{EXTENSION}/{name}" for name in self.given}
        is_own = any("/".join(field.pointer.split("/")[:3]) in given for field in located.errors)
        if is_own or not isinstance(error, PASSED_OVER):
            raise located from error
        return _nothing_imagined(error.code, error.detail, Usage.model_validate(error.usage or {}))


def find_what_if(chat: Chat, answerer: Answerer) -> WhatIf | ChatImagination:
    """What the chat asks to be imagined, or why nothing is. Raises `InvalidRequest` for unusable fields of `cow`."""
    if answerer.imagine == "never":
        unused = f"`{EXTENSION}` was not used: the model's name says that nothing is imagined."
        reason = f"The model's name ends with {WITHOUT}."
        return _nothing_imagined("no-imagination", reason, warnings=(unused,) if chat.cow else ())
    asked, question = chat.question()
    images = list({image.url: image for image in reversed(list(images_of(chat.messages)))}.values())
    others = sorted({kind for _, kind in other_parts(chat.messages)})
    _check_extension(chat)
    for applies, reason, detail in (
        (others, "other-parts", f"The messages hold parts that COW does not read: {', '.join(others)}."),
        (len(images) > 1, "several-images", f"A what-if question is about one image; there are {len(images)}."),
        (not images, "no-image", "There is no image in the messages."),
        (not question.strip(), "no-question", "The last user message has no text."),
    ):
        if applies:
            return _nothing_imagined(reason, detail)
    try:
        fields = {"video": False, **chat.cow, "question": question, "image": images[0].reference}
        return WhatIf(SimulateRequest.model_validate(fields), asked, images[0], frozenset(chat.cow))
    except ValidationError as error:
        refused = invalid(error)
        return _nothing_imagined(refused.code, refused.detail)


def _check_extension(chat: Chat) -> None:
    """Raises `InvalidRequest` for what COW itself is told and cannot do."""
    for name in chat.cow:
        if name in FIELDS_OF_CHAT:
            raise wrong(f"/{EXTENSION}/{name}", "is said by `messages`; leave it out")
        if name in OF_ANSWERS:
            raise wrong(f"/{EXTENSION}/{name}", f"leave it out: {OF_ANSWERS[name]}")
    try:
        SimulateRequest.model_validate({**chat.cow, "question": "?", "image": "data:"})
    except ValidationError as error:
        raise invalid(error, lambda pointer: f"/{EXTENSION}{pointer}") from error


def _nothing_imagined(
    reason: str, detail: str, usage: Usage | None = None, warnings: tuple[str, ...] = ()
) -> ChatImagination:
    used = usage or Usage()
    return ChatImagination(
        imagined=False, reason=reason, detail=detail, usage=used, usage_total=used, warnings=warnings
    )


@dataclass(frozen=True)
class EnrichedChat:
    """A chat that is ready to be sent: its messages, with frames or without, and what COW says of it."""

    chat: Chat
    messages: list[Any]
    cow: ChatImagination

    def extension(self, *warnings: str) -> dict[str, Any]:
        """`cow` of the reply."""
        return self.cow.model_copy(update={"warnings": (*self.cow.warnings, *warnings)}).model_dump(mode="json")


def add_frames(chat: Chat, what_if: WhatIf, result: str, artifacts: ArtifactStore) -> EnrichedChat:
    """The chat with the frames of a simulation behind its question. CPU work. Raises `ArtifactNotFound`."""
    simulation = Simulation.model_validate_json(result)
    parts, prompts = frame_parts(simulation, artifacts, what_if.image.detail)
    cow = ChatImagination(
        imagined=True,
        simulation=simulation.id,
        frames=simulation.factual_frames + simulation.frames,
        prompts=prompts,
        usage=simulation.usage,
        usage_total=simulation.usage_total,
        reused=simulation.reused,
        warnings=simulation.warnings,
    )
    messages = list(chat.messages)
    content = messages[what_if.message].get("content")
    held = [{"type": "text", "text": content}] if isinstance(content, str) else list(content or ())
    messages[what_if.message] = messages[what_if.message] | {"content": [*held, *parts]}
    return EnrichedChat(chat, messages, cow)


def frame_parts(
    simulation: Simulation, artifacts: ArtifactStore, detail: str | None
) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """The note and the frames of a simulation as parts of a message (of two worlds, a named strip of each), and the
    version of the prompt.

    `detail` is that of the caller's own image, so that all images are seen alike.
    """
    pngs = [artifacts.read(frame.sha256) for frame in simulation.frames]
    factual = tuple(decode_own(artifacts.read(frame.sha256)) for frame in simulation.factual_frames)
    imagined = Imagined(simulation, tuple(decode_own(png) for png in pngs) if factual else (), factual)
    if factual:
        pngs = [encode_png(picture) for picture in pictures(imagined)]
    prompt, told = load_prompt(NOTE), hypothesis(imagined)
    note = prompt.render(**{name: told[name] for name in prompt.inputs})
    shown = {} if detail is None else {"detail": detail}
    urls = ["data:image/png;base64," + base64.b64encode(png).decode() for png in pngs]
    images = [{"type": "image_url", "image_url": {"url": url, **shown}} for url in urls]
    return [{"type": "text", "text": note}, *images], {prompt.name: prompt.version}


async def _events_of(reply: Whole | Events, enriched: EnrichedChat) -> AsyncGenerator[bytes]:
    """A reply as events: its own, behind one that carries `cow`; of a whole reply, chunks made of it."""
    if isinstance(reply, Whole):
        for chunk in stream.chunks_of(reply.body, with_usage=enriched.chat.with_usage):
            yield stream.event_of(chunk)
        if reply.succeeded:
            yield stream.DONE
        return
    is_first = True
    async with aclosing(reply.events) as events:
        async for event in events:
            if is_first and "choices" in (chunk := stream.data_of(event)):
                is_first = False
                yield stream.event_of(stream.chunk_of(stream.head_of(chunk), {}, cow=enriched.extension()))
            yield event


async def _unless(gone: asyncio.Event, work: Awaitable[Made]) -> Made:
    """The result of the work, which is canceled where the caller goes away. Raises `Canceled` then."""
    task, left = asyncio.ensure_future(work), asyncio.ensure_future(gone.wait())
    try:
        await asyncio.wait({task, left}, return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise Canceled("The caller went away before the reply was there.")
        return task.result()
    finally:
        left.cancel()
        if not task.done():
            task.cancel()
            with suppress(asyncio.CancelledError, CowError):
                await task
