"""A chat as it arrived, and what COW needs to know about it. Its meaning is forwarded unchanged."""

import base64
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self, cast

from pydantic import BaseModel, Field

from cow_service.errors import CowError, FieldError, InvalidRequest, pointer_part, shortened, wrong
from cow_service.service import Service

MAX_URLS = 16  # of one chat: each may take 10 s to look up or to fetch
MAX_LEVELS = 20  # of a message
DATA, _SCHEME = ("data", "uri"), re.compile(r"\s*[a-zA-Z][a-zA-Z0-9+.-]*:")  # base64 has no colon
MEDIA = ("url", "image", "video", "audio")  # ends of the names that fields with URLs have in parts of a message
EXTENSION = "cow"  # COW's own field of a request, and of a reply


def as_json(value: Any) -> str:
    """A value as compact JSON. Only ASCII: replies of an MLLM may hold halves of surrogate pairs."""
    return json.dumps(value, separators=(",", ":"))


@dataclass(frozen=True)
class ImagePart:
    """An image of a message."""

    url: str
    pointer: str  # JSON Pointer to the part
    url_pointer: str  # and to its URL
    role: str  # of its message
    detail: str | None  # the resolution it is to be seen in, where the part says one

    @property
    def reference(self) -> str | dict[str, str]:
        """The image as requests have it."""
        return self.url if self.url[:5].lower() == "data:" else {"url": self.url}


@dataclass(frozen=True)
class Chat:
    """The body of a chat completion. Only the fields declared here are validated."""

    fields: dict[str, Any]
    model: str
    stream: bool
    cow: dict[str, Any]  # COW's own options

    @classmethod
    def parse(cls, fields: dict[str, Any]) -> Self:
        """The chat of a JSON object. Raises `InvalidRequest`."""
        model, cow = fields.get("model"), fields.get(EXTENSION)
        if not isinstance(model, str):
            raise wrong("/model", "is missing; give a name of `GET /v1/models`" if model is None else "is no text")
        if cow is not None and not isinstance(cow, dict):
            raise wrong(f"/{EXTENSION}", "is no object: give fields of `POST /simulate` in it")
        return cls(fields, model, fields.get("stream") is True, cast("dict[str, Any]", cow or {}))

    @property
    def messages(self) -> list[Any]:
        """Its messages; none where the field holds something else, which is for the MLLM to say."""
        messages = self.fields.get("messages")
        return cast("list[Any]", messages) if isinstance(messages, list) else []

    @property
    def with_usage(self) -> bool:
        """Whether a stream is to end with a chunk that has `usage`."""
        options = self.fields.get("stream_options")
        return isinstance(options, dict) and bool(cast("dict[str, Any]", options).get("include_usage"))

    def question(self) -> tuple[int, str]:
        """The place of the last user message, -1 where there is none, and its text."""
        place = max((place for place, each in enumerate(self.messages) if role_of(each) == "user"), default=-1)
        return place, "" if place < 0 else "\n".join(texts_of(self.messages[place]))


def role_of(message: Any) -> str:
    """The role of a message; empty if it has none."""
    role = cast("dict[str, Any]", message).get("role") if isinstance(message, dict) else None
    return role if isinstance(role, str) else ""


def texts_of(message: Any) -> list[str]:
    """The texts of a message."""
    return [part["text"] for _, _, part in _parts([message]) if isinstance(part.get("text"), str)]


def images_of(messages: list[Any]) -> Iterator[ImagePart]:
    """The images of all messages, in order."""
    for pointer, role, part in _parts(messages):
        given = part.get("image_url")
        nested = isinstance(given, dict)
        held = cast("dict[str, Any]", given) if nested else {"url": given}
        url, detail = held.get("url"), held.get("detail")
        if isinstance(url, str):
            place = f"{pointer}/image_url" + ("/url" if nested else "")
            yield ImagePart(url, pointer, place, role, detail if isinstance(detail, str) else None)


def other_parts(messages: list[Any]) -> Iterator[tuple[str, str]]:
    """JSON Pointer and type of every part that is neither a text nor an image."""
    for pointer, _, part in _parts(messages):
        if part.get("image_url") is None and not isinstance(part.get("text"), str) and part.get("type") != "refusal":
            yield pointer, f"`{str(part.get('type'))[:40]}`"


