"""An MLLM that draws its answers at random with a known rate, behind OpenAI's chat completions on loopback.

It records every request as it came, and does what a request asks: `n` choices, log probabilities, reasoning, tool
calls, streams. `next_replies` says what it does instead for the next requests: errors, cut streams, silence.
"""

from __future__ import annotations

import json
import random
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from waiting import TIME_LIMIT

RATE = 0.3  # of "A"; else "B"
USAGE: dict[str, Any] = {
    "prompt_tokens": 21,
    "completion_tokens": 5,
    "total_tokens": 26,
    "prompt_tokens_details": {"cached_tokens": 4},
}

Instead = Callable[["_Handler"], None]


@dataclass
class Received:
    """A request as it came."""

    body: bytes
    headers: dict[str, str]  # names in lower case
    path: str

    @property
    def fields(self) -> dict[str, Any]:
        return json.loads(self.body)


@dataclass
class RandomMllm:
    """What it was sent, and its random numbers: the same number of requests draws the same letters."""

    address: str = ""
    received: list[Received] = field(default_factory=list)
    next_replies: list[Instead] = field(default_factory=list)
    draws: random.Random = field(default_factory=lambda: random.Random(1))
    lock: threading.Lock = field(default_factory=threading.Lock)
    left: threading.Event = field(default_factory=threading.Event)  # set where a caller went away

    def last(self) -> dict[str, Any]:
        return self.received[-1].fields

    def letter(self) -> str:
        with self.lock:
            return "A" if self.draws.random() < RATE else "B"

    def choice(self, index: int, asked: dict[str, Any]) -> dict[str, Any]:
        text = reply_to(asked, self.letter())
        message: dict[str, Any] = {"role": "assistant", "content": text}
        finish = "stop"
        if asked.get("tools") and asked.get("tool_choice") == "required":
            function = {"name": asked["tools"][0]["function"]["name"], "arguments": '{"letter": "A"}'}
            message |= {"content": None, "tool_calls": [{"id": "call_1", "type": "function", "function": function}]}
            finish = "tool_calls"
        template = asked.get("chat_template_kwargs") or {}
        if asked.get("enable_thinking") or template.get("enable_thinking"):
            message["reasoning_content"] = "It looks at the ball."
        logprobs = None
        if asked.get("logprobs"):
            top = [{"token": t, "logprob": -1.0, "bytes": [65]} for t in "AB"][: asked.get("top_logprobs") or 0]
            logprobs = {"content": [{"token": text[-1], "logprob": -0.3, "bytes": None, "top_logprobs": top}]}
        return {"index": index, "message": message, "finish_reason": finish, "logprobs": logprobs}

    def completion(self, asked: dict[str, Any]) -> dict[str, Any]:
        choices = [self.choice(index, asked) for index in range(asked.get("n") or 1)]
        head = {"id": f"chatcmpl-{len(self.received)}", "created": 1_700_000_000, "model": asked.get("model")}
        own = {"system_fingerprint": "fp_1", "own_field": {"kept": [1, 2.50]}}
        return {**head, "object": "chat.completion", "choices": choices, "usage": USAGE, **own}

    def chunks(self, asked: dict[str, Any]) -> Iterator[dict[str, Any]]:
        whole = self.completion(asked)
        head = {name: whole[name] for name in ("id", "created", "model")} | {"object": "chat.completion.chunk"}
        for choice in whole["choices"]:
            message, index = choice["message"], choice["index"]
            deltas: list[dict[str, Any]] = [{"role": "assistant", "content": ""}]
            if thought := message.get("reasoning_content"):
                deltas.append({"reasoning_content": thought})
            deltas += [{"tool_calls": [{"index": 0, **call}]} for call in message.get("tool_calls", ())]
            deltas += [{"content": word} for word in (message["content"] or "").splitlines(keepends=True)]
            for delta in deltas:
                yield head | {"choices": [{"index": index, "delta": delta, "finish_reason": None}]}
            yield head | {"choices": [{"index": index, "delta": {}, "finish_reason": choice["finish_reason"]}]}
        if (asked.get("stream_options") or {}).get("include_usage"):
            yield head | {"choices": [], "usage": USAGE}


