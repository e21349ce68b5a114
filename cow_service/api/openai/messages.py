"""What stands in the messages of a chat: texts, images and other parts, however loosely they are written."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast


@dataclass(frozen=True)
class ImagePart:
    """An image of a message."""

    url: str
    pointer: str  # JSON Pointer to the part
    url_pointer: str  # and to its URL
    role: str  # of its message
    detail: str | None  # that it is to be seen in, where the part says one

    @property
    def reference(self) -> str | dict[str, str]:
        """The image as requests have it."""
        return self.url if self.url[:5].lower() == "data:" else {"url": self.url}


def role_of(message: Any) -> str:
    """The role of a message; empty where it has none."""
    role = cast("dict[str, Any]", message).get("role") if isinstance(message, dict) else None
    return role if isinstance(role, str) else ""


def texts_of(message: Any) -> list[str]:
    """The texts of a message."""
    return [part["text"] for _, _, part in _parts([message]) if isinstance(part.get("text"), str)]


def images_of(messages: list[Any]) -> Iterator[ImagePart]:
    """The images of all messages, in order."""
    for pointer, role, part in _parts(messages):
        given = part.get("image_url")
        nested = isinstance(given, dict)
        held = cast("dict[str, Any]", given) if nested else {"url": given}
        url, detail = held.get("url"), held.get("detail")
        if isinstance(url, str):
            place = f"{pointer}/image_url" + ("/url" if nested else "")
            yield ImagePart(url, pointer, place, role, detail if isinstance(detail, str) else None)


def other_parts(messages: list[Any]) -> Iterator[tuple[str, str]]:
    """JSON Pointer and type of every part that is neither a text nor an image."""
    for pointer, _, part in _parts(messages):
        if part.get("image_url") is None and not isinstance(part.get("text"), str) and part.get("type") != "refusal":
            yield pointer, f"`{str(part.get('type'))[:40]}`"


def _parts(messages: list[Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """JSON Pointer, role and part; a text alone is one part."""
    for place, message in enumerate(messages):
        content = cast("dict[str, Any]", message).get("content") if isinstance(message, dict) else None
        pointer = f"/messages/{place}/content"
        if isinstance(content, str):
            yield pointer, role_of(message), {"type": "text", "text": content}
        for number, part in enumerate(cast("list[Any]", content) if isinstance(content, list) else ()):
            held: Any = {"type": "text", "text": part} if isinstance(part, str) else part
            if isinstance(held, dict):
                yield f"{pointer}/{number}", role_of(message), cast("dict[str, Any]", held)
