"""Completes chats, on the job engine and with the MLLM behind a model.

With an MLLM, what can be imagined is added to the chat, the MLLM is asked once, and its reply comes back as it is.
Without one, the chat is a job as of `POST /answer`, and its result becomes the reply.
"""

import base64
import time
from contextlib import AsyncExitStack, aclosing
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from anyio import to_thread
from fastapi import Request, Response
from pydantic import ValidationError

from cow_service import errors
from cow_service.api import submission as submitting
from cow_service.api.body import read_object
from cow_service.api.openai import records, stream
from cow_service.api.openai.answering import answer_events, completion_of, parse_chat
from cow_service.api.openai.chats import EXTENSION, Chat, ImagePart, images_of, locate_in_chat, other_parts, wrong
from cow_service.api.openai.forwarding import Events, Forwarder
from cow_service.api.openai.records import Answerer, ChatImagination
from cow_service.api.problems import invalid
from cow_service.jobs.engine import new_job_id
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import decode_own, encode_png
from cow_service.readers.base import Imagined
from cow_service.readers.chat import ChatReader, ChatTurn
from cow_service.readers.mllm.hypothesis import hypothesis, pictures
from cow_service.readers.prompts import load_prompt
from cow_service.records import Job, Simulation, Usage
from cow_service.requests import SimulateRequest
from cow_service.requests.values import SHOWN_CHARACTERS

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


@dataclass(frozen=True)
class WhatIf:
    """A simulation that a chat asks for."""

    request: SimulateRequest
    message: int  # place of the message whose question it is: frames are added to it
    image: ImagePart
    given: frozenset[str]  # fields of `cow` in the request

    def explain(self, error: errors.CowError) -> ChatImagination:
        """Why nothing was imagined, where the chat goes on without. Raises what the caller is to hear instead."""
        own = {"/image": self.image.url_pointer, "/question": f"/messages/{self.message}/content"}
        located = locate_in_chat(error, own)
        given = {f"/{EXTENSION}/{name}" for name in self.given}
        is_own = any("/".join(field.pointer.split("/")[:3]) in given for field in located.errors)
        if is_own or not isinstance(error, PASSED_OVER):
            raise located from error
        return _nothing_imagined(error.code, str(error), Usage.model_validate(error.usage or {}))


@dataclass(frozen=True)
class EnrichedChat:
    """A chat that is ready to be sent: its messages, with frames or without, and what COW says of it."""

    chat: Chat
    messages: list[Any]
    cow: ChatImagination

    def extension(self, *warnings: str) -> dict[str, Any]:
        """`cow` of the reply."""
        return self.cow.model_copy(update={"warnings": (*self.cow.warnings, *warnings)}).model_dump(mode="json")


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
            shown = errors.shortened(media_type, SHOWN_CHARACTERS)
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
        what_if = await submitter.in_thread(owner, partial(find_what_if, chat, answerer))
        if isinstance(what_if, ChatImagination):
            return await self._forward(request, EnrichedChat(chat, chat.messages, what_if), reader)
        submitter.engine.check_capacity(owner)
        submission = submitting.Submission("simulate", owner, prefer, new_job_id(owner, None))
        try:
            if chat.stream:
                created_at = await submitter.submit(submission, what_if.request)
                return self._stream(submission, created_at, chat, what_if, reader)
            result = await submitter.result(request, submission, what_if.request)
        except errors.CowError as error:
            enriched = EnrichedChat(chat, chat.messages, what_if.explain(error))
        else:
            assert result is not None, "it waits as long as it takes"
            enriched = await to_thread.run_sync(add_frames, chat, what_if, result, self.service.artifacts)
        return await self._forward(request, enriched, reader)

    async def _answer(
        self, request: Request, chat: Chat, answerer: Answerer, *, stored: bool
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
        self, submission: submitting.Submission, created_at: str | None, chat: Chat, what_if: WhatIf, reader: ChatReader
    ) -> stream.Streamed:
        """Progress while the simulation runs, then the reply's own events."""
        stack = AsyncExitStack()

        async def events() -> Events:
            result = ""
            try:
                async with aclosing(stream.follow_job(self._submitter, submission, created_at)) as updates:
                    async for update in updates:
                        if isinstance(update, Job):
                            head = stream.job_head(update.id, update.created_at, chat.model)
                            yield stream.progress_chunk(update, head)
                        else:
                            result = update
                enriched = await to_thread.run_sync(add_frames, chat, what_if, result, self.service.artifacts)
            except errors.CowError as error:
                enriched = EnrichedChat(chat, chat.messages, what_if.explain(error))
            async for event in _events_of(await self._ask(enriched, reader, stack), enriched):
                yield event

        leave = partial(self._submitter.leave, submission, created_at)
        return stream.Streamed(events(), leave=leave, close=stack.aclose)

    async def _forward(
        self, request: Request, enriched: EnrichedChat, reader: ChatReader
    ) -> ChatTurn | stream.Streamed:
        """The reply of the MLLM. It is given up where the caller goes away before it has begun."""
        async with AsyncExitStack() as stack:
            reply = await submitting.unless_disconnected(request, self._ask(enriched, reader, stack))
            refused = isinstance(reply, ChatTurn) and not reply.succeeded
            if enriched.chat.stream and not refused:
                return stream.Streamed(_events_of(reply, enriched), close=stack.pop_all().aclose)
        if isinstance(reply, ChatTurn):
            return reply
        detail = "The server of the multimodal LLM streamed its reply, which the chat did not ask for."
        raise errors.MllmBadReply(detail)

    async def _ask(self, enriched: EnrichedChat, reader: ChatReader, stack: AsyncExitStack) -> ChatTurn | Events:
        """What the MLLM replies, with `cow` in a whole reply. A stream stays open until the stack is closed."""
        body = {name: value for name, value in enriched.chat.fields.items() if name != EXTENSION}
        if isinstance(body.get("messages"), list):
            body["messages"] = enriched.messages
        if reader.upstream is None:
            reply = await reader.chat(body)
        else:
            body["model"] = reader.upstream.model
            reply = await stack.enter_async_context(self._forwarder.send(reader.upstream, body))
        if not isinstance(reply, ChatTurn) or not reply.succeeded:
            return reply
        return replace(reply, body=reply.body | {EXTENSION: enriched.extension(*reply.warnings)})