def _parts(messages: list[Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """JSON Pointer, role and part; a text alone is one part."""
    for place, message in enumerate(messages):
        content = cast("dict[str, Any]", message).get("content") if isinstance(message, dict) else None
        pointer = f"/messages/{place}/content"
        if isinstance(content, str):
            yield pointer, role_of(message), {"type": "text", "text": content}
        for number, part in enumerate(cast("list[Any]", content) if isinstance(content, list) else ()):
            held: Any = {"type": "text", "text": part} if isinstance(part, str) else part
            if isinstance(held, dict):
                yield f"{pointer}/{number}", role_of(message), cast("dict[str, Any]", held)


@dataclass(frozen=True)
class MediaUrl:
    """A URL in a part of a message: a field of an object of the chat."""

    holder: Any
    key: Any
    pointer: str
    is_picture: bool


def media_urls(value: Any, pointer: str = "/messages", name: str = "") -> Iterator[MediaUrl]:
    """The URLs of pictures, videos and sounds anywhere in messages, or in the field `name` of one; data URLs are none.

    Raises `InvalidRequest`.
    """
    if pointer.count("/") > MAX_LEVELS:
        raise wrong("/messages", f"is nested too deep: no part needs more than {MAX_LEVELS} levels")
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in cast("Iterator[tuple[Any, Any]]", items):
        below = f"{pointer}/{pointer_part(key)}"
        kind = name if isinstance(key, int) or (key == "url" and "image" in name) else key
        if not isinstance(each, str) and key != "annotations":  # of earlier replies: pages that were cited
            yield from media_urls(each, below, kind)
        elif isinstance(each, str) and _leads_elsewhere(kind, each):
            yield MediaUrl(value, key, below, "image" in kind)


def _leads_elsewhere(kind: str, text: str) -> bool:
    """Whether a field of a part has a URL that is none of data. Data of sounds and files may have one in its place."""
    is_media = kind.endswith(MEDIA) or (kind.endswith(DATA) and _SCHEME.match(text) is not None)
    return is_media and text[:5].lower() != "data:"


def check_passed_on(chat: Chat, allowed: str) -> None:
    """Raises `InvalidRequest` for a field that is neither OpenAI's nor among those allowed (`COW_CHAT_FIELDS`).

    Servers take fields that set more than a caller's own chat, such as a template that runs there.
    """
    from openai.types.chat import completion_create_params as openai  # noqa: PLC0415 # an extra, as the reader is

    known = {*openai.CompletionCreateParamsBase.__annotations__, "stream", EXTENSION, *re.findall(r"[^\s,]+", allowed)}
    for name, value in chat.fields.items():
        if name not in known and value is not None:
            remedy = "leave it out, or have the server's operator list it in COW_CHAT_FIELDS"
            raise wrong(f"/{pointer_part(name)}", f"is no field of OpenAI's chats, so it is not passed on: {remedy}")


def fetch_pictures(urls: Sequence[MediaUrl], service: Service) -> tuple[None, int]:
    """Puts data in the place of the URLs of pictures; its second result is the number of bytes fetched.

    The MLLM's server fetches videos and sounds itself, so that only their host is checked. Raises `InvalidRequest`, and
    the errors of `ImageUrls.fetch` and `Service.check_image`.
    """
    fetched: dict[str, str] = {}
    size = 0
    if len({each.holder[each.key] for each in urls}) > MAX_URLS:
        raise wrong("/messages", f"hold more than {MAX_URLS} URLs of pictures, videos and sounds: send data")
    for each in urls:
        url = each.holder[each.key]
        try:
            if not each.is_picture:
                service.image_urls.check(url)
                continue
            if url not in fetched:
                data = service.image_urls.fetch(url)
                size += len(data)
                if size > service.settings.max_body_mb * 1e6:
                    raise InvalidRequest("The pictures by URL have more bytes than a body may have: send smaller ones.")
                fetched[url] = f"data:{service.check_image(data)};base64,{base64.b64encode(data).decode()}"
            each.holder[each.key] = fetched[url]
        except CowError as error:
            detail = f"'{shortened(url)}' is not sent on. {error.detail}"
            raise type(error)(f"{each.pointer}: {detail}", errors=(FieldError(each.pointer, detail),)) from error
    return None, size


def point_into_chat(pointer: str, own: Mapping[str, str]) -> str:
    """The JSON Pointer into a chat for one into the request made of it; `own` has those outside the field `cow`."""
    head = "/".join(pointer.split("/")[:2])
    return own.get(head, f"/{EXTENSION}{pointer}") if pointer else ""


def locate_in_chat(error: CowError, own: Mapping[str, str]) -> CowError:
    """An error of the request made of a chat, pointing into the chat."""
    fields = tuple(FieldError(point_into_chat(field.pointer, own), field.detail) for field in error.errors)
    located = type(error)(error.detail, remedy=error.remedy, errors=fields, headers=error.headers)
    located.usage, located.refusal = error.usage, error.refusal
    return located


class ChatMessage(BaseModel, extra="allow"):
    """One message. Pictures by URL go on as data, and imagined frames are added behind the last one of a user."""

    role: str | None = None
    content: str | list[str | dict[str, Any]] | None = Field(default=None, description="Text, or parts.")


class ChatRequest(BaseModel, extra="allow"):
    """A chat, as OpenAI's chat completions have it. All its other fields go on to the MLLM unchanged, and so do those
    that the server's operator lists (`COW_CHAT_FIELDS`); more are refused.

    A model without an MLLM behind it, such as `cow/embedded`, answers the last user message about exactly one image;
    it uses no other field than these, and a warning names those that ask for something.
    """

    model: str = Field(description="One of `GET /v1/models`.")
    messages: list[ChatMessage] = Field(min_length=1)
    stream: bool | None = Field(default=None, description="Answer with server-sent events.")
    stream_options: dict[str, Any] | None = None
    seed: int | None = Field(
        default=None, description="Goes on to the MLLM; of `cow/embedded`, `seed` of `AnswerRequest`."
    )
    cow: dict[str, Any] | None = Field(
        default=None, description="COW's own: fields of `SimulateRequest`; of `cow/embedded`, of `AnswerRequest`."
    )


class ResponsesRequest(BaseModel, extra="allow"):
    """A request of OpenAI's responses, without state. Other fields are as in chats."""

    model: str = Field(description="One of `GET /v1/models`.")
    input: str | list[dict[str, Any]] = Field(description="Text, or items: messages, function calls and their outputs.")
    instructions: str | None = Field(default=None, description="A system message before the input.")
    stream: bool | None = Field(default=None, description="Answer with server-sent events.")
    cow: dict[str, Any] | None = Field(default=None, description="As in chats.")
