"""A chat as it arrived: its text, which goes on unchanged, and what COW needs to know of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

from cow_service.api.body import read_object
from cow_service.api.openai.splicing import as_json, spliced
from cow_service.errors import FieldError, InvalidRequest

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
