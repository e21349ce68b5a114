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
    UserContent,
    UserPromptPart,
)

from cow_service.media.images import decode

Role = Literal["system", "user", "assistant"]
Turn = dict[str, Any]  # as chat templates take it: {"role": ..., "content": [{"type": "text", "text": ...}, ...]}


@dataclass(frozen=True)
class Chat:
    """A conversation up to the reply that is wanted. `images` are in the order of their places in the turns."""

    turns: tuple[Turn, ...]
    images: tuple[Image.Image, ...]


class _Builder:
    """Turns as they grow: what one role says in a row is one turn, and texts that meet are one text."""

    def __init__(self, plain: Callable[[str], str]) -> None:
        self.turns: list[Turn] = []
        self.images: list[Image.Image] = []
        self._plain = plain

    def text(self, role: Role, text: str) -> None:
        content = self._content(role)
        before = ""
        if content and content[-1]["type"] == "text":
            before = content.pop()["text"] + "\n"
        # Joined first: a special token could otherwise come about where two texts meet.
        content.append({"type": "text", "text": self._plain(before + text)})

    def image(self, data: bytes) -> None:
        self._content("user").append({"type": "image"})
        self.images.append(Image.fromarray(decode(data).pixels))

    def _content(self, role: Role) -> list[dict[str, str]]:
        if not self.turns or self.turns[-1]["role"] != role:
            self.turns.append({"role": role, "content": []})
        return self.turns[-1]["content"]


def chat_of(messages: Iterable[ModelMessage], instructions: Sequence[str], special: Sequence[str]) -> Chat:
    """The conversation of prepared messages. Text that spells one of the `special` tokens is not taken for it.

    Raises `UserError` for what such a model cannot be given (tools, files other than images), and the errors of
    `images.decode`.
    """
    builder = _Builder(_broken(special))
    for text in instructions:
        builder.text("system", text)
    for message in messages:
        if isinstance(message, ModelResponse):
            for part in message.parts:
                if isinstance(part, TextPart):
                    builder.text("assistant", part.content)
                elif not isinstance(part, ThinkingPart):
                    raise _untaken(part)
            continue
        for part in message.parts:
            if isinstance(part, SystemPromptPart):
                # Templates take a system turn at the start only.
                opening = not any(turn["role"] != "system" for turn in builder.turns)
                builder.text("system" if opening else "user", part.content)
            elif isinstance(part, UserPromptPart):
                _user(builder, [part.content] if isinstance(part.content, str) else part.content)
            else:
                raise _untaken(part)
    return Chat(tuple(builder.turns), tuple(builder.images))


def _user(builder: _Builder, content: Sequence[UserContent]) -> None:
    for item in content:
        if isinstance(item, str):
            builder.text("user", item)
        elif isinstance(item, TextContent):
            builder.text("user", item.content)
        elif isinstance(item, BinaryContent) and item.is_image:
            builder.image(item.data)
        elif not isinstance(item, CachePoint):
            raise _untaken(item)


def _untaken(part: object) -> UserError:
    return UserError(f"A model in this process takes text and images (as bytes), not a {type(part).__name__}.")


def _broken(special: Sequence[str]) -> Callable[[str], str]:
    """Puts a space into every special token that a text spells, or a question could end its turn or claim an image."""
    found = re.compile("|".join(re.escape(token) for token in sorted(special, key=len, reverse=True) if len(token) > 1))
    if not found.pattern:
        return lambda text: text
    return lambda text: found.sub(lambda match: f"{match[0][0]} {match[0][1:]}", text)
