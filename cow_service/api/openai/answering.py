"""Chats with a model without an MLLM: the last user message becomes an `AnswerRequest`, and its answer the reply."""

import json
from collections.abc import Iterator
from contextlib import aclosing
from dataclasses import dataclass
from typing import Any

from anyio import to_thread
from pydantic import ValidationError
from sse_starlette import ServerSentEvent

from cow_service.api.openai import chats
from cow_service.api.openai.forwarding import Events
from cow_service.api.openai.records import Answerer
from cow_service.api.openai.stream import LAST_EVENT, chunk_of, event_of, follow_job, job_head, progress_chunk
from cow_service.api.problems import invalid
from cow_service.api.submission import Submission, Submitter
from cow_service.errors import FieldError, InvalidRequest, listed, wrong
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
NOT_SURE = "Not sure"


@dataclass(frozen=True)
class ParsedChat:
    """A chat that was parsed and validated. It is not a job yet."""

    chat: chats.Chat
    request: AnswerRequest
    pointers: dict[str, str]  # by field of the request: JSON Pointers into the chat


def parse_chat(chat: chats.Chat, model: Answerer) -> ParsedChat:
    """The answer that a chat asks for. Raises `InvalidRequest`."""
    if not chat.messages:
        raise wrong("/messages", "is missing: send the image and the question in one user message")
    image = _image_of(chat.messages)
    place, question = chat.question()
    if not question.strip():
        raise wrong(f"/messages/{place}/content", "the last user message has no text: put the question there")
    for name in FIELDS_OF_CHAT:
        if name in chat.cow:
            raise wrong(f"/cow/{name}", "is said by `messages` and `model`; leave it out")
    seed = chat.fields.get("seed")
    seeds: dict[str, Any] = {} if seed is None else {"seed": seed}
    if seeds and "seed" in chat.cow:
        raise wrong("/cow/seed", "stands in `seed`, too; give it once")
    pointers = {"/image": image.url_pointer, "/question": f"/messages/{place}/content", "/reader": "/model"}
    pointers |= {"/seed": "/seed"} if seeds else {}
    fields = {**chat.cow, **seeds, "question": question, "image": image.reference}
    try:
        request = AnswerRequest.model_validate({**fields, "reader": model.reader, "imagine": model.imagine})
    except ValidationError as error:
        raise invalid(error, lambda pointer: chats.point_into_chat(pointer, pointers)) from error
    return ParsedChat(chat, request, pointers)


def _image_of(messages: list[Any]) -> chats.ImagePart:
    """The only image. The same image may stand in several messages."""
    for pointer, kind in chats.other_parts(messages):
        raise wrong(f"{pointer}/type", f"is {kind}: only parts of the types `text` and `image_url` are read")
    found: dict[str, chats.ImagePart] = {}
    for image in chats.images_of(messages):
        if image.role != "user":
            raise wrong(image.pointer, f"images are read in `user` messages only, got one of `{image.role}`")
        found.setdefault(image.url, image)
    if not found:
        part = '{"type": "image_url", "image_url": {"url": "data:image/png;base64,..."}}'
        raise wrong(f"/messages/{len(messages) - 1}/content", f"no user message has an image: add a part {part}")
    if len(found) > 1:
        detail = f"a question is about one image, got {len(found)}: send one"
        places = tuple(FieldError(image.url_pointer, detail) for image in found.values())
        raise InvalidRequest(f"`messages`: {detail}.", errors=places)
    image = next(iter(found.values()))
    if not image.url[:8].lower().startswith(("data:", "http://", "https://")):
        raise wrong(image.url_pointer, "is neither a data URL (data:image/png;base64,...) nor one of http or https")
    return image


def _warnings(chat: chats.Chat, answer: str) -> Iterator[str]:
    """What of the chat has no effect."""
    question, _ = chat.question()
    unread = [
        f"{place} ({chats.role_of(message)})"
        for place, message in enumerate(chat.messages)
        if place != question and any(text.strip() for text in chats.texts_of(message))
    ]
    if unread:
        yield (
            f"The text of these `messages` was not read: {listed(unread, 10)}. This model takes one image and one "
            "question: all that matters must stand in the last user message."
        )
    fields = chat.fields.items()
    if unused := [f"`{name[:40]}`" for name, value in fields if name not in SILENT and _has_effect(name, value)]:
        yield f"Not used: {listed(unused, 10)}. This model has no MLLM behind it that could use them."
    limits = [limit for name in ("max_tokens", "max_completion_tokens") if type(limit := chat.fields.get(name)) is int]
    if limits and len(answer.split()) > min(limits):
        yield f"The answer is longer than {min(limits)} tokens: answers are not cut."


def _has_effect(name: str, value: Any) -> bool:
    if value is None or value is False or value in ([], {}, ""):
        return False
    return isinstance(value, bool) or value not in NEUTRAL.get(name, ())


def completion_of(parsed: ParsedChat, result: str) -> dict[str, Any]:
    """The `ChatCompletion` of a job's result. CPU work: not for the event loop."""
    answer = json.loads(result)  # as plain values: validating its thousands of numbers again would take long
    said = NOT_SURE if answer["answer"] is None else answer["answer"]
    reply = Reply(said, answer["option"], answer["reasoning"], answer["options_source"])
    content = reply_text(answer["question"], reply)  # a letter, a text, a line or JSON: as the question asks
    answer["warnings"] = [*_warnings(parsed.chat, content), *answer["warnings"]]
    message = {"content": content, "reasoning_content": answer["reasoning"] or None, "refusal": None}
    read, written = answer["usage"]["input_tokens"], answer["usage"]["output_tokens"]
    choice = {"index": 0, "message": {"role": "assistant"} | message, "finish_reason": "stop", "logprobs": None}
    return job_head(answer["id"], answer["created_at"], parsed.chat.model) | {
        "object": "chat.completion",
        "choices": [choice],
        "usage": {"prompt_tokens": read, "completion_tokens": written, "total_tokens": read + written},
        "cow": answer,
    }


async def answer_events(
    submitter: Submitter, submission: Submission, parsed: ParsedChat, created_at: str | None
) -> Events:
    """The chunks of an answer job: progress first. Raises what the job fails with."""
    head: dict[str, Any] = {}
    async with aclosing(follow_job(submitter, submission, created_at)) as updates:
        async for update in updates:
            if not isinstance(update, Job):
                for event in await to_thread.run_sync(_last_events, parsed, update, head):
                    yield event
            elif head:
                yield progress_chunk(update, head)
            else:
                head = job_head(update.id, update.created_at, parsed.chat.model) | {"usage": None}
                yield progress_chunk(update, head, {"role": "assistant", "content": ""})
    yield LAST_EVENT


def _last_events(parsed: ParsedChat, result: str, head: dict[str, Any]) -> list[ServerSentEvent]:
    """The message, its end, and its tokens where they were asked for. CPU work: not for the event loop."""
    completion = completion_of(parsed, result)
    message = completion["choices"][0]["message"]
    deltas = [{name: message[name]} for name in ("reasoning_content", "content") if message[name] is not None]
    chunks = [chunk_of(head, delta) for delta in deltas]
    chunks.append(chunk_of(head, {}, "stop", cow=completion["cow"]))
    if parsed.chat.with_usage:
        chunks.append(head | {"choices": [], "usage": completion["usage"]})
    return [event_of(chunk) for chunk in chunks]
