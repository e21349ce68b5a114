"""A chat of OpenAI's protocol through pydantic-ai, for MLLMs that do not speak it.

What can be sent is; `ChatTurn.warnings` names the fields that were left out. Messages that cannot be sent are refused,
as leaving them out would change the question.
"""

import base64
import binascii
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, cast

from pydantic_ai import messages as ai
from pydantic_ai.models import Model, ModelRequestParameters
from pydantic_ai.output import OutputObjectDefinition
from pydantic_ai.settings import ModelSettings
from pydantic_ai.tools import ToolDefinition

from cow_service.errors import wrong

# OpenAI's names of settings, and pydantic-ai's. Of two names for one setting the later one counts.
SETTINGS = {
    "temperature": "temperature", "top_p": "top_p", "top_k": "top_k", "max_tokens": "max_tokens",
    "max_completion_tokens": "max_tokens", "stop": "stop_sequences", "seed": "seed",
    "presence_penalty": "presence_penalty", "frequency_penalty": "frequency_penalty", "logit_bias": "logit_bias",
    "parallel_tool_calls": "parallel_tool_calls", "tool_choice": "tool_choice",
}  # fmt: skip
READ = ("model", "messages", "stream", "stream_options", "tools", "response_format")  # beside the settings
# Values that ask for nothing.
NEUTRAL: dict[str, tuple[Any, ...]] = {"n": (1,), "logprobs": (False,), "response_format": ({"type": "text"},)}
FINISHED = {"stop": "stop", "length": "length", "content_filter": "content_filter", "tool_call": "tool_calls"}


@dataclass(frozen=True)
class PreparedChat:
    """A chat as pydantic-ai takes it."""

    messages: list[ai.ModelMessage]
    settings: ModelSettings
    parameters: ModelRequestParameters
    warnings: tuple[str, ...]


def prepare_chat(body: dict[str, Any], model: Model) -> PreparedChat:
    """The chat as far as the model takes it. Raises `InvalidRequest` for messages that cannot be sent."""
    left_out = [
        name
        for name, value in body.items()
        if name not in (*SETTINGS, *READ) and value is not None and value not in NEUTRAL.get(name, ())
    ]
    settings, refused = settings_of(body, model)
    left_out += refused
    parameters = ModelRequestParameters(function_tools=tools_of(body))
    response_format = body.get("response_format")
    if isinstance(response_format, dict) and response_format.get("type") == "json_schema":
        schema = _at(response_format, "/response_format", "json_schema", "schema")
        output = OutputObjectDefinition(schema, response_format["json_schema"].get("name", "reply"))
        parameters = replace(parameters, output_mode="native", output_object=output)
    elif response_format not in (None, *NEUTRAL["response_format"]):
        left_out.append("response_format")
    names = ", ".join(f"`{name}`" for name in left_out)
    warning = f"Not sent: {names}. This MLLM is not asked over OpenAI's protocol, and its own has no such field."
    warnings = (warning,) if left_out else ()
    return PreparedChat(list(_messages(body)), settings, parameters, warnings)


def settings_of(body: dict[str, Any], model: Model) -> tuple[ModelSettings, list[str]]:
    """The settings of a chat, and the names of those that the model does not take."""
    settings: dict[str, Any] = {}
    refused: list[str] = []
    for name, own in SETTINGS.items():
        if (value := body.get(name)) is None:
            continue
        if own in model.unsupported_settings or (name == "tool_choice" and not body.get("tools")):
            refused.append(name)
            continue
        if name == "stop" and isinstance(value, str):
            value = [value]
        elif name == "tool_choice" and isinstance(value, dict):
            value = [_at(value, "/tool_choice", "function", "name")]
        settings[own] = value
    return cast("ModelSettings", settings), refused


def tools_of(body: dict[str, Any]) -> list[ToolDefinition]:
    """The tools of a chat. Raises `InvalidRequest`."""
    tools: list[ToolDefinition] = []
    for place, tool in enumerate(_list_of(body, "tools")):
        pointer = f"/tools/{place}"
        if not isinstance(tool, dict) or tool.get("type", "function") != "function":
            raise wrong(pointer, "only tools of the type `function` can be sent to this MLLM")
        function = _at(tool, pointer, "function")
        name = _at(function, pointer + "/function", "name")
        schema = function.get("parameters") or {"type": "object", "properties": {}}
        tools.append(ToolDefinition(name=name, description=function.get("description"), parameters_json_schema=schema))
    return tools


