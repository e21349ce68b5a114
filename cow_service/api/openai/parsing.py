"""From a chat with a model without an MLLM to the `AnswerRequest` that it asks for, and what of it is not used."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any

from pydantic import ValidationError

from cow_service.api.openai.chats import Chat, ImagePart, images_of, other_parts, role_of, texts_of, wrong
from cow_service.api.openai.records import (
    Answerer,
    ChatChoice,
    ChatDelta,
    ChatProgress,
    ChatReply,
    ChatUsage,
    ChunkChoice,
)
from cow_service.api.problems import invalid
from cow_service.errors import CowError, FieldError, InvalidRequest
from cow_service.readers.options import Reply, reply_text
from cow_service.records import Job
from cow_service.requests import AnswerRequest

FIELDS_OF_CHAT = ("image", "question", "imagine", "reader")  # of an `AnswerRequest`: from messages and model
# Fields of a chat that are used, or that ask for nothing of the reply.
SILENT = frozenset({
    "model", "messages", "stream", "stream_options", "seed", "cow", "max_tokens", "max_completion_tokens",
    "parallel_tool_calls", "prediction", "user", "safety_identifier", "metadata", "store", "service_tier",
    "prompt_cache_key", "prompt_cache_options", "prompt_cache_retention",
})  # fmt: skip
# Values of other fields that ask for nothing; null, false and what is empty never does.
NEUTRAL: dict[str, tuple[Any, ...]] = {
    "n": (1,), "tool_choice": ("none", "auto"), "function_call": ("none", "auto"), "top_logprobs": (0,),
    "response_format": ({"type": "text"},), "modalities": (["text"],), "temperature": (0, 1), "top_p": (1,),
    "top_k": (-1, 0, 1), "min_p": (0,), "presence_penalty": (0,), "frequency_penalty": (0,),
    "repetition_penalty": (1,), "reasoning_effort": ("medium",), "verbosity": ("medium",),
}  # fmt: skip


@dataclass(frozen=True)
class FieldPointers:
    """JSON Pointers into a chat for the fields of its `AnswerRequest`."""

    image: str
    question: str
    seed: str

    def translate(self, pointer: str) -> str:
        """The pointer into the chat for one into the `AnswerRequest`."""
        head = "/".join(pointer.split("/")[:2])
        own = {"": "", "/image": self.image, "/question": self.question, "/seed": self.seed, "/reader": "/model"}
        return own.get(head, "/cow" + pointer)

    def translate_error(self, error: CowError) -> CowError:
        """An error of the `AnswerRequest`, pointing into the chat."""
        fields = tuple(FieldError(self.translate(field.pointer), field.detail) for field in error.errors)
        return type(error)(error.detail, errors=fields, headers=error.headers)


@dataclass(frozen=True)
class ParsedChat:
    """A chat that was parsed and validated. It is not a job yet."""

    model: str
    request: AnswerRequest
    pointers: FieldPointers
    warnings: tuple[str, ...]  # what of it has no effect
    max_tokens: int | None
    stream: bool
    with_usage: bool


def parse_chat(chat: Chat, model: Answerer) -> ParsedChat:
    """The answer that a chat asks for. Raises `InvalidRequest`."""
    messages = chat.messages()
    if not messages:
        raise wrong("/messages", "is missing: send the image and the question in one user message")
    image = _image_of(messages)
    place = max((place for place, each in enumerate(messages) if role_of(each) == "user"), default=len(messages) - 1)
    question = "\n".join(texts_of(messages[place]))
    if not question.strip():
        raise wrong(f"/messages/{place}/content", "the last user message has no text: put the question there")
    for name in FIELDS_OF_CHAT:
        if name in chat.cow:
            raise wrong(f"/cow/{name}", "is said by `messages` and `model`; leave it out")
    seed = chat.fields.get("seed")
    seeds: dict[str, Any] = {} if seed is None else {"seed": seed}
    if seeds and "seed" in chat.cow:
        raise wrong("/cow/seed", "stands in `seed`, too; give it once")
    pointers = FieldPointers(image.url_pointer, f"/messages/{place}/content", "/seed" if seeds else "/cow/seed")
    fields = {**chat.cow, **seeds, "question": question, "image": image.reference}
    try:
        request = AnswerRequest.model_validate({**fields, "reader": model.reader, "imagine": model.imagine})
    except ValidationError as error:
        raise invalid(error, pointers.translate) from error
    limits = [limit for name in ("max_tokens", "max_completion_tokens") if type(limit := chat.fields.get(name)) is int]
    options = chat.fields.get("stream_options")
    return ParsedChat(
        model=chat.model,
        request=request,
        pointers=pointers,
        warnings=tuple(_warnings(chat, place)),
        max_tokens=min(limits, default=None),
        stream=chat.stream,
        with_usage=isinstance(options, dict) and bool(options.get("include_usage")),
    )


def _image_of(messages: list[Any]) -> ImagePart:
    """The only image. The same image may stand in several messages."""
    if others := list(other_parts(messages)):
        pointer, kind = others[0]
        raise wrong(f"{pointer}/type", f"is {kind}: only parts of the types `text` and `image_url` are read")
    found: dict[str, ImagePart] = {}
    for image in images_of(messages):
        if image.role != "user":
            raise wrong(image.pointer, f"images are read in `user` messages only, got one of `{image.role}`")
        found.setdefault(image.url, image)
    if not found:
        raise wrong(
            f"/messages/{len(messages) - 1}/content",
            "no user message has an image: add a part "
            '{"type": "image_url", "image_url": {"url": "data:image/png;base64,..."}}',
        )
    if len(found) > 1:
        detail = f"a question is about one image, got {len(found)}: send one"
        places = tuple(FieldError(image.url_pointer, detail) for image in found.values())
        raise InvalidRequest(f"`messages`: {detail}.", errors=places)
    image = next(iter(found.values()))
    if not image.url[:8].lower().startswith(("data:", "http://", "https://")):
        raise wrong(image.url_pointer, "is neither a data URL (data:image/png;base64,...) nor one of http or https")
    return image


def _warnings(chat: Chat, question: int) -> Iterator[str]:
    """What of the chat has no effect."""
    unread = [
        f"{place} ({role_of(message)})"
        for place, message in enumerate(chat.messages())
        if place != question and any(text.strip() for text in texts_of(message))
    ]
    if unread:
        yield (
            f"The text of these `messages` was not read: {_some(unread)}. This model takes one image and one question: "
            "all that matters must stand in the last user message."
        )
    unused = [f"`{name[:40]}`" for name, value in chat.fields.items() if name not in SILENT and _asks(name, value)]
    if unused:
        yield f"Not used: {_some(unused)}. This model has no MLLM behind it that could use them."


def _asks(name: str, value: Any) -> bool:
    """Whether the value of a field asks for something."""
    if value is None or value is False or value in ([], {}, ""):
        return False
    return isinstance(value, bool) or value not in NEUTRAL.get(name, ())


def _some(names: list[str], most: int = 10) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


NOT_SURE = "Not sure"
SEPARATORS = (",", ":")


@dataclass(frozen=True)
class ChatAnswer:
    """The result of a chat's job. The `Answer` is plain values: validating its numbers again would take long."""

    chat: ParsedChat
    answer: dict[str, Any]

    @classmethod
    def parse(cls, chat: ParsedChat, result: str) -> ChatAnswer:
        """The result of a job as JSON, parsed. CPU work: not for the event loop."""
        answer = json.loads(result)
        content = _content(answer)
        too_long = chat.max_tokens is not None and len(content.split()) > chat.max_tokens
        warnings = (f"The answer is longer than {chat.max_tokens} tokens: answers are not cut.",) if too_long else ()
        answer["warnings"] = [*chat.warnings, *warnings, *answer["warnings"]]
        return cls(chat, answer)

    @cached_property
    def reply(self) -> ChatReply:
        """The message."""
        return ChatReply(content=_content(self.answer), reasoning_content=self.answer["reasoning"] or None)

    @cached_property
    def usage(self) -> ChatUsage:
        """All tokens."""
        read, written = self.answer["usage"]["input_tokens"], self.answer["usage"]["output_tokens"]
        return ChatUsage(prompt_tokens=read, completion_tokens=written, total_tokens=read + written)

    def completion(self) -> str:
        """A `ChatCompletion` as JSON."""
        head = _head(self.answer["id"], "chat.completion", self.answer["created_at"], self.chat.model)
        choice = ChatChoice(message=self.reply)
        body = {"choices": [choice.model_dump()], "usage": self.usage.model_dump(), "cow": self.answer}
        return json.dumps(head | body, separators=SEPARATORS, ensure_ascii=False)


