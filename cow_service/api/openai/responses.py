"""From a request of OpenAI's responses to the chat that asks the same. What needs state is refused by name."""

from __future__ import annotations

import json
import time
import uuid
from collections.abc import AsyncGenerator, Iterator
from contextlib import aclosing, suppress
from dataclasses import dataclass, field
from typing import Any, cast

from cow_service.api.openai.chats import EXTENSION, as_json, wrong
from cow_service.api.openai.stream import Streamed, event_of, problem_of
from cow_service.errors import CowError

STATELESS = "this server keeps no state between responses"
STATEFUL = {  # fields that ask for state, each with values that do not
    "previous_response_id": ((None,), f"{STATELESS}: send the earlier turns in `input`"),
    "conversation": ((None,), f"{STATELESS}: send the earlier turns in `input`"),
    "store": ((None, False), f"{STATELESS}: leave it out, or say false"),
    "background": ((None, False), f"{STATELESS}: `stream`, or POST /simulate as a job"),
    "prompt": ((None,), "this server has no stored prompts: send the text in `instructions` and `input`"),
}
RENAMED = {"max_output_tokens": "max_completion_tokens"}
READ = ("input", "instructions", "text", "reasoning", "tools", "tool_choice", "top_logprobs", "include", "truncation")
LOGPROBS = "message.output_text.logprobs"  # of `include`
# `reasoning.encrypted_content` is for going on without state: replies hold their reasoning in plain text, if any.
INCLUDED = (LOGPROBS, "reasoning.encrypted_content")


def chat_fields(body: dict[str, Any]) -> dict[str, Any]:
    """The fields of the chat: those that both protocols have go on unchanged. Raises `InvalidRequest`."""
    for name, (values, remedy) in STATEFUL.items():
        if name in body and body[name] not in values:
            raise wrong(f"/{name}", remedy)
    others = {name: value for name, value in body.items() if name not in (*READ, *STATEFUL)}
    chat = {RENAMED.get(name, name): value for name, value in others.items()}
    if body.get("stream") is True:
        chat.setdefault("stream_options", {"include_usage": True})  # a response always says its usage
    system = [] if body.get("instructions") is None else [{"role": "system", "content": body["instructions"]}]
    chat["messages"] = [*system, *_messages(body.get("input"))]
    _add_format(chat, _object(body, "text"))
    _add_reasoning(chat, _object(body, "reasoning"))
    tools = [_tool(place, tool) for place, tool in enumerate(_array(body, "tools"))]
    if tools:
        chat["tools"] = tools
    if body.get("tool_choice") is not None:
        chat["tool_choice"] = _tool_choice(body["tool_choice"])
    include = _array(body, "include")
    if unknown := [str(each)[:60] for each in include if each not in INCLUDED]:
        raise wrong("/include", f"only {', '.join(INCLUDED)} can be included, not {', '.join(unknown)}")
    if LOGPROBS in include or body.get("top_logprobs"):
        chat |= {"logprobs": True} | ({"top_logprobs": body["top_logprobs"]} if body.get("top_logprobs") else {})
    if body.get("truncation") not in (None, "disabled"):
        raise wrong("/truncation", "takes only `disabled`: the MLLM is sent the whole input")
    return chat


def _messages(given: Any) -> list[dict[str, Any]]:
    if isinstance(given, str):
        return [{"role": "user", "content": given}]
    if not isinstance(given, list):
        raise wrong("/input", "is missing: give a text, or a list of items")
    messages: list[dict[str, Any]] = []
    for place, item in enumerate(cast("list[Any]", given)):
        message = _message(item, f"/input/{place}")
        before = messages[-1] if messages else {}
        if message is None:
            continue
        if "tool_calls" in message and before.get("role") == "assistant":
            before["tool_calls"] = [*before.get("tool_calls", ()), *message["tool_calls"]]  # one turn, several items
        else:
            messages.append(message)
    return messages


