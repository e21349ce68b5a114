"""Serves the toy multimodal LLM over OpenAI's chat completions, as vLLM would a large one: run it as a process.

    python serve_toy.py

Prints its address, then serves until it is killed. `transformers serve` would do, but it needs a video processor, and
with it torchvision, to serve a Qwen3-VL at all.
"""

from __future__ import annotations

import base64
import socket
from typing import Any

import uvicorn
from fastapi import FastAPI
from pydantic_ai.messages import (
    BinaryContent,
    ModelMessage,
    ModelRequest,
    ModelResponse,
    SystemPromptPart,
    TextPart,
    UserPromptPart,
)
from pydantic_ai.models import ModelRequestParameters
from pydantic_ai.output import OutputObjectDefinition
from pydantic_ai.settings import ModelSettings

from cow_service.readers.local.reader import load_local
from cow_service.settings import Settings

app = FastAPI()
model = load_local(Settings(mllm="tiny-qwen3-vl", device="cpu"))


@app.post("/v1/chat/completions")
async def complete(body: dict[str, Any]) -> dict[str, Any]:
    messages = [message(each) for each in body["messages"]]
    schema = body.get("response_format", {}).get("json_schema", {}).get("schema")
    asked = ModelRequestParameters(
        output_mode="text" if schema is None else "native",
        output_object=None if schema is None else OutputObjectDefinition(schema, "reply"),
    )
    settings = ModelSettings(**{k: body[k] for k in ("temperature", "seed", "max_tokens") if k in body})
    response = await model.request(messages, settings, asked)
    text = "".join(part.content for part in response.parts if isinstance(part, TextPart))
    usage = response.usage
    return {
        "id": "toy",
        "object": "chat.completion",
        "created": 0,
        "model": body["model"],
        "choices": [
            {
                "index": 0,
                "finish_reason": response.finish_reason,
                "message": {"role": "assistant", "content": text},
            }
        ],
        "usage": {
            "prompt_tokens": usage.input_tokens,
            "completion_tokens": usage.output_tokens,
            "total_tokens": usage.input_tokens + usage.output_tokens,
        },
    }


def message(each: dict[str, Any]) -> ModelMessage:
    content = each["content"]
    if each["role"] == "assistant":
        return ModelResponse(parts=[TextPart(content)])
    if each["role"] == "system":
        return ModelRequest(parts=[SystemPromptPart(content)])
    parts = [{"type": "text", "text": content}] if isinstance(content, str) else content
    said = [part["text"] if part["type"] == "text" else picture(part) for part in parts]
    return ModelRequest(parts=[UserPromptPart(said)])


def picture(part: dict[str, Any]) -> BinaryContent:
    head, _, data = part["image_url"]["url"].partition(",")
    return BinaryContent(base64.b64decode(data), media_type=head.removeprefix("data:").partition(";")[0])


if __name__ == "__main__":
    listening = socket.create_server(("127.0.0.1", 0))
    print(f"http://127.0.0.1:{listening.getsockname()[1]}/v1", flush=True)
    uvicorn.Server(uvicorn.Config(app, log_level="warning")).run(sockets=[listening])
