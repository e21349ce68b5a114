"""OpenAI's responses: converts them to chats and the replies back. Fields that need state are refused by name."""

import time
import uuid
from collections.abc import Iterator
from contextlib import aclosing
from dataclasses import dataclass, field, replace
from typing import Any, cast

from sse_starlette import ServerSentEvent

from cow_service.api.openai.chats import EXTENSION
from cow_service.api.openai.forwarding import Events
from cow_service.api.openai.stream import Streamed, chunks_of, data_of, event_of
from cow_service.api.problems import openai_error
from cow_service.errors import CowError, wrong

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
    chat = {RENAMED.get(name, name): value for name, value in body.items() if name not in (*READ, *STATEFUL)}
    if body.get("stream") is True:
        chat.setdefault("stream_options", {"include_usage": True})  # a response always says its usage
    system = [] if body.get("instructions") is None else [{"role": "system", "content": body["instructions"]}]
    given = body.get("input")
    asked = [{"role": "user", "content": given}] if isinstance(given, str) else _messages(given)
    chat["messages"] = [*system, *asked]
    text, reasoning = (
        _as_object({} if body.get(name) is None else body[name], f"/{name}") for name in ("text", "reasoning")
    )
    form = text.get("format")
    if isinstance(form, dict) and form.get("type") == "json_schema":
        form = {"type": "json_schema", "json_schema": _without_type(form)}
    tools: list[dict[str, Any]] = []
    for place, tool in enumerate(_array(body.get("tools"), "/tools")):
        if (kind := _as_object(tool, f"/tools/{place}").get("type")) != "function":
            shown = f"{str(kind)[:40]!r} is a tool of OpenAI's own servers"
            raise wrong(f"/tools/{place}/type", f"{shown}: only `function` can be sent on")
        tools.append({"type": "function", "function": _without_type(tool)})
    choice = body.get("tool_choice")
    if isinstance(choice, dict):
        named = cast("dict[str, Any]", choice)
        if named.get("type") != "function":
            raise wrong("/tool_choice/type", "only `function` can be chosen by name")
        choice = {"type": "function", "function": {"name": named.get("name")}}
    include = _array(body.get("include"), "/include")
    if unknown := [str(each)[:60] for each in include if each not in INCLUDED]:
        raise wrong("/include", f"only {', '.join(INCLUDED)} can be included, not {', '.join(unknown)}")
    if body.get("truncation") not in (None, "disabled"):
        raise wrong("/truncation", "takes only `disabled`: the MLLM is sent the whole input")
    alternatives = body.get("top_logprobs") or None
    changed = {
        "response_format": form,
        "verbosity": text.get("verbosity"),
        "reasoning_effort": reasoning.get("effort"),
        "tools": tools or None,
        "tool_choice": choice,
        "logprobs": True if LOGPROBS in include or alternatives else None,
        "top_logprobs": alternatives,
    }
    return chat | {name: value for name, value in changed.items() if value is not None}


def _messages(given: Any) -> Iterator[dict[str, Any]]:
    """The messages of the input; none of what the MLLM thought before."""
    if not isinstance(given, list):
        raise wrong("/input", "is missing: give a text, or a list of items")
    before: dict[str, Any] = {}
    for place, each in enumerate(cast("list[Any]", given)):
        pointer = f"/input/{place}"
        item = _as_object(each, pointer)
        match item.get("type", "message"):
            case "message":
                content = item.get("content")
                if not isinstance(content, str):
                    content = [*_parts(_array(content, f"{pointer}/content"), f"{pointer}/content")]
                message = {"role": item.get("role", "user"), "content": content}
            case "function_call":
                function = {"name": item.get("name"), "arguments": item.get("arguments")}
                call = {"id": item.get("call_id"), "type": "function", "function": function}
                if before.get("role") == "assistant":  # one turn, several items
                    before.setdefault("tool_calls", []).append(call)
                    continue
                message = {"role": "assistant", "content": None, "tool_calls": [call]}
            case "function_call_output":
                output = item.get("output")
                if isinstance(output, list):
                    output = [*_parts(cast("list[Any]", output), f"{pointer}/output")]
                message = {"role": "tool", "tool_call_id": item.get("call_id"), "content": output}
            case "reasoning":
                continue
            case "item_reference":
                raise wrong(f"{pointer}/type", f"{STATELESS}: send the item itself")
            case kind:
                raise wrong(f"{pointer}/type", f"items of the type {str(kind)[:40]!r} cannot be sent on as a chat")
        yield message
        before = message


def _parts(parts: list[Any], above: str) -> Iterator[dict[str, Any]]:
    """The parts of a message, or of what a function returned, as chats have them."""
    for place, each in enumerate(parts):
        pointer = f"{above}/{place}"
        match _as_object(each, pointer):
            case {"type": "input_text" | "output_text" | "text", **part}:
                yield {"type": "text", "text": part.get("text", "")}
            case {"type": "refusal", **part}:
                yield {"type": "refusal", "refusal": part.get("refusal", "")}
            case {"type": "input_image", "image_url": str(url), **part}:
                detail = {} if part.get("detail") is None else {"detail": part["detail"]}
                yield {"type": "image_url", "image_url": {"url": url, **detail}}
            case {"type": "input_image" | "input_file", "file_id": file} if file is not None:
                raise wrong(f"{pointer}/file_id", f"{STATELESS}, and so no files: send the image itself as `image_url`")
            case part:
                kind = str(part.get("type"))[:40]
                raise wrong(f"{pointer}/type", f"parts of the type {kind!r} cannot be sent on as a chat")


