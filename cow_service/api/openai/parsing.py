"""From a chat with a model without an MLLM to the `AnswerRequest` that it asks for, and what of it is not used."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from cow_service.api.openai.chats import Chat, wrong
from cow_service.api.openai.messages import ImagePart, images_of, other_parts, role_of, texts_of
from cow_service.api.openai.models import Answerer
from cow_service.api.problems import invalid
from cow_service.errors import CowError, FieldError, InvalidRequest
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
