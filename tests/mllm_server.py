"""An OpenAI-compatible server on loopback that says what a test tells it to, word for word, or fails as told."""

from __future__ import annotations

import base64
import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from random_mllm import JsonHandler, serving

Reply = Callable[["_Handler"], None]


@dataclass
class MllmServer:
    """What it was asked so far, and what it says next: `script` in order, its last entry for ever."""

    address: str = ""
    script: list[str | Reply] = field(default_factory=list)
    asked: list[dict[str, Any]] = field(default_factory=list)
    at_once: int = 0
    most_at_once: int = 0
    scripts: int = 0  # that were begun
    lock: threading.Lock = field(default_factory=threading.Lock)

    def say(self, *script: str | Reply) -> None:
        """Starts a new script."""
        with self.lock:
            self.script, self.asked = list(script), []
            self.at_once, self.most_at_once = 0, 0
            self.scripts += 1

    def next(self) -> str | Reply:
        return self.script.pop(0) if len(self.script) > 1 else self.script[0]

    def text(self, call: int) -> str:
        """All words of a call, in order."""
        return text_of(self.asked[call])

    def images(self, call: int) -> list[NDArray[np.uint8]]:
        """The pictures of a call, RGB, in order."""
        return images_of(self.asked[call])


def text_of(call: dict[str, Any]) -> str:
    """All words of a call, in order."""
    return "\n".join(part for message in call["messages"] for part in _texts(message["content"]))


def images_of(call: dict[str, Any]) -> list[NDArray[np.uint8]]:
    """The pictures of a call, RGB, in order."""
    parts = [p for m in call["messages"] if isinstance(m["content"], list) for p in m["content"]]
    urls = [part["image_url"]["url"] for part in parts if part["type"] == "image_url"]
    data = [np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8) for url in urls]
    return [np.asarray(cv2.imdecode(each, cv2.IMREAD_COLOR)[..., ::-1]) for each in data]


def _texts(content: Any) -> list[str]:
    if isinstance(content, str):
        return [content]
    return [part["text"] for part in content if part["type"] == "text"]


def completion(text: str | None, finish_reason: str = "stop") -> dict[str, Any]:
    return {
        "id": "x",
        "object": "chat.completion",
        "created": 1,
        "model": "scripted",
        "choices": [{"index": 0, "finish_reason": finish_reason, "message": {"role": "assistant", "content": text}}],
        "usage": {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110},
    }


class _Handler(JsonHandler):
    server_state: MllmServer
    body: dict[str, Any]  # of the call that is being answered
    of_script: int

    def do_POST(self) -> None:
        state = self.server_state
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        with state.lock:
            self.body = body | {"authorization": self.headers.get("authorization")}
            state.asked.append(self.body)
            self.of_script = state.scripts
            state.at_once += 1  # only what waits counts itself out again
            state.most_at_once = max(state.most_at_once, state.at_once)
            reply = state.next()
        if callable(reply):
            reply(self)
        else:
            self.send(200, completion(reply))


def status(code: int, **headers: str) -> Reply:
    """An error of that status."""
    return lambda handler: handler.send(code, {"error": {"message": "no", "type": "error"}}, **headers)


def raw(body: bytes, content_type: str = "application/json") -> Reply:
    """Status 200 with any bytes."""
    return lambda handler: handler.send(200, body, content_type)


def shaped(body: object) -> Reply:
    """Status 200 with any JSON."""
    return lambda handler: handler.send(200, body)


def finished(text: str | None, reason: str) -> Reply:
    return lambda handler: handler.send(200, completion(text, reason))


def slow(seconds: float, text: str = "{}") -> Reply:
    def reply(handler: _Handler) -> None:
        time.sleep(seconds)
        with handler.server_state.lock:  # before the reply: who gets it may ask again at once
            # A caller of an earlier script may have left before its reply.
            handler.server_state.at_once -= handler.of_script == handler.server_state.scripts
        handler.send(200, completion(text))

    return reply


def dropped(handler: _Handler) -> None:
    """The connection is reset without a word."""
    handler.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    handler.connection.close()
    handler.close_connection = True


@contextmanager
def mllm_server() -> Iterator[MllmServer]:
    """Serves until the block ends."""
    state = MllmServer()
    with serving(type("Handler", (_Handler,), {"server_state": state})) as state.address:
        yield state
