"""From a chat completion to a response of OpenAI's API."""

from __future__ import annotations

import time
import uuid
from typing import Any, cast

from cow_service.api.openai.chats import EXTENSION

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
