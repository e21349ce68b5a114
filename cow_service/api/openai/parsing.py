"""From a chat to the `AnswerRequest` that it asks for: its question, image and model, and what of it is not used."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pydantic import ValidationError

from cow_service.api.body import read_object
from cow_service.api.openai.models import answerer
from cow_service.api.openai.requests import ChatMessage, ChatPart, ChatRequest, Neutral
from cow_service.api.problems import invalid
from cow_service.errors import CowError, FieldError, InvalidRequest
from cow_service.requests import AnswerRequest
from cow_service.service import Service

FIELDS_OF_CHAT = ("image", "question", "imagine", "reader")  # of an `AnswerRequest`: from messages and model


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


def parse_chat(body: bytes, service: Service) -> ParsedChat:
    """The chat of a body. Raises `MalformedBody`, `InvalidRequest`, `ModelNotFound`."""
    try:
        chat = ChatRequest.model_validate(read_object(body, "The body"))
    except ValidationError as error:
        raise invalid(error) from error
    model = answerer(service, chat.model)
    image, image_place = _image_of(chat.messages)
    place = max(place for place, message in enumerate(chat.messages) if message.role == "user")
    question = "\n".join(_texts(chat.messages[place]))
    if not question.strip():
        raise _wrong(f"/messages/{place}/content", "the last user message has no text: put the question there")
    given = chat.cow or {}
    for name in FIELDS_OF_CHAT:
        if name in given:
            raise _wrong(f"/cow/{name}", "is said by `messages` and `model`; leave it out")
    seeds: dict[str, int] = {} if chat.seed is None else {"seed": chat.seed}
    if seeds and "seed" in given:
        raise _wrong("/cow/seed", "stands in `seed`, too; give it once")
    pointers = FieldPointers(image_place, f"/messages/{place}/content", "/seed" if seeds else "/cow/seed")
    is_data = image[:5].lower() == "data:"
    fields = {**given, **seeds, "question": question, "image": image if is_data else {"url": image}}
    try:
        request = AnswerRequest.model_validate({**fields, "reader": model.reader, "imagine": model.imagine})
    except ValidationError as error:
        raise invalid(error, pointers.translate) from error
    limits = [limit for limit in (chat.max_tokens, chat.max_completion_tokens) if limit is not None]
    return ParsedChat(
        model=chat.model,
        request=request,
        pointers=pointers,
        warnings=tuple(_warnings(chat, place)),
        max_tokens=min(limits, default=None),
        stream=bool(chat.stream),
        with_usage=chat.stream_options is not None and bool(chat.stream_options.include_usage),
    )


def _image_of(messages: tuple[ChatMessage, ...]) -> tuple[str, str]:
    """The only image's URL, and where it stands. The same image may stand in several messages."""
    found: dict[str, str] = {}
    for pointer, message, part in _parts(messages):
        if part.image_url is not None:
            if message.role != "user":
                raise _wrong(pointer, f"images are read in `user` messages only, got one of `{message.role}`")
            found.setdefault(part.image_url.url, f"{pointer}/image_url/url")
    if not found:
        raise _wrong(
            f"/messages/{len(messages) - 1}/content" if messages else "/messages",
            "no user message has an image: add a part "
            '{"type": "image_url", "image_url": {"url": "data:image/png;base64,..."}}',
        )
    if len(found) > 1:
        detail = f"a question is about one image, got {len(found)}: send one"
        raise InvalidRequest(
            f"`messages`: {detail}.", errors=tuple(FieldError(pointer, detail) for pointer in found.values())
        )
    url, pointer = next(iter(found.items()))
    if not url[:8].lower().startswith(("data:", "http://", "https://")):
        raise _wrong(pointer, "is neither a data URL (data:image/png;base64,...) nor one of http or https")
    return url, pointer


def _parts(messages: tuple[ChatMessage, ...]) -> Iterator[tuple[str, ChatMessage, ChatPart]]:
    for place, message in enumerate(messages):
        for number, part in enumerate(message.content or ()):
            yield f"/messages/{place}/content/{number}", message, part


def _texts(message: ChatMessage) -> list[str]:
    return [part.text for part in message.content or () if part.text is not None]


def _warnings(chat: ChatRequest, question: int) -> Iterator[str]:
    """What of the chat has no effect."""
    unread = [
        f"{place} ({message.role})"
        for place, message in enumerate(chat.messages)
        if place != question and any(text.strip() for text in _texts(message))
    ]
    if unread:
        yield (
            f"The text of these `messages` was not read: {_some(unread)}. COW takes one image and one question: all "
            "that matters must stand in the last user message."
        )
    unused = [
        name
        for name, field in ChatRequest.model_fields.items()
        for neutral in field.metadata
        if isinstance(neutral, Neutral) and getattr(chat, name) not in (None, *neutral.values)
    ]
    if unused:
        yield f"Not used: {', '.join(f'`{name}`' for name in unused)}. COW asks with settings of its own."


def _some(names: list[str], most: int = 10) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _wrong(pointer: str, detail: str) -> InvalidRequest:
    return InvalidRequest(f"{pointer}: {detail}.", errors=(FieldError(pointer, detail),))