@dataclass(frozen=True)
class Chunks:
    """Writes the chunks of one stream, each a `ChatChunk` as JSON on one line."""

    job: str
    created_at: str
    model: str

    def first(self, job: Job) -> str:
        """The role of the message, and the job."""
        return self._chunk(ChatDelta(role="assistant", content=""), cow=_progress(job))

    def progress(self, job: Job) -> str:
        """Progress only: adds nothing to the message."""
        return self._chunk(ChatDelta(), cow=_progress(job))

    def answer(self, answer: ChatAnswer) -> list[str]:
        """The message, its end, and its tokens where they were asked for. CPU work: not for the event loop."""
        reply = answer.reply
        chunks: list[str] = []
        if reply.reasoning_content is not None:
            chunks.append(self._chunk(ChatDelta(reasoning_content=reply.reasoning_content)))
        chunks.append(self._chunk(ChatDelta(content=reply.content)))
        chunks.append(self._chunk(ChatDelta(), finish_reason="stop", cow=answer.answer))
        if answer.chat.with_usage:
            chunks.append(self._write([], usage=answer.usage.model_dump()))
        return chunks

    def _chunk(self, delta: ChatDelta, *, finish_reason: Any = None, **others: Any) -> str:
        choice = ChunkChoice(delta=delta, finish_reason=finish_reason)
        added = {"delta": delta.model_dump(exclude_unset=True)}
        return self._write([choice.model_dump() | added], **others)

    def _write(self, choices: list[dict[str, Any]], **others: Any) -> str:
        head = _head(self.job, "chat.completion.chunk", self.created_at, self.model)
        body = {"choices": choices, "usage": None} | others
        return json.dumps(head | body, separators=SEPARATORS, ensure_ascii=False)


def _head(job: str, kind: str, created_at: str, model: str) -> dict[str, Any]:
    created = int(datetime.fromisoformat(created_at).timestamp())
    return {"id": f"chatcmpl-{job}", "object": kind, "created": created, "model": model}


def _progress(job: Job) -> dict[str, Any]:
    return ChatProgress(job=job.id, status=job.status, stage=job.stage, progress=job.progress).model_dump()


def _content(answer: dict[str, Any]) -> str:
    """The answer in the form that the question asks for: a letter, a text, a line or JSON."""
    said = NOT_SURE if answer["answer"] is None else answer["answer"]
    reply = Reply(said, answer["option"], answer["reasoning"], answer["options_source"])
    return reply_text(answer["question"], reply)
