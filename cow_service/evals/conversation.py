"""Messages with pictures, as a model is sent them and as Inspect's viewer shows them."""

from __future__ import annotations

import base64
from collections.abc import Iterable

from inspect_ai.model import (
    ChatMessage,
    ChatMessageAssistant,
    ChatMessageUser,
    Content,
    ContentImage,
    ContentText,
)

from cow_service.evals.asking import Asked, Case
from cow_service.evals.pictures import Pictures
from cow_service.media.artifacts import media_type_of

OVERLAY = "Not sent to the model: the overlay of the simulation that the frames are of."


def message(digests: Iterable[str], text: str, pictures: Pictures) -> ChatMessageUser:
    """Pictures, then a text."""
    content: list[Content] = [*(_picture(digest, pictures) for digest in digests), ContentText(text=text)]
    return ChatMessageUser(content=content)


def conversation(case: Case, asked: Asked, overlay: str | None, pictures: Pictures) -> list[ChatMessage]:
    """What a viewer shows: what was asked last, every reply, and in the first repeat the overlay.

    What `/answer` sends by itself is not known here: in its place stand the image, the frames and the question.
    """
    frames = [digest for look in asked.looks for digest in look.frames]
    sent: tuple[ChatMessage, ...] = asked.messages or (message((case.item.image, *frames), case.question, pictures),)
    shown: list[ChatMessage] = [*sent, *(ChatMessageAssistant(content=reply.text) for reply in asked.replies)]
    if overlay is not None and case.repeat == 1:
        shown.append(message((overlay,), OVERLAY, pictures))
    return shown


def _picture(digest: str, pictures: Pictures) -> ContentImage:
    data = pictures.read(digest)
    return ContentImage(image=f"data:{media_type_of(data)};base64,{base64.b64encode(data).decode()}")