def _message(item: Any, pointer: str) -> dict[str, Any] | None:
    """The message of an item; none of what the MLLM thought before."""
    if not isinstance(item, dict):
        raise wrong(pointer, "is no object")
    given = cast("dict[str, Any]", item)
    kind = given.get("type", "message")
    if kind == "message":
        content = given.get("content")
        parts = content if isinstance(content, str) else [
            _part(part, f"{pointer}/content/{place}") for place, part in enumerate(_array(given, "content", pointer))
        ]  # fmt: skip
        return {"role": given.get("role", "user"), "content": parts}
    if kind == "function_call":
        function = {"name": given.get("name"), "arguments": given.get("arguments")}
        call = {"id": given.get("call_id"), "type": "function", "function": function}
        return {"role": "assistant", "content": None, "tool_calls": [call]}
    if kind == "function_call_output":
        output = given.get("output")
        if isinstance(output, list):
            output = [_part(part, f"{pointer}/output/{place}") for place, part in enumerate(cast("list[Any]", output))]
        return {"role": "tool", "tool_call_id": given.get("call_id"), "content": output}
    if kind == "reasoning":
        return None
    if kind == "item_reference":
        raise wrong(f"{pointer}/type", f"{STATELESS}: send the item itself")
    raise wrong(f"{pointer}/type", f"items of the type {str(kind)[:40]!r} cannot be sent on as a chat")


def _part(part: Any, pointer: str) -> dict[str, Any]:
    if not isinstance(part, dict):
        raise wrong(pointer, "is no object")
    given = cast("dict[str, Any]", part)
    kind = given.get("type")
    if kind in ("input_text", "output_text", "text"):
        return {"type": "text", "text": given.get("text", "")}
    if kind == "refusal":
        return {"type": "refusal", "refusal": given.get("refusal", "")}
    if kind == "input_image" and isinstance(given.get("image_url"), str):
        detail = {} if given.get("detail") is None else {"detail": given["detail"]}
        return {"type": "image_url", "image_url": {"url": given["image_url"], **detail}}
    if kind in ("input_image", "input_file") and given.get("file_id") is not None:
        raise wrong(f"{pointer}/file_id", f"{STATELESS}, and so no files: send the image itself as `image_url`")
    raise wrong(f"{pointer}/type", f"parts of the type {str(kind)[:40]!r} cannot be sent on as a chat")


def _add_format(chat: dict[str, Any], text: dict[str, Any]) -> None:
    kind = text.get("format")
    if isinstance(kind, dict) and kind.get("type") == "json_schema":
        schema = {name: value for name, value in cast("dict[str, Any]", kind).items() if name != "type"}
        chat["response_format"] = {"type": "json_schema", "json_schema": schema}
    elif kind is not None:
        chat["response_format"] = kind
    if text.get("verbosity") is not None:
        chat["verbosity"] = text["verbosity"]


def _add_reasoning(chat: dict[str, Any], reasoning: dict[str, Any]) -> None:
    if reasoning.get("effort") is not None:
        chat["reasoning_effort"] = reasoning["effort"]


def _tool(place: int, tool: Any) -> dict[str, Any]:
    if not isinstance(tool, dict) or tool.get("type") != "function":
        kind = str(tool.get("type"))[:40] if isinstance(tool, dict) else "none"
        raise wrong(
            f"/tools/{place}/type", f"{kind!r} is a tool of OpenAI's own servers: only `function` can be sent on"
        )
    function = {name: value for name, value in cast("dict[str, Any]", tool).items() if name != "type"}
    return {"type": "function", "function": function}


def _tool_choice(choice: Any) -> Any:
    if not isinstance(choice, dict):
        return choice
    if choice.get("type") != "function":
        raise wrong("/tool_choice/type", "only `function` can be chosen by name")
    return {"type": "function", "function": {"name": choice.get("name")}}


def _object(body: dict[str, Any], name: str) -> dict[str, Any]:
    value = body.get(name)
    if value is not None and not isinstance(value, dict):
        raise wrong(f"/{name}", "is no object")
    return value or {}


def _array(body: dict[str, Any], name: str, above: str = "") -> list[Any]:
    value = body.get(name)
    if value is not None and not isinstance(value, list):
        raise wrong(f"{above}/{name}", "is no array")
    return value or []


# Of the request, repeated in the response; what it leaves out has the value that stands here.
REPEATED: dict[str, Any] = {
    "instructions": None, "max_output_tokens": None, "metadata": {}, "parallel_tool_calls": True, "temperature": None,
    "tool_choice": "auto", "tools": [], "top_p": None, "reasoning": {"effort": None, "summary": None},
    "text": {"format": {"type": "text"}}, "truncation": "disabled", "user": None,
}  # fmt: skip
INCOMPLETE = {"length": "max_output_tokens", "content_filter": "content_filter"}  # by finish_reason


