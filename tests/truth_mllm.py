"""An MLLM on loopback that knows the right answers, and gives them with a known probability: more where it sees frames.

A frame that is the image again tells it nothing. What it replies is drawn from its seed and from what it is asked.
"""

from __future__ import annotations

import hashlib
import json
import math
import random
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from random_mllm import JsonHandler, serving

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
    left: float = math.inf  # replies until it holds further ones back
    address: str = ""
    asked: Counter[str] = field(default_factory=Counter)
    waiting: Counter[str] = field(default_factory=Counter)  # what was asked and not replied to
    refuses: str = ""  # questions with this in them
    lock: threading.Condition = field(default_factory=threading.Condition)

    def reply(self, body: dict[str, Any]) -> tuple[str, str]:
        """The question, as a key, and the reply."""
        content = body["messages"][-1]["content"]
        text = "".join(part["text"] for part in content if part["type"] == "text")
        pictures = [part["image_url"]["url"] for part in content if part["type"] == "image_url"]
        key = hashlib.sha256("\n".join([text, *pictures]).encode()).hexdigest()
        with self.lock:
            self.asked[key] += 1
            self.waiting[key] += 1
        draws = random.Random(f"{self.seed} {key} 0")
        looked = len(set(pictures[1:])) > 1
        options = split_options(text.partition("\n\n")[0]).options
        right = next(truth for question, truth in self.truth.items() if text.startswith(question))
        others = [letter for letter, option in options if option != right]
        letter = next(letter for letter, option in options if option == right)
        if draws.random() >= (self.with_frames if looked else self.without):
            letter = draws.choice(others)
        return key, f"{{'Reasoning': 'It moves on.', 'Answer': '({letter})'}}"

    def hold_after(self, replies: float) -> None:
        """Sends so many more replies, those that it holds back among them."""
        with self.lock:
            self.left = replies
            self.lock.notify_all()

    def await_turn(self, key: str) -> None:
        with self.lock:
            self.lock.wait_for(lambda: self.left > 0)
            self.left -= 1
            self.waiting[key] -= 1


class _Handler(JsonHandler):
    mllm: TruthMllm

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["content-length"])))
        if self.mllm.refuses and self.mllm.refuses in json.dumps(body):
            self.send(400, {"error": {"message": "The model is away.", "type": "invalid_request_error"}})
            return
        key, text = self.mllm.reply(body)
        self.mllm.await_turn(key)
        choice = {"index": 0, "finish_reason": "stop", "message": {"role": "assistant", "content": text}}
        head = {"id": "x", "object": "chat.completion", "created": 0, "model": body["model"]}
        self.send(200, {**head, "choices": [choice], "usage": TOKENS})


def truth_of(items: list[Item]) -> dict[str, str]:
    """The right option of each item by the first part of its question."""
    return {
        item.question[0]: next(option.text for option in item.options if option.letter == item.answer) for item in items
    }


@contextmanager
def truth_mllm(items: list[Item], **known: Any) -> Iterator[TruthMllm]:
    """Serves until the block ends."""
    mllm = TruthMllm(truth_of(items), **known)
    with serving(type("Handler", (_Handler,), {"mllm": mllm})) as mllm.address:
        yield mllm
