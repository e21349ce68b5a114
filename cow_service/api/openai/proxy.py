"""Chats with an MLLM: what can be imagined is added, the MLLM is asked once, and its reply comes back as it is."""

from __future__ import annotations

import asyncio
import base64
import json
from collections.abc import AsyncGenerator, Iterator
from contextlib import AsyncExitStack, aclosing, suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any, cast

from anyio import to_thread
from fastapi import Request
from pydantic import ValidationError

from cow_service import errors
from cow_service.api.openai.chats import (
    EXTENSION,
    Chat,
    ImagePart,
    as_json,
    images_of,
    other_parts,
    role_of,
    spliced,
    texts_of,
    wrong,
)
from cow_service.api.openai.forwarding import Events, Forwarder, Whole
from cow_service.api.openai.parsing import Chunks
from cow_service.api.openai.records import WITHOUT, Answerer, ChatImagination
from cow_service.api.openai.stream import DONE, Streamed, event_of, follow_job
from cow_service.api.preferences import Preferences, preferences_of
from cow_service.api.problems import invalid
from cow_service.api.submission import Submission, Submitter, disconnected, owner_of
from cow_service.errors import Canceled, CowError, FieldError, InvalidRequest, MllmBadReply
from cow_service.jobs.engine import new_job_id
from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import decode_own, encode_png
from cow_service.readers.base import Imagined
from cow_service.readers.chat import ChatReader
from cow_service.readers.mllm.hypothesis import hypothesis, pictures
from cow_service.readers.prompts import load_prompt
from cow_service.records import Simulation, Usage
from cow_service.requests import SimulateRequest

NOTE = "imagined-frames"  # name in prompts/


@dataclass(frozen=True)
class FrameParts:
    """What is added to a message: a text and images, as parts of OpenAI's protocol."""

    parts: tuple[dict[str, Any], ...]
    prompts: dict[str, int]


def frame_parts(simulation: Simulation, artifacts: ArtifactStore, detail: str | None) -> FrameParts:
    """The note and the frames of a simulation; of two worlds, a named strip of each. CPU work.

    `detail` is that of the caller's own image, so that all images are seen alike. Raises `ArtifactNotFound`.
    """
    pngs = [artifacts.read(frame.sha256) for frame in simulation.frames]
    factual = [artifacts.read(frame.sha256) for frame in simulation.factual_frames]
    frames: tuple[Any, ...] = ()
    if factual:
        frames = tuple(decode_own(png) for png in pngs)
    imagined = Imagined(simulation, frames, tuple(decode_own(png) for png in factual))
    if factual:
        pngs = [encode_png(picture) for picture in pictures(imagined)]
    prompt, told = load_prompt(NOTE), hypothesis(imagined)
    note = prompt.render(**{name: told[name] for name in prompt.inputs})
    shown = {} if detail is None else {"detail": detail}
    images = [{"type": "image_url", "image_url": {"url": _data_url(png), **shown}} for png in pngs]
    return FrameParts(({"type": "text", "text": note}, *images), {prompt.name: prompt.version})