def new_id(kind: str) -> str:
    """A fresh id, such as `resp_...`."""
    return f"{kind}_{uuid.uuid4().hex}"


def empty_response(request: dict[str, Any], model: str) -> dict[str, Any]:
    """The response as it begins."""
    repeated = {name: value if request.get(name) is None else request[name] for name, value in REPEATED.items()}
    return {
        "id": new_id("resp"), "object": "response", "created_at": int(time.time()), "status": "in_progress",
        "error": None, "incomplete_details": None, "model": model, "output": [], "previous_response_id": None,
        "store": False, "background": False, "usage": None, **repeated,
    }  # fmt: skip


def response_of(completion: dict[str, Any], request: dict[str, Any]) -> dict[str, Any]:
    """The response that a whole completion comes to; of several choices the first."""
    choice = _first(completion.get("choices"))
    message = cast("dict[str, Any]", choice.get("message") or {})
    output: list[dict[str, Any]] = []
    if thought := message.get("reasoning_content") or message.get("reasoning"):
        output.append(reasoning_item(new_id("rs"), thought))
    if message.get("content") is not None or not message.get("tool_calls"):
        logprobs = (choice.get("logprobs") or {}).get("content") or []
        output.append(message_item(new_id("msg"), message.get("content") or "", logprobs, message.get("refusal")))
    output += [call_item(new_id("fc"), call) for call in message.get("tool_calls") or ()]
    begun = empty_response(request, completion.get("model", ""))
    return begun | ended(output, choice.get("finish_reason"), completion.get("usage"), completion.get(EXTENSION))


def ended(output: list[dict[str, Any]], finish_reason: Any, usage: Any, cow: Any) -> dict[str, Any]:
    """What a response has at its end that it did not have when it began."""
    reason = INCOMPLETE.get(finish_reason)
    told = {} if cow is None else {EXTENSION: cow}
    return {
        "status": "completed" if reason is None else "incomplete",
        "incomplete_details": None if reason is None else {"reason": reason},
        "output": output,
        "usage": usage_of(usage),
    } | told


def message_item(
    item: str, text: str, logprobs: list[Any] | None = None, refusal: Any = None, status: str = "completed"
) -> dict[str, Any]:
    """A message of the MLLM."""
    content: list[dict[str, Any]] = [text_part(text, logprobs)]
    if refusal:
        content = [{"type": "refusal", "refusal": refusal}]
    return {"id": item, "type": "message", "role": "assistant", "status": status, "content": content}


def text_part(text: str, logprobs: list[Any] | None = None) -> dict[str, Any]:
    """The text of a message."""
    return {"type": "output_text", "text": text, "annotations": [], "logprobs": logprobs or []}


def reasoning_item(item: str, text: str) -> dict[str, Any]:
    """What the MLLM thought, as far as its server shows it."""
    return {"id": item, "type": "reasoning", "summary": [], "content": [{"type": "reasoning_text", "text": text}]}


def call_item(item: str, call: dict[str, Any]) -> dict[str, Any]:
    """A call of a function."""
    function = call.get("function") or {}
    return {
        "id": item, "type": "function_call", "status": "completed", "call_id": call.get("id"),
        "name": function.get("name"), "arguments": function.get("arguments") or "",
    }  # fmt: skip


def usage_of(usage: Any) -> dict[str, Any] | None:
    """Tokens under the names that responses have for them."""
    if not isinstance(usage, dict):
        return None
    given = cast("dict[str, Any]", usage)
    read, written = given.get("prompt_tokens") or 0, given.get("completion_tokens") or 0
    cached = (given.get("prompt_tokens_details") or {}).get("cached_tokens") or 0
    thought = (given.get("completion_tokens_details") or {}).get("reasoning_tokens") or 0
    return {
        "input_tokens": read,
        "input_tokens_details": {"cached_tokens": cached},
        "output_tokens": written,
        "output_tokens_details": {"reasoning_tokens": thought},
        "total_tokens": given.get("total_tokens") or read + written,
    }


def _first(choices: Any) -> dict[str, Any]:
    held = cast("list[Any]", choices) if isinstance(choices, list) else []
    return cast("dict[str, Any]", held[0]) if held and isinstance(held[0], dict) else {}


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
