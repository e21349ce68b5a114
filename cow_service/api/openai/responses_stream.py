"""From the chunks of a chat to the events of a response: what is written, as it is written."""

from __future__ import annotations

import json
from collections.abc import AsyncGenerator, Iterator
from contextlib import aclosing, suppress
from dataclasses import dataclass, field
from typing import Any, cast

from cow_service.api.openai.chats import EXTENSION
from cow_service.api.openai.responses_reply import (
    call_item,
    empty_response,
    ended,
    message_item,
    new_id,
    reasoning_item,
    text_part,
)
from cow_service.api.openai.splicing import as_json
from cow_service.api.openai.stream import Streamed, event_of, problem_of
from cow_service.errors import CowError


@dataclass
class _Item:
    """An item of the output that is being written."""

    kind: str  # message, reasoning or function_call
    id: str
    index: int  # in the output
    text: str = ""  # of a function call, its arguments
    call: dict[str, Any] = field(default_factory=dict[str, Any])
    logprobs: list[Any] = field(default_factory=list[Any])

    def whole(self, status: str = "completed") -> dict[str, Any]:
        """The item as it stands in the output."""
        if self.kind == "reasoning":
            return reasoning_item(self.id, self.text)
        if self.kind == "message":
            return message_item(self.id, self.text, self.logprobs, status=status)
        function = {"name": self.call.get("name"), "arguments": self.text}
        return call_item(self.id, {"id": self.call.get("id"), "function": function}) | {"status": status}


class ResponseEvents:
    """Writes the events of one response, each with its number."""

    def __init__(self, request: dict[str, Any], model: str) -> None:
        self._response = empty_response(request, model)
        self._number = -1
        self._items: dict[str, _Item] = {}
        self._open: _Item | None = None
        self._finish: Any = None
        self._usage: Any = None
        self._cow: Any = None

    def begun(self) -> Iterator[bytes]:
        """The first two."""
        yield self._event("response.created", response=self._response)
        yield self._event("response.in_progress", response=self._response)

    def chunk(self, chunk: dict[str, Any]) -> Iterator[bytes]:
        """What a chunk comes to; of several choices the first is taken."""
        told = chunk.get(EXTENSION)
        if isinstance(told, dict) and "progress" not in told:
            self._cow = told
        self._usage = chunk.get("usage") or self._usage
        for choice in cast("list[dict[str, Any]]", chunk.get("choices") or ()):
            if choice.get("index", 0) == 0:
                yield from self._choice(choice)

    def done(self) -> Iterator[bytes]:
        """The end of the last item, and the whole response."""
        if not self._items:
            yield from self._into("message", "message")
        yield from self._closed()
        output = [item.whole() for item in self._items.values()]
        self._response = self._response | ended(output, self._finish, self._usage, self._cow)
        yield self._event(f"response.{self._response['status']}", response=self._response)

    def failed(self, error: dict[str, Any]) -> bytes:
        """The last event of a response that breaks off; `error` is OpenAI's."""
        flat = {name: error.get(name) for name in ("code", "message", "param")}
        return self._event("error", **flat, error=error)

    def _choice(self, choice: dict[str, Any]) -> Iterator[bytes]:
        delta = cast("dict[str, Any]", choice.get("delta") or {})
        self._finish = choice.get("finish_reason") or self._finish
        if thought := delta.get("reasoning_content") or delta.get("reasoning"):
            yield from self._into("reasoning", "reasoning")
            yield from self._written("response.reasoning_text.delta", thought, content_index=0)
        if text := delta.get("content"):
            logprobs = (choice.get("logprobs") or {}).get("content") or []
            yield from self._into("message", "message")
            self._items["message"].logprobs += logprobs
            yield from self._written("response.output_text.delta", text, content_index=0, logprobs=logprobs)
        for call in cast("list[dict[str, Any]]", delta.get("tool_calls") or ()):
            function = call.get("function") or {}
            yield from self._into(
                f"call {call.get('index', 0)}", "function_call", id=call.get("id"), name=function.get("name")
            )
            if arguments := function.get("arguments"):
                yield from self._written("response.function_call_arguments.delta", arguments)

    def _into(self, key: str, kind: str, **call: Any) -> Iterator[bytes]:
        """Goes on with an item; the one before it is closed, a new one is opened."""
        if self._open is not None and self._items.get(key) is self._open:
            return
        yield from self._closed()
        names = {"message": "msg", "reasoning": "rs", "function_call": "fc"}
        item = self._open = self._items.setdefault(key, _Item(kind, new_id(names[kind]), len(self._items), call=call))
        begun = item.whole("in_progress")
        if kind != "function_call":
            begun |= {"content": []}
        yield self._event("response.output_item.added", output_index=item.index, item=begun)
        if kind == "message":
            yield self._in_item("response.content_part.added", content_index=0, part=text_part(""))

    def _written(self, event: str, text: str, **others: Any) -> Iterator[bytes]:
        assert self._open is not None
        self._open.text += text
        yield self._in_item(event, delta=text, **others)

    def _closed(self) -> Iterator[bytes]:
        item = self._open
        if item is None:
            return
        whole = item.whole()
        if item.kind == "message":
            yield self._in_item("response.output_text.done", content_index=0, text=item.text, logprobs=item.logprobs)
            yield self._in_item("response.content_part.done", content_index=0, part=whole["content"][0])
        elif item.kind == "reasoning":
            yield self._in_item("response.reasoning_text.done", content_index=0, text=item.text)
        else:
            yield self._in_item("response.function_call_arguments.done", name=whole["name"], arguments=item.text)
        yield self._event("response.output_item.done", output_index=item.index, item=whole)
        self._open = None

    def _in_item(self, kind: str, **others: Any) -> bytes:
        assert self._open is not None
        return self._event(kind, item_id=self._open.id, output_index=self._open.index, **others)

    def _event(self, kind: str, **others: Any) -> bytes:
        self._number += 1
        return event_of(as_json({"type": kind, "sequence_number": self._number, **others}), kind)


def as_response(streamed: Streamed, request: dict[str, Any], model: str) -> Streamed:
    """A chat's stream as that of a response."""
    return Streamed(_events(streamed, ResponseEvents(request, model)), streamed.located, streamed.left, streamed.close)


async def _events(streamed: Streamed, response: ResponseEvents) -> AsyncGenerator[bytes]:
    for event in response.begun():
        yield event
    try:
        async with aclosing(streamed.events) as chunks:
            async for chunk in chunks:
                value = _value_of(chunk)
                if isinstance(value.get("error"), dict):
                    yield response.failed(value["error"])
                    return
                for event in response.chunk(value):
                    yield event
    except CowError as error:
        yield response.failed(json.loads(problem_of(streamed.located(error)))["error"])
        return
    for event in response.done():
        yield event


def _value_of(event: bytes) -> dict[str, Any]:
    """The JSON object of an event; empty for the end, and for comments."""
    value: Any = None
    with suppress(ValueError):
        value = json.loads(b"".join(line[5:] for line in event.splitlines() if line.startswith(b"data:")))
    return cast("dict[str, Any]", value) if isinstance(value, dict) else {}
