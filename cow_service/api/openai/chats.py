"""A chat as it arrived: its text, which goes on unchanged, and what COW needs to know of its messages."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, cast

from pydantic import BaseModel, ConfigDict, Field

from cow_service.api.body import read_object
from cow_service.errors import FieldError, InvalidRequest

_SPACE = re.compile(r"[ \t\r\n]*")
_DECODER = json.JSONDecoder()
SEPARATORS = (",", ":")


@dataclass(frozen=True)
class Member:
    """A member of an object: its key, and where it and its value stand in the text."""

    key: str
    start: int  # of the key
    value: int  # of the value
    end: int


def as_json(value: Any) -> str:
    """A value as compact JSON."""
    return json.dumps(value, separators=SEPARATORS, ensure_ascii=False)


def spliced(text: str, replaced: Mapping[str, str], *, dropped: str = "") -> str:
    """The object with these members replaced, each by JSON, or added at its end; and without the one named `dropped`.

    `text` must be one well-formed JSON object whose keys differ.
    """
    members = list(_members(text))
    edits: list[tuple[int, int, str]] = []
    for place, member in enumerate(members):
        if member.key in replaced:
            edits.append((member.value, member.end, replaced[member.key]))
        elif member.key == dropped:
            after = members[place + 1].start if place + 1 < len(members) else member.end
            edits.append((members[place - 1].end, member.end, "") if place else (member.start, after, ""))
    new = [f"{as_json(key)}:{value}" for key, value in replaced.items() if key not in {m.key for m in members}]
    if new:
        kept = [member for member in members if member.key != dropped]
        end = members[-1].end if members else text.index("{") + 1
        edits.append((end, end, ("," if kept else "") + ",".join(new)))
    parts: list[str] = []
    at = 0
    for start, end, value in edits:
        parts += [text[at:start], value]
        at = end
    return "".join([*parts, text[at:]])


def _members(text: str) -> Iterator[Member]:
    at = _after_space(text, text.index("{") + 1)
    while text[at] != "}":
        key, end = _DECODER.raw_decode(text, at)
        value = _after_space(text, _after_space(text, end) + 1)  # behind the colon
        _, stop = _DECODER.raw_decode(text, value)
        yield Member(key, at, value, stop)
        at = _after_space(text, stop)
        at = _after_space(text, at + 1) if text[at] == "," else at


def _after_space(text: str, at: int) -> int:
    found = _SPACE.match(text, at)
    return at if found is None else found.end()


@dataclass(frozen=True)
class ImagePart:
    """An image of a message."""

    url: str
    pointer: str  # JSON Pointer to the part
    url_pointer: str  # and to its URL
    role: str  # of its message
    detail: str | None  # that it is to be seen in, where the part says one

    @property
    def reference(self) -> str | dict[str, str]:
        """The image as requests have it."""
        return self.url if self.url[:5].lower() == "data:" else {"url": self.url}


def role_of(message: Any) -> str:
    """The role of a message; empty where it has none."""
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


EXTENSION = "cow"  # COW's own field of a request, and of a reply


@dataclass(frozen=True)
class Chat:
    """The body of a chat completion: one JSON object. Nothing of it is validated but what is a field here."""

    text: str
    fields: dict[str, Any]
    model: str
    stream: bool
    cow: dict[str, Any]  # what COW itself is told

    def sent(self, model: str, messages: list[Any] | None = None) -> bytes:
        """The body for the MLLM: as it arrived, but for the model's name, `cow`, and messages if others are given."""
        replaced = {"model": as_json(model)}
        if messages is not None:
            replaced["messages"] = as_json(messages)
        return spliced(self.text, replaced, dropped=EXTENSION).encode()

    def messages(self) -> list[Any]:
        """Its messages; none where the field holds something else, which is for the MLLM to say."""
        messages = self.fields.get("messages")
        return cast("list[Any]", messages) if isinstance(messages, list) else []


def read_chat(body: bytes) -> Chat:
    """The chat of a body. Raises `MalformedBody`, `InvalidRequest`."""
    text = body.decode("utf-8-sig", errors="replace")
    return chat_of(read_object(body, "The body"), text)


def chat_of(fields: dict[str, Any], text: str | None = None) -> Chat:
    """The chat of a JSON object, written here unless its text is given. Raises `InvalidRequest`."""
    model, cow = fields.get("model"), fields.get(EXTENSION)
    if not isinstance(model, str):
        raise wrong("/model", "is missing; give a name of `GET /v1/models`" if model is None else "is no text")
    if cow is not None and not isinstance(cow, dict):
        raise wrong(f"/{EXTENSION}", "is no object: give fields of `POST /simulate` in it")
    given = cast("dict[str, Any]", cow or {})
    return Chat(as_json(fields) if text is None else text, fields, model, fields.get("stream") is True, given)


def wrong(pointer: str, detail: str) -> InvalidRequest:
    """The error for one field."""
    return InvalidRequest(f"{pointer or 'The body'}: {detail}.", errors=(FieldError(pointer, detail),))


class ChatMessage(BaseModel):
    """One message. It goes on to the MLLM unchanged; imagined frames are added behind the last one of a user."""

    model_config = ConfigDict(extra="allow")

    role: str | None = None
    content: str | list[str | dict[str, Any]] | None = Field(default=None, description="Text, or parts.")


class ChatRequest(BaseModel):
    """A chat, as OpenAI's chat completions have it. All other fields go on to the MLLM unchanged, too.

    A model without an MLLM behind it, such as `cow/embedded`, answers the last user message about exactly one image;
    it uses no other field than these, and a warning names those that ask for something.
    """

    model_config = ConfigDict(extra="allow")

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


class ResponsesRequest(BaseModel):
    """A request of OpenAI's responses, without state. All other fields go on to the MLLM unchanged."""

    model_config = ConfigDict(extra="allow")

    model: str = Field(description="One of `GET /v1/models`.")
    input: str | list[dict[str, Any]] = Field(description="Text, or items: messages, function calls and their outputs.")
    instructions: str | None = Field(default=None, description="A system message before the input.")
    stream: bool | None = Field(default=None, description="Answer with server-sent events.")
    cow: dict[str, Any] | None = Field(default=None, description="As in chats.")
