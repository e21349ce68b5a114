"""Messages of pydantic-ai as turns of a chat template, with their images. Knows no model and no tensor."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from PIL import Image
from pydantic_ai.exceptions import UserError
from pydantic_ai.messages import (
    BinaryContent,
    CachePoint,
    ModelMessage,
    ModelResponse,
    SystemPromptPart,
    TextContent,
    TextPart,
    ThinkingPart,
    UserPromptPart,
)

from cow_service.media.images import decode

Role = Literal["system", "user", "assistant"]
Turn = dict[str, Any]  # as chat templates take it: {"role": ..., "content": [{"type": "text", "text": ...}, ...]}


@dataclass(frozen=True)
class Conversation:
    """All that was said up to the reply that is wanted. `images` are in the order of their places in the turns."""

    turns: tuple[Turn, ...]
    images: tuple[Image.Image, ...]


def conversation_of(
    messages: Iterable[ModelMessage], instructions: Sequence[str], special_tokens: Sequence[str]
) -> Conversation:
    """The conversation of prepared messages. Text that spells one of the special tokens is not taken for it.

    Raises `UserError` for what such a model cannot be given (tools, files other than images), and the errors of
    `images.decode`.
    """
    builder = _Builder(_token_breaker(special_tokens))
    for text in instructions:
        builder.add_text("system", text)
    for message in messages:
        role: Role = "assistant" if isinstance(message, ModelResponse) else "user"
        for part in message.parts:
            if isinstance(part, SystemPromptPart):
                # Templates take a system turn at the start only.
                opening = all(turn["role"] == "system" for turn in builder.turns)
                builder.add_text("system" if opening else "user", part.content)
            elif isinstance(part, UserPromptPart):
                for item in [part.content] if isinstance(part.content, str) else part.content:
                    builder.add(role, item)
            elif not isinstance(part, ThinkingPart):
                builder.add(role, part)
    return Conversation(tuple(builder.turns), tuple(builder.images))


class _Builder:
    """Turns as they grow: what one role says in a row is one turn, and texts that meet are one text."""

    def __init__(self, break_tokens: Callable[[str], str]) -> None:
        self.turns: list[Turn] = []
        self.images: list[Image.Image] = []
        self._break_tokens = break_tokens

    def add(self, role: Role, item: object) -> None:
        """Text or an image. Raises `UserError` for anything else."""
        if isinstance(item, str):
            self.add_text(role, item)
        elif isinstance(item, TextContent | TextPart):
            self.add_text(role, item.content)
        elif isinstance(item, BinaryContent) and item.is_image:
            self._content(role).append({"type": "image"})
            self.images.append(Image.fromarray(decode(item.data).pixels))
        elif not isinstance(item, CachePoint):
            raise UserError(f"A model in this process takes text and images (as bytes), not a {type(item).__name__}.")

    def add_text(self, role: Role, text: str) -> None:
        content = self._content(role)
        if content and content[-1]["type"] == "text":
            text = content.pop()["text"] + "\n" + text
        # Joined first: a special token could otherwise come about where two texts meet.
        content.append({"type": "text", "text": self._break_tokens(text)})

    def _content(self, role: Role) -> list[dict[str, str]]:
        if not self.turns or self.turns[-1]["role"] != role:
            self.turns.append({"role": role, "content": []})
        return self.turns[-1]["content"]


def _token_breaker(special_tokens: Sequence[str]) -> Callable[[str], str]:
    """Puts a space into every special token that a text spells, or a question could end its turn or claim an image."""
    longest_first = sorted((token for token in special_tokens if len(token) > 1), key=len, reverse=True)
    if not longest_first:
        return lambda text: text
    found = re.compile("|".join(map(re.escape, longest_first)))
    return lambda text: found.sub(lambda match: f"{match[0][0]} {match[0][1:]}", text)
