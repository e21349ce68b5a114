"""An answer as a chat completion, at once or in chunks."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any

from cow_service.api.openai.parsing import ParsedChat
from cow_service.api.openai.records import ChatChoice, ChatDelta, ChatProgress, ChatReply, ChatUsage, ChunkChoice
from cow_service.readers.options import Reply, reply_text
from cow_service.records import Job

NOT_SURE = "Not sure"
SEPARATORS = (",", ":")


@dataclass(frozen=True)
class ChatAnswer:
    """The result of a chat's job. The `Answer` is plain values: validating its numbers again would take long."""

    chat: ParsedChat
    answer: dict[str, Any]

    @classmethod
    def parse(cls, chat: ParsedChat, result: str) -> ChatAnswer:
        """The result of a job as JSON, parsed. CPU work: not for the event loop."""
        answer = json.loads(result)
        content = _content(answer)
        too_long = chat.max_tokens is not None and len(content.split()) > chat.max_tokens
        warnings = (f"The answer is longer than {chat.max_tokens} tokens: answers are not cut.",) if too_long else ()
        answer["warnings"] = [*chat.warnings, *warnings, *answer["warnings"]]
        return cls(chat, answer)

    @cached_property
    def reply(self) -> ChatReply:
        """The message."""
        return ChatReply(content=_content(self.answer), reasoning_content=self.answer["reasoning"] or None)

    @cached_property
    def usage(self) -> ChatUsage:
        """All tokens."""
        read, written = self.answer["usage"]["input_tokens"], self.answer["usage"]["output_tokens"]
        return ChatUsage(prompt_tokens=read, completion_tokens=written, total_tokens=read + written)

    def completion(self) -> str:
        """A `ChatCompletion` as JSON."""
        head = _head(self.answer["id"], "chat.completion", self.answer["created_at"], self.chat.model)
        choice = ChatChoice(message=self.reply)
        body = {"choices": [choice.model_dump()], "usage": self.usage.model_dump(), "cow": self.answer}
        return json.dumps(head | body, separators=SEPARATORS, ensure_ascii=False)


@dataclass(frozen=True)
class Chunks:
    """Writes the chunks of one stream, each a `ChatChunk` as JSON on one line."""

    job: str
    created_at: str
    model: str

    def first(self, job: Job) -> str:
        """The role of the message, and the job."""
        return self._chunk(ChatDelta(role="assistant", content=""), cow=_progress(job))

    def progress(self, job: Job) -> str:
        """Progress only: adds nothing to the message."""
        return self._chunk(ChatDelta(), cow=_progress(job))

    def answer(self, answer: ChatAnswer) -> list[str]:
        """The message, its end, and its tokens where they were asked for. CPU work: not for the event loop."""
        reply = answer.reply
        chunks: list[str] = []
        if reply.reasoning_content is not None:
            chunks.append(self._chunk(ChatDelta(reasoning_content=reply.reasoning_content)))
        chunks.append(self._chunk(ChatDelta(content=reply.content)))
        chunks.append(self._chunk(ChatDelta(), finish_reason="stop", cow=answer.answer))
        if answer.chat.with_usage:
            chunks.append(self._write([], usage=answer.usage.model_dump()))
        return chunks

    def _chunk(self, delta: ChatDelta, *, finish_reason: Any = None, **others: Any) -> str:
        choice = ChunkChoice(delta=delta, finish_reason=finish_reason)
        added = {"delta": delta.model_dump(exclude_unset=True)}
        return self._write([choice.model_dump() | added], **others)

    def _write(self, choices: list[dict[str, Any]], **others: Any) -> str:
        head = _head(self.job, "chat.completion.chunk", self.created_at, self.model)
        body = {"choices": choices, "usage": None} | others
        return json.dumps(head | body, separators=SEPARATORS, ensure_ascii=False)


def _head(job: str, kind: str, created_at: str, model: str) -> dict[str, Any]:
    created = int(datetime.fromisoformat(created_at).timestamp())
    return {"id": f"chatcmpl-{job}", "object": kind, "created": created, "model": model}


def _progress(job: Job) -> dict[str, Any]:
    return ChatProgress(job=job.id, status=job.status, stage=job.stage, progress=job.progress).model_dump()


def _content(answer: dict[str, Any]) -> str:
    """The answer in the form that the question asks for: a letter, a text, a line or JSON."""
    said = NOT_SURE if answer["answer"] is None else answer["answer"]
    reply = Reply(said, answer["option"], answer["reasoning"], answer["options_source"])
    return reply_text(answer["question"], reply)