def _without_type(value: dict[str, Any]) -> dict[str, Any]:
    return {name: held for name, held in value.items() if name != "type"}


def _as_object(value: Any, pointer: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise wrong(pointer, "is no object")
    return cast("dict[str, Any]", value)


def _array(value: Any, pointer: str) -> list[Any]:
    """An array of the request, empty if it is left out."""
    if value is not None and not isinstance(value, list):
        raise wrong(pointer, "is no array")
    return value or []


# Fields of the request, repeated in the response, with the defaults given here.
REPEATED: dict[str, Any] = {
    "instructions": None, "max_output_tokens": None, "metadata": {}, "parallel_tool_calls": True, "temperature": None,
    "tool_choice": "auto", "tools": [], "top_p": None, "reasoning": {"effort": None, "summary": None},
    "text": {"format": {"type": "text"}}, "truncation": "disabled", "user": None,
}  # fmt: skip
INCOMPLETE = {"length": "max_output_tokens", "content_filter": "content_filter"}  # by finish_reason
ID_PREFIXES = {"message": "msg", "reasoning": "rs", "function_call": "fc"}


def response_of(completion: dict[str, Any], request: dict[str, Any]) -> dict[str, Any]:
    """The response for a whole completion; of several choices the first."""
    response = ResponseEvents(request, completion.get("model", ""))
    for chunk in chunks_of(completion, with_usage=True):
        list(response.add(chunk))  # only the sum of the events is wanted
    list(response.end())
    return response.response


def as_response(streamed: Streamed, request: dict[str, Any], model: str) -> Streamed:
    """A chat's stream as that of a response."""
    response = ResponseEvents(request, model)

    async def events() -> Events:
        for event in response.begin():
            yield event
        try:
            async with aclosing(streamed.events) as chunks:
                async for received in chunks:
                    chunk = data_of(received)
                    if isinstance(chunk.get("error"), dict):
                        yield response.fail(chunk["error"])
                        return
                    for event in response.add(chunk):
                        yield event
        except CowError as error:
            yield response.fail(openai_error(streamed.locate(error)))
            return
        for event in response.end():
            yield event

    return replace(streamed, events=events())


@dataclass
class _Item:
    """An item of the output that is being written."""

    kind: str  # message, reasoning or function_call
    id: str
    index: int  # in the output
    text: str = ""  # of a function call, its arguments
    refusal: str = ""
    call: dict[str, Any] = field(default_factory=dict[str, Any])
    logprobs: list[Any] = field(default_factory=list[Any])

    def as_output(self, status: str = "completed") -> dict[str, Any]:
        """The item as it stands in the output."""
        head = {"id": self.id, "type": self.kind}
        if self.kind == "reasoning":
            return head | {"summary": [], "content": [{"type": "reasoning_text", "text": self.text}]}
        if self.kind == "function_call":
            return head | {"status": status, **self.call, "arguments": self.text}
        part: dict[str, Any] = {"type": "refusal", "refusal": self.refusal}
        if not self.refusal:
            part = {"type": "output_text", "text": self.text, "annotations": [], "logprobs": self.logprobs}
        return head | {"role": "assistant", "status": status, "content": [part]}


class ResponseEvents:
    """Writes the events of one response, each with its number. `response` is the response so far."""

    def __init__(self, request: dict[str, Any], model: str) -> None:
        repeated = {name: value if request.get(name) is None else request[name] for name, value in REPEATED.items()}
        self.response: dict[str, Any] = {
            "id": _new_id("resp"), "object": "response", "created_at": int(time.time()), "status": "in_progress",
            "error": None, "incomplete_details": None, "model": model, "output": [], "previous_response_id": None,
            "store": False, "background": False, "usage": None, **repeated,
        }  # fmt: skip
        self._number = -1
        self._items: dict[str, _Item] = {}
        self._open: _Item | None = None
        self._finish_reason: Any = None

    def begin(self) -> Iterator[ServerSentEvent]:
        """The first two."""
        yield self._event("response.created", response=self.response)
        yield self._event("response.in_progress", response=self.response)

    def add(self, chunk: dict[str, Any]) -> Iterator[ServerSentEvent]:
        """The events for a chunk; of several choices the first is taken."""
        cow = chunk.get(EXTENSION)
        if isinstance(cow, dict) and "progress" not in cow:
            self.response = self.response | {EXTENSION: cow}
        if isinstance(usage := chunk.get("usage"), dict):
            self.response = self.response | {"usage": _usage_of(cast("dict[str, Any]", usage))}
        for choice in cast("list[dict[str, Any]]", chunk.get("choices") or ()):
            if choice.get("index", 0) == 0:
                yield from self._add_choice(choice)

    def end(self) -> Iterator[ServerSentEvent]:
        """The end of the last item, and the whole response."""
        if not {"message", "function_call"} & {item.kind for item in self._items.values()}:
            yield from self._switch_to("message", "message")
        yield from self._close()
        reason = INCOMPLETE.get(self._finish_reason)
        status = "completed" if reason is None else "incomplete"
        self.response = self.response | {
            "status": status,
            "incomplete_details": None if reason is None else {"reason": reason},
            "output": [item.as_output() for item in self._items.values()],
        }
        yield self._event(f"response.{status}", response=self.response)

    def fail(self, error: dict[str, Any]) -> ServerSentEvent:
        """The last event of a response that breaks off; `error` is OpenAI's."""
        flat = {name: error.get(name) for name in ("code", "message", "param")}
        return self._event("error", **flat, error=error)

    def _add_choice(self, choice: dict[str, Any]) -> Iterator[ServerSentEvent]:
        delta = cast("dict[str, Any]", choice.get("delta") or {})
        self._finish_reason = choice.get("finish_reason") or self._finish_reason
        if thought := delta.get("reasoning_content") or delta.get("reasoning"):
            yield from self._switch_to("reasoning", "reasoning")
            yield self._add_text("response.reasoning_text.delta", thought, content_index=0)
        if text := delta.get("content"):
            logprobs = (choice.get("logprobs") or {}).get("content") or []
            yield from self._switch_to("message", "message")
            self._items["message"].logprobs += logprobs
            yield self._add_text("response.output_text.delta", text, content_index=0, logprobs=logprobs)
        if refusal := delta.get("refusal"):
            yield from self._switch_to("message", "message")
            self._items["message"].refusal += refusal
        for call in cast("list[dict[str, Any]]", delta.get("tool_calls") or ()):
            function = call.get("function") or {}
            key = f"call {call.get('index', 0)}"
            yield from self._switch_to(key, "function_call", call_id=call.get("id"), name=function.get("name"))
            if arguments := function.get("arguments"):
                yield self._add_text("response.function_call_arguments.delta", arguments)

    def _switch_to(self, key: str, kind: str, **call: Any) -> Iterator[ServerSentEvent]:
        """Goes on with an item; the one before it is closed, a new one is opened."""
        if self._open is not None and self._items.get(key) is self._open:
            return
        yield from self._close()
        new = _Item(kind, _new_id(ID_PREFIXES[kind]), len(self._items), call=call)
        item = self._open = self._items.setdefault(key, new)
        begun = item.as_output("in_progress") | ({} if kind == "function_call" else {"content": []})
        yield self._event("response.output_item.added", output_index=item.index, item=begun)
        if kind == "message":
            part = {"type": "output_text", "text": "", "annotations": [], "logprobs": []}
            yield self._item_event("response.content_part.added", item, content_index=0, part=part)

    def _add_text(self, event: str, text: str, **others: Any) -> ServerSentEvent:
        assert self._open is not None
        self._open.text += text
        return self._item_event(event, self._open, delta=text, **others)

    def _close(self) -> Iterator[ServerSentEvent]:
        item, self._open = self._open, None
        if item is None:
            return
        whole = item.as_output()
        if item.kind == "message":
            text = {"text": item.text, "logprobs": item.logprobs}
            yield self._item_event("response.output_text.done", item, content_index=0, **text)
            yield self._item_event("response.content_part.done", item, content_index=0, part=whole["content"][0])
        elif item.kind == "reasoning":
            yield self._item_event("response.reasoning_text.done", item, content_index=0, text=item.text)
        else:
            arguments = {"name": whole["name"], "arguments": item.text}
            yield self._item_event("response.function_call_arguments.done", item, **arguments)
        yield self._event("response.output_item.done", output_index=item.index, item=whole)

    def _item_event(self, kind: str, item: _Item, **others: Any) -> ServerSentEvent:
        return self._event(kind, item_id=item.id, output_index=item.index, **others)

    def _event(self, kind: str, **others: Any) -> ServerSentEvent:
        self._number += 1
        return event_of({"type": kind, "sequence_number": self._number, **others}, kind)


def _new_id(prefix: str) -> str:
    return f"{prefix}_{uuid.uuid4().hex}"


def _usage_of(usage: dict[str, Any]) -> dict[str, Any]:
    """Tokens under the names that responses have for them."""
    read, written = usage.get("prompt_tokens") or 0, usage.get("completion_tokens") or 0
    cached = (usage.get("prompt_tokens_details") or {}).get("cached_tokens") or 0
    thought = (usage.get("completion_tokens_details") or {}).get("reasoning_tokens") or 0
    return {
        "input_tokens": read,
        "input_tokens_details": {"cached_tokens": cached},
        "output_tokens": written,
        "output_tokens_details": {"reasoning_tokens": thought},
        "total_tokens": usage.get("total_tokens") or read + written,
    }