def reply_to(asked: dict[str, Any], letter: str) -> str:
    """The letter in the form that the prompt asks for."""
    if "json template" in json.dumps(asked.get("messages")):
        return f"{{'Reasoning': 'It rolls on.', 'Answer': '{letter}'}}"
    return f"It rolls on.\n\nANSWER: {letter}"


class JsonHandler(BaseHTTPRequestHandler):
    """Sends JSON, and logs nothing."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True

    def log_message(self, format: str, *args: object) -> None:
        pass

    def send(self, status: int, body: object, content_type: str = "application/json", **headers: str) -> bool:
        """Whether the caller was still there."""
        data = body if isinstance(body, bytes) else json.dumps(body, indent=1).encode()
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        self.send_response(status)
        for name, value in {"content-type": content_type, "content-length": str(len(data)), **named}.items():
            self.send_header(name, value)
        with suppress(OSError):
            self.end_headers()
            self.wfile.write(data)
            return True
        return False


class _Handler(JsonHandler):
    mllm: RandomMllm
    asked: dict[str, Any]

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["content-length"]))
        headers = {name.lower(): value for name, value in self.headers.items()}
        with self.mllm.lock:
            self.mllm.received.append(Received(body, headers, self.path))
            instead = self.mllm.next_replies.pop(0) if self.mllm.next_replies else None
        self.asked = json.loads(body)
        if instead is not None:
            instead(self)
        elif self.asked.get("stream"):
            self.stream(True)
        else:
            self.send(200, self.mllm.completion(self.asked))

    def stream(self, whole: bool) -> None:
        self.send_response(200)
        self.send_header("content-type", "text/event-stream; charset=utf-8")
        self.send_header("transfer-encoding", "chunked")
        self.end_headers()
        events = [f"data: {json.dumps(chunk)}\n\n" for chunk in self.mllm.chunks(self.asked)]
        for event in [*events, "data: [DONE]\n\n"] if whole else events[:2]:
            self.wfile.write(f"{len(event.encode()):x}\r\n{event}\r\n".encode())
        if whole:
            self.wfile.write(b"0\r\n\r\n")
        else:
            self.close_connection = True


def failing(status: int, body: object, content_type: str = "application/json", **headers: str) -> Instead:
    return lambda handler: handler.send(status, body, content_type, **headers)


def cut(handler: _Handler) -> None:
    """A stream that breaks off after two chunks."""
    handler.stream(False)


def silent(handler: _Handler) -> None:
    """Nothing, until the caller goes away."""
    handler.connection.settimeout(TIME_LIMIT)
    with suppress(OSError):
        if handler.connection.recv(1) == b"":
            handler.mllm.left.set()
    handler.close_connection = True


class _Quiet(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 64

    def handle_error(self, request: object, client_address: object) -> None:
        pass  # callers that give up or are killed are what some tests are about


@contextmanager
def serving(handler: type[JsonHandler], port: int = 0) -> Iterator[str]:
    """Serves until the block ends, at any free port if 0; the base URL."""
    with _Quiet(("127.0.0.1", port), handler) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/v1"
        server.shutdown()


@contextmanager
def random_mllm(port: int = 0) -> Iterator[RandomMllm]:
    """Serves until the block ends; at any free port if 0."""
    mllm = RandomMllm()
    with serving(type("Handler", (_Handler,), {"mllm": mllm}), port) as mllm.address:
        yield mllm


if __name__ == "__main__":  # for trying `cow eval` without an MLLM
    with random_mllm(8009) as served:
        print(f"Replies at random: {served.address}", flush=True)
        threading.Event().wait()