def completion_of(response: ai.ModelResponse, model: str) -> dict[str, Any]:
    """The reply as a chat completion."""
    texts = [part.content for part in response.parts if isinstance(part, ai.TextPart)]
    thoughts = [part.content for part in response.parts if isinstance(part, ai.ThinkingPart) and part.content]
    calls = [part for part in response.parts if isinstance(part, ai.ToolCallPart)]
    message: dict[str, Any] = {"role": "assistant", "content": "".join(texts) if texts else None, "refusal": None}
    if thoughts:
        message["reasoning_content"] = "".join(thoughts)
    if calls:
        message["tool_calls"] = [
            {
                "id": call.tool_call_id,
                "type": "function",
                "function": {"name": call.tool_name, "arguments": call.args_as_json_str()},
            }
            for call in calls
        ]
    usage = response.usage
    finish = "tool_calls" if calls else FINISHED.get(response.finish_reason or "stop", "stop")
    return {
        "id": response.provider_response_id or f"chatcmpl-{uuid.uuid4()}",
        "object": "chat.completion",
        "created": int(time.time()),
        "model": response.model_name or model,
        "choices": [{"index": 0, "message": message, "finish_reason": finish, "logprobs": None}],
        "usage": {
            "prompt_tokens": usage.input_tokens,
            "completion_tokens": usage.output_tokens,
            "total_tokens": usage.input_tokens + usage.output_tokens,
        },
    }


def _messages(body: dict[str, Any]) -> Iterator[ai.ModelMessage]:
    tools: dict[str, str] = {}  # names of the tools that were called, by the id of the call
    for place, message in enumerate(_list_of(body, "messages")):
        pointer = f"/messages/{place}"
        if not isinstance(message, dict):
            raise wrong(pointer, "is no object")
        given = cast("dict[str, Any]", message)
        role, content = given.get("role"), list(_contents(given.get("content"), pointer + "/content"))
        if role in ("system", "developer"):
            yield ai.ModelRequest([ai.SystemPromptPart(_text(content, pointer))])
        elif role == "user":
            yield ai.ModelRequest([ai.UserPromptPart(content)])
        elif role == "assistant":
            calls: list[ai.ToolCallPart] = []
            for call in _list_of(given, "tool_calls"):
                name = _at(call, pointer + "/tool_calls", "function", "name")
                calls.append(ai.ToolCallPart(name, call["function"].get("arguments"), call.get("id", "")))
            tools |= {call.tool_call_id: call.tool_name for call in calls}
            texts = [ai.TextPart(text)] if (text := _text(content, pointer)) else []
            yield ai.ModelResponse([*texts, *calls])
        elif role == "tool":
            call = given.get("tool_call_id", "")
            result = ai.ToolReturnPart(tools.get(call, "tool"), _text(content, pointer), call)
            yield ai.ModelRequest([result])
        else:
            raise wrong(pointer + "/role", f"messages of the role {str(role)[:40]!r} cannot be sent to this MLLM")


def _contents(content: Any, pointer: str) -> Iterator[ai.UserContent]:
    parts: list[Any] = [content] if isinstance(content, str) else list(content or ())
    for number, part in enumerate(parts):
        place = f"{pointer}/{number}"
        if isinstance(part, str):
            yield part
        elif isinstance(part, dict) and isinstance(part.get("text"), str):
            yield part["text"]
        elif isinstance(part, dict) and part.get("type") == "image_url":
            given = part.get("image_url")
            url = given.get("url") if isinstance(given, dict) else given
            head, comma, data = str(url).partition(",")
            if not (comma and head.lower().startswith("data:image/") and head.lower().endswith(";base64")):
                raise wrong(place, "images are sent to this MLLM as data URLs (data:image/png;base64,...) only")
            try:
                yield ai.BinaryContent(base64.b64decode(data, validate=True), media_type=head[5:-7].lower())
            except binascii.Error as error:
                raise wrong(place, "the data URL is no base64") from error
        else:
            raise wrong(place, "only texts and images can be sent to this MLLM")


def _text(content: list[ai.UserContent], pointer: str) -> str:
    texts = [part for part in content if isinstance(part, str)]
    if len(texts) < len(content):
        raise wrong(pointer, "images can be sent to this MLLM in `user` messages only")
    return "\n".join(texts)


def _list_of(given: dict[str, Any], name: str) -> list[Any]:
    value = given.get(name)
    if value is not None and not isinstance(value, list):
        raise wrong(f"/{name}", "is no array")
    return value or []


def _at(value: Any, pointer: str, *names: str) -> Any:
    """What stands below these names. Raises `InvalidRequest` if one is missing."""
    for name in names:
        if not isinstance(value, dict) or name not in value:
            raise wrong(pointer, f"`{name}` is missing")
        value = cast("dict[str, Any]", value)[name]
    return value
