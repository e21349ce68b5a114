"""Chats as clients of OpenAI's protocol send them."""

from __future__ import annotations

import json
from typing import Any

import httpx
from random_mllm import USAGE, Instead, failing
from servers import BODY, QUESTION, Served, data_url, picture

NAME = "cow/qwen3-vl-8b"
WITHOUT = f"{NAME}:no-imagination"
EMBEDDED = "cow/embedded"
KEY = "server-key-7f3a"  # of the MLLM, which no caller may see
CHOICES = f"{QUESTION} (A) Yes (B) No"
# What the reader would have to find, and a clip that takes no time.
COW = {name: BODY[name] for name in ("grounding", "motion", "num_frames", "frames")}
HELLO = [{"role": "user", "content": "hello"}]


def text(words: str) -> dict[str, Any]:
    return {"type": "text", "text": words}


def image(url: str | None = None, shift: int = 0, **others: Any) -> dict[str, Any]:
    return {"type": "image_url", "image_url": {"url": url or data_url(picture(shift)), **others}}


def user(*parts: dict[str, Any]) -> dict[str, Any]:
    return {"role": "user", "content": list(parts)}


def what_if(shift: int = 0, words: str = CHOICES, **others: Any) -> list[dict[str, Any]]:
    return [user(image(shift=shift, **others), text(words))]


def post(served: Served, body: Any, path: str = "chat/completions", **headers: str) -> httpx.Response:
    content = body if isinstance(body, bytes) else json.dumps(body).encode()
    return served.http.post(f"/v1/{path}", content=content, headers={"Content-Type": "application/json", **headers})


def told(response: httpx.Response) -> dict[str, Any]:
    """A reply."""
    assert response.status_code == 200, response.text
    return response.json()


def saying(words: str) -> Instead:
    """What the MLLM says in place of its own reply."""
    choice = {"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": words}}
    head = {"id": words, "object": "chat.completion", "created": 1, "model": "m"}
    return failing(200, {**head, "choices": [choice], "usage": USAGE})


def chunks_of(response: httpx.Response) -> list[dict[str, Any]]:
    """The chunks of a stream, as they came over the wire."""
    assert response.headers["content-type"].startswith("text/event-stream"), response.text
    *events, end = [block.removeprefix("data: ") for block in response.text.split("\n\n") if block.startswith("data")]
    assert end == "[DONE]"
    return [json.loads(event) for event in events]


def content_of(chunks: list[dict[str, Any]], index: int = 0) -> str:
    """The text that chunks come to."""
    choices = [choice for chunk in chunks for choice in chunk["choices"] if choice["index"] == index]
    return "".join(choice["delta"].get("content") or "" for choice in choices)
