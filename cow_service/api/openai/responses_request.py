"""From a request of OpenAI's responses to the chat that asks the same. What needs state is refused by name."""

from __future__ import annotations

from typing import Any, cast

from cow_service.api.openai.chats import wrong

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
