"""The bodies of `POST /v1/chat/completions` and `POST /v1/responses`, as far as COW itself reads them."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field


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