def _data_url(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()


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
class NotImagined:
    """Why nothing is imagined; see `ChatImagination`."""

    reason: str
    detail: str
    usage: Usage = field(default_factory=Usage)  # of what was tried


@dataclass(frozen=True)
class WhatIf:
    """A simulation that a chat asks for."""

    request: SimulateRequest
    message: int  # place of the message whose question it is: frames are added to it
    image: ImagePart
    given: frozenset[str]  # fields of `cow` in the request

    def why_not(self, error: CowError) -> NotImagined | None:
        """Why nothing was imagined, where the chat goes on without; None where the error is the caller's to hear."""
        told = self.located(error)
        own = any(self._is_given(field.pointer) for field in told.errors)
        if own or not isinstance(error, PASSED_OVER):
            return None
        return NotImagined(error.code, error.detail, Usage.model_validate(error.usage or {}))

    def located(self, error: CowError) -> CowError:
        """An error of the simulation, pointing into the chat."""
        fields = tuple(FieldError(self._pointer(field.pointer), field.detail) for field in error.errors)
        told = type(error)(error.detail, errors=fields, headers=error.headers)
        told.usage = error.usage
        return told

    def _is_given(self, pointer: str) -> bool:
        """Whether that is a field of `cow`, and one that the caller gave."""
        steps = pointer.split("/")[1:3]
        return steps[:1] == [EXTENSION] and not self.given.isdisjoint(steps[1:])

    def _pointer(self, pointer: str) -> str:
        head = "/".join(pointer.split("/")[:2])
        own = {"": "", "/image": self.image.url_pointer, "/question": f"/messages/{self.message}/content"}
        return own.get(head, f"/{EXTENSION}{pointer}")


def what_if(chat: Chat) -> WhatIf | NotImagined:
    """What the chat asks to be imagined. Raises `InvalidRequest` for fields of `cow` that cannot be used."""
    messages = chat.messages()
    asked = max((place for place, each in enumerate(messages) if role_of(each) == "user"), default=-1)
    question = "\n".join(texts_of(messages[asked])) if asked >= 0 else ""
    images = list({image.url: image for image in reversed(list(images_of(messages)))}.values())
    others = sorted({kind for _, kind in other_parts(messages)})
    _check_cow(chat)
    if others:
        return NotImagined("other-parts", f"The messages hold parts that COW does not read: {', '.join(others)}.")
    if len(images) > 1:
        return NotImagined("several-images", f"A what-if question is about one image; there are {len(images)}.")
    if not images:
        return NotImagined("no-image", "There is no image in the messages.")
    if not question.strip():
        return NotImagined("no-question", "The last user message has no text.")
    try:
        fields = {"video": False, **chat.cow, "question": question, "image": images[0].reference}
        return WhatIf(SimulateRequest.model_validate(fields), asked, images[0], frozenset(chat.cow))
    except ValidationError as error:
        told = invalid(error)
        return NotImagined(told.code, told.detail)


def _check_cow(chat: Chat) -> None:
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


HEAD = ("id", "created", "model", "system_fingerprint", "service_tier")


def chunks_of(completion: dict[str, Any], request: dict[str, Any]) -> Iterator[str]:
    """The chunks as JSON: `cow`, each choice's message, each choice's end, and usage where the request wants it.

    An error is its only chunk.
    """
    if "error" in completion:
        yield as_json({"error": completion["error"]})
        return
    head = {name: completion[name] for name in HEAD if name in completion} | {"object": "chat.completion.chunk"}
    empty = {"index": 0, "delta": {}, "finish_reason": None}
    if EXTENSION in completion:
        yield as_json(head | {"choices": [empty], EXTENSION: completion[EXTENSION]})
    choices = cast("list[dict[str, Any]]", completion.get("choices") or [])
    for place, choice in enumerate(choices):
        at = {"index": choice.get("index", place)}
        message = {name: value for name, value in choice.get("message", {}).items() if value is not None}
        calls = message.get("tool_calls", ())
        if calls:
            message["tool_calls"] = [{"index": number, **call} for number, call in enumerate(calls)]
        first = {**at, "delta": message, "finish_reason": None, "logprobs": choice.get("logprobs")}
        yield as_json(head | {"choices": [first]})
        yield as_json(head | {"choices": [{**at, "delta": {}, "finish_reason": choice.get("finish_reason")}]})
    options = request.get("stream_options")
    if isinstance(options, dict) and options.get("include_usage") and "usage" in completion:
        yield as_json(head | {"choices": [], "usage": completion["usage"]})


BY_NAME = NotImagined("no-imagination", f"The model's name ends with {WITHOUT}.")
UNUSED = f"`{EXTENSION}` was not used: the model's name says that nothing is imagined."


@dataclass(frozen=True)
class Ready:
    """A chat that is ready to be sent: its messages, where frames were added, and what COW says of it."""

    chat: Chat
    messages: list[Any] | None = None
    cow: ChatImagination = field(default_factory=lambda: ChatImagination(imagined=False))

    def told(self, *warnings: str) -> dict[str, Any]:
        """`cow` of the reply."""
        return self.cow.model_copy(update={"warnings": (*self.cow.warnings, *warnings)}).model_dump(mode="json")


class Proxy:
    """Stands in for the MLLM behind a model."""

    def __init__(self, submitter: Submitter) -> None:
        self._submitter = submitter
        self._service = submitter.engine.service
        self._forwarder = Forwarder(self._service.settings)

    async def close(self) -> None:
        """Closes its connections."""
        await self._forwarder.close()

    async def complete(self, request: Request, chat: Chat, answerer: Answerer, reader: ChatReader) -> Whole | Streamed:
        """The reply to a chat, streamed where it says so.

        Raises `InvalidRequest` for what COW itself is told, the errors of a simulation that are not those of the chat,
        and `MllmUnavailable` and `MllmBadReply` for the MLLM's server. What that server refuses comes back as a reply.
        """
        prefer = preferences_without_key(request)
        asked = BY_NAME if answerer.imagine == "never" else what_if(chat)
        if isinstance(asked, NotImagined):
            return await self._sent(request, _without_frames(chat, asked), reader)
        simulated, owner = asked.request, owner_of(request)
        self._submitter.engine.check_capacity(owner)
        submission = Submission("simulate", owner, prefer, new_job_id(owner, None))
        try:
            if chat.stream:
                created_at = await self._submitter.submit(submission, simulated, None)
                return self._streamed(submission, created_at, chat, asked, reader)
            result = await self._submitter.result(request, submission, simulated, None)
        except CowError as error:
            return await self._sent(request, _without_frames(chat, _why_not(asked, error)), reader)
        return await self._sent(request, await self._with_frames(chat, asked, result), reader)

    def _streamed(
        self, submission: Submission, created_at: str | None, chat: Chat, asked: WhatIf, reader: ChatReader
    ) -> Streamed:
        """Progress while the simulation runs, then the reply's own events."""
        stack = AsyncExitStack()

        async def events() -> AsyncGenerator[bytes]:
            last, result = "", ""
            try:
                async with aclosing(follow_job(self._submitter, submission, created_at)) as news:
                    async for job in news:
                        if isinstance(job, str):
                            result = job
                        elif (chunk := Chunks(job.id, job.created_at, chat.model).progress(job)) != last:
                            last = chunk
                            yield event_of(chunk)
                ready = await self._with_frames(chat, asked, result)
            except CowError as error:
                ready = _without_frames(chat, _why_not(asked, error))
            async for event in self._events(await self._reply(ready, reader, stack), ready):
                yield event

        async def left() -> None:
            await self._submitter.leave(submission, created_at)

        return Streamed(events(), left=left, close=stack.aclose)

    async def _sent(self, request: Request, ready: Ready, reader: ChatReader) -> Whole | Streamed:
        """The reply of the MLLM. It is given up where the caller goes away before it has begun."""
        stack = AsyncExitStack()
        try:
            async with disconnected(request) as gone:
                reply = await _unless(gone, self._reply(ready, reader, stack))
        except BaseException:
            await stack.aclose()
            raise
        if ready.chat.stream and (isinstance(reply, Events) or reply.succeeded):
            return Streamed(self._events(reply, ready), close=stack.aclose)
        await stack.aclose()
        if isinstance(reply, Events):
            raise MllmBadReply("The server of the multimodal LLM streamed its reply, which the chat did not ask for.")
        return reply

    async def _reply(self, ready: Ready, reader: ChatReader, stack: AsyncExitStack) -> Whole | Events:
        """What the MLLM replies, with `cow` in a whole reply. A stream stays open until the stack is closed."""
        if reader.upstream is not None:
            body = ready.chat.sent(reader.upstream.model, ready.messages)
            reply = await stack.enter_async_context(self._forwarder.send(reader.upstream, body))
            if isinstance(reply, Events) or not reply.succeeded:
                return reply
            return Whole(spliced(reply.text, {EXTENSION: as_json(ready.told())}))
        fields = {name: value for name, value in ready.chat.fields.items() if name != EXTENSION}
        turn = await reader.chat(fields if ready.messages is None else fields | {"messages": ready.messages})
        told = {} if turn.status != HTTPStatus.OK else {EXTENSION: ready.told(*turn.warnings)}
        return Whole(as_json(turn.body | told), turn.status, turn.headers)

    async def _events(self, reply: Whole | Events, ready: Ready) -> AsyncGenerator[bytes]:
        """A reply as events: its own, behind one that carries `cow`; of a whole reply, chunks made of it."""
        if isinstance(reply, Whole):
            for data in chunks_of(json.loads(reply.text), ready.chat.fields):
                yield event_of(data)
            if reply.succeeded:
                yield event_of(DONE)
            return
        told = False
        async with aclosing(reply.events) as events:
            async for event in events:
                if not told and (head := _head_of(event)) is not None:
                    told = True
                    yield event_of(as_json(head | {EXTENSION: ready.told()}))
                yield event

    async def _with_frames(self, chat: Chat, asked: WhatIf, result: str | None) -> Ready:
        """The chat with the frames of a simulation, the result of its job."""
        assert result is not None, "it waits as long as it takes"

        def made() -> Ready:
            simulation = Simulation.model_validate_json(result)
            frames = frame_parts(simulation, self._service.artifacts, asked.image.detail)
            cow = ChatImagination(
                imagined=True,
                simulation=simulation.id,
                frames=simulation.factual_frames + simulation.frames,
                prompts=frames.prompts,
                usage=simulation.usage,
                usage_total=simulation.usage_total,
                reused=simulation.reused,
                warnings=simulation.warnings,
            )
            return Ready(chat, _extended(chat.messages(), asked.message, frames.parts), cow)

        return await to_thread.run_sync(made)


def preferences_without_key(request: Request) -> Preferences:
    """What counts of the caller's preferences. Raises `InvalidRequest` for an idempotency key."""
    prefer = preferences_of(request.headers)
    if prefer.key is not None:
        raise InvalidRequest(
            "The header `Idempotency-Key` cannot be kept here: a chat with an MLLM is not a stored job, and the same "
            "key would not bring the same reply. Leave it out; with /simulate and /answer it counts."
        )
    return Preferences(fresh=prefer.fresh)


def _why_not(asked: WhatIf, error: CowError) -> NotImagined:
    """Why nothing was imagined. Raises the error where the chat must not go on without."""
    why = asked.why_not(error)
    if why is None:
        raise asked.located(error) from error
    return why


def _without_frames(chat: Chat, why: NotImagined) -> Ready:
    warnings = (UNUSED,) if why is BY_NAME and chat.cow else ()
    told = ChatImagination(
        imagined=False, reason=why.reason, detail=why.detail, usage=why.usage, usage_total=why.usage, warnings=warnings
    )
    return Ready(chat, None, told)


def _extended(messages: list[Any], place: int, parts: tuple[dict[str, Any], ...]) -> list[Any]:
    """The messages with parts behind the content of one."""
    message = cast("dict[str, Any]", messages[place])
    content = message.get("content")
    held = [{"type": "text", "text": content}] if isinstance(content, str) else list(content or ())
    return [*messages[:place], message | {"content": [*held, *parts]}, *messages[place + 1 :]]


def _head_of(event: bytes) -> dict[str, Any] | None:
    """A chunk without content, alike to one of a stream; None for an event that is no chunk."""
    data = b"".join(line[5:] for line in event.splitlines() if line.startswith(b"data:"))
    chunk: Any = None
    with suppress(ValueError):
        chunk = json.loads(data)
    if not isinstance(chunk, dict) or "choices" not in chunk:
        return None
    kept = ("id", "object", "created", "model", "system_fingerprint", "service_tier")
    head = {name: chunk[name] for name in kept if name in chunk}
    return head | {"choices": [{"index": 0, "delta": {}, "finish_reason": None}]}


async def _unless(gone: asyncio.Event, work: Any) -> Any:
    """What the work comes to. It is canceled where the caller goes away. Raises `Canceled` then."""
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
