"""A whole chat completion as the chunks of a stream, where an MLLM gave it in one piece."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

from cow_service.api.openai.chats import EXTENSION
from cow_service.api.openai.splicing import as_json

HEAD = ("id", "created", "model", "system_fingerprint", "service_tier")


def chunks_of(completion: dict[str, Any], request: dict[str, Any]) -> Iterator[str]:
    """The chunks as JSON: `cow`, each choice's message, each choice's end, and usage where the request wants it.

    An error is its only chunk.
    """
    if "error" in completion:
        yield as_json({"error": completion["error"]})
        return
    head = {name: completion[name] for name in HEAD if name in completion} | {"object": "chat.completion.chunk"}
    empty = {"index": 0, "delta": {}, "finish_reason": None}
    if EXTENSION in completion:
        yield as_json(head | {"choices": [empty], EXTENSION: completion[EXTENSION]})
    choices = cast("list[dict[str, Any]]", completion.get("choices") or [])
    for place, choice in enumerate(choices):
        at = {"index": choice.get("index", place)}
        message = {name: value for name, value in choice.get("message", {}).items() if value is not None}
        calls = message.get("tool_calls", ())
        if calls:
            message["tool_calls"] = [{"index": number, **call} for number, call in enumerate(calls)]
        first = {**at, "delta": message, "finish_reason": None, "logprobs": choice.get("logprobs")}
        yield as_json(head | {"choices": [first]})
        yield as_json(head | {"choices": [{**at, "delta": {}, "finish_reason": choice.get("finish_reason")}]})
    options = request.get("stream_options")
    if isinstance(options, dict) and options.get("include_usage") and "usage" in completion:
        yield as_json(head | {"choices": [], "usage": completion["usage"]})
