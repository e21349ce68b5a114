"""An MLLM on loopback that knows the right answers, and gives them with a known probability: more where it sees frames.

A frame that is the image again tells it nothing. What it replies is drawn from its seed, from what it is asked and,
where `counted`, from how often it was asked the same before.
"""

from __future__ import annotations

import hashlib
import json
import math
import random
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from cow_service.evals.items import Item
from cow_service.readers.options import split_options

TOKENS = {"prompt_tokens": 400, "completion_tokens": 20, "total_tokens": 420}


@dataclass
class TruthMllm:
    """Who it knows, how good it is, and what it was asked."""

    truth: dict[str, str]  # text of the right option by the question's first part
    without: float = 0.5  # how often it is right of the image alone
    with_frames: float = 0.8
    seed: int = 0
    seconds: float = 0.0  # that a reply takes
    counted: bool = False
    address: str = ""
    asked: Counter[str] = field(default_factory=Counter)
    done: list[tuple[str, float, float]] = field(default_factory=list)  # what was asked, when, and when it was sent
    texts: list[str] = field(default_factory=list)
    images: list[int] = field(default_factory=list)
    refuses: str = ""  # questions with this in them
    lock: threading.Lock = field(default_factory=threading.Lock)

    def reply(self, body: dict[str, Any]) -> tuple[str, str]:
        """The question, as a key, and the reply."""
        content = body["messages"][-1]["content"]
        text = "".join(part["text"] for part in content if part["type"] == "text")
        pictures = [part["image_url"]["url"] for part in content if part["type"] == "image_url"]
        key = hashlib.sha256("\n".join([text, *pictures]).encode()).hexdigest()
        with self.lock:
            self.asked[key] += 1
            self.texts.append(text)
            self.images.append(len(pictures))
            number = self.asked[key] if self.counted else 0
        draws = random.Random(f"{self.seed} {key} {number}")
        looked = len(set(pictures[1:])) > 1
        options = split_options(text.partition("\n\n")[0]).options
        right = next(truth for question, truth in self.truth.items() if text.startswith(question))
        others = [letter for letter, option in options if option != right]
        letter = next(letter for letter, option in options if option == right)
        if draws.random() >= (self.with_frames if looked else self.without):
            letter = draws.choice(others)
        return key, f"{{'Reasoning': 'It moves on.', 'Answer': '({letter})'}}"


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    mllm: TruthMllm

    def log_message(self, format: str, *args: object) -> None:
        pass

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        if self.mllm.refuses and self.mllm.refuses in json.dumps(body):
            self.send(400, {"error": {"message": "The model is away.", "type": "invalid_request_error"}})
            return
        begun = time.monotonic()
        key, text = self.mllm.reply(body)
        time.sleep(self.mllm.seconds)
        choice = {"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": text}}
        head = {"id": "x", "object": "chat.completion", "created": 0, "model": body["model"]}
        sent = math.inf  # if the caller has left
        with suppress(OSError):
            self.send(200, {**head, "choices": [choice], "usage": TOKENS})
            sent = time.monotonic()
        self.mllm.done.append((key, begun, sent))

    def send(self, status: int, body: object) -> None:
        data = json.dumps(body).encode()
        self.send_response(status)
        self.send_header("content-type", "application/json")
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


class _Quiet(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 64

    def handle_error(self, request: object, client_address: object) -> None:
        pass  # callers that are killed are what some tests are about


def truth_of(items: list[Item]) -> dict[str, str]:
    """The right option of each item by the first part of its question."""
    return {
        item.question[0]: next(option.text for option in item.options if option.letter == item.answer) for item in items
    }


@contextmanager
def truth_mllm(items: list[Item], **known: Any) -> Iterator[TruthMllm]:
    """Serves until the block ends."""
    mllm = TruthMllm(truth_of(items), **known)
    with _Quiet(("127.0.0.1", 0), type("Handler", (_Handler,), {"mllm": mllm})) as server:
        mllm.address = f"http://127.0.0.1:{server.server_port}/v1"
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield mllm
        server.shutdown()