def preferences_without_key(request: Request) -> submitting.Preferences:
    """What counts of the caller's preferences. Raises `InvalidRequest` for an idempotency key."""
    prefer = submitting.preferences_of(request.headers)
    if prefer.key is not None:
        raise errors.InvalidRequest(
            "The header `Idempotency-Key` cannot be kept here: a chat with an MLLM is not a stored job, and the same "
            "key would not bring the same reply. Leave it out; with /simulate and /answer it counts."
        )
    return submitting.Preferences(fresh=prefer.fresh)


def find_what_if(chat: Chat, answerer: Answerer) -> WhatIf | ChatImagination:
    """What the chat asks to be imagined, or why nothing is. Raises `InvalidRequest` for unusable fields of `cow`."""
    if answerer.imagine == "never":
        unused = f"`{EXTENSION}` was not used: the model's name says that nothing is imagined."
        reason = f"The model's name ends with {records.WITHOUT}."
        return _nothing_imagined("no-imagination", reason, warnings=(unused,) if chat.cow else ())
    asked, question = chat.question()
    images = list({image.url: image for image in reversed(list(images_of(chat.messages)))}.values())
    others = sorted({kind for _, kind in other_parts(chat.messages)})
    for name in chat.cow:
        if name in FIELDS_OF_CHAT:
            raise wrong(f"/{EXTENSION}/{name}", "is said by `messages`; leave it out")
        if name in OF_ANSWERS:
            raise wrong(f"/{EXTENSION}/{name}", f"leave it out: {OF_ANSWERS[name]}")
    try:  # what COW itself is told, whatever the messages hold
        SimulateRequest.model_validate({**chat.cow, "question": "?", "image": "data:"})
    except ValidationError as error:
        raise invalid(error, lambda pointer: f"/{EXTENSION}{pointer}") from error
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
        return _nothing_imagined(refused.code, str(refused))


def _nothing_imagined(
    reason: str, detail: str, usage: Usage | None = None, warnings: tuple[str, ...] = ()
) -> ChatImagination:
    used = usage or Usage()
    return ChatImagination(
        imagined=False, reason=reason, detail=detail, usage=used, usage_total=used, warnings=warnings
    )


def add_frames(chat: Chat, what_if: WhatIf, result: str, artifacts: ArtifactStore) -> EnrichedChat:
    """The chat with a note and the frames of a simulation behind its question; of two worlds, a named strip of each.

    All images are seen in the `detail` of the caller's own. CPU work. Raises `ArtifactNotFound`.
    """
    simulation = Simulation.model_validate_json(result)
    pngs = [artifacts.read(frame.sha256) for frame in simulation.frames]
    factual = tuple(decode_own(artifacts.read(frame.sha256)) for frame in simulation.factual_frames)
    imagined = Imagined(simulation, tuple(decode_own(png) for png in pngs) if factual else (), factual)
    if factual:
        pngs = [encode_png(picture) for picture in pictures(imagined)]
    prompt, told = load_prompt(NOTE), hypothesis(imagined)
    detail = {} if what_if.image.detail is None else {"detail": what_if.image.detail}
    parts: list[Any] = [{"type": "text", "text": prompt.render(**{name: told[name] for name in prompt.inputs})}]
    for png in pngs:
        url = "data:image/png;base64," + base64.b64encode(png).decode()
        parts.append({"type": "image_url", "image_url": {"url": url, **detail}})
    cow = ChatImagination(
        imagined=True,
        simulation=simulation.id,
        frames=simulation.factual_frames + simulation.frames,
        prompts={prompt.name: prompt.version},
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
