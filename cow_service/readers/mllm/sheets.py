"""Fits the pictures of a call to what a server takes: fewer images than frames, and a limited body.

Where a call takes fewer images, frames go as one named contact sheet; where a body is too large, frames are made
smaller first, then fewer. The first image keeps its size, as places are told in it.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic_ai import BinaryContent
from pydantic_ai.messages import ModelMessage, ModelRequest, UserContent, UserPromptPart

from cow_service.media.overlay import named_strip
from cow_service.readers.mllm.capabilities import Capabilities
from cow_service.readers.mllm.coordinates import MEDIA_TYPE, QUALITY

FEWER = 3  # reductions from which only the first, middle and last frame are sent
QUALITIES = (QUALITY, 80, 60, 60)  # JPEG, percent, by reduction


def images_in(messages: Sequence[ModelMessage]) -> int:
    """How many images a call has."""
    return sum(
        isinstance(part, BinaryContent)
        for message in messages
        for prompt in message.parts
        if isinstance(prompt, UserPromptPart) and not isinstance(prompt.content, str)
        for part in prompt.content
    )


def fit_images(messages: Sequence[ModelMessage], takes: Capabilities) -> tuple[list[ModelMessage], str]:
    """The messages as a server takes them, and a sentence about what was changed; empty where nothing was."""
    fitted, note = list[ModelMessage](), ""
    for message in messages:
        if isinstance(message, ModelRequest):
            parts = list(message.parts)
            for place, part in enumerate(parts):
                if isinstance(part, UserPromptPart) and not isinstance(part.content, str):
                    content, said = _fit(part.content, takes)
                    parts[place], note = replace(part, content=content), said or note
            message = replace(message, parts=parts)  # noqa: PLW2901 # the same one, with other pictures
        fitted.append(message)
    return fitted, note


def _fit(content: Sequence[UserContent], takes: Capabilities) -> tuple[list[UserContent], str]:
    jpegs = [part for part in content if isinstance(part, BinaryContent)]
    rest = [part for part in content if not isinstance(part, BinaryContent)]
    is_over = takes.images is not None and len(jpegs) > takes.images
    if not jpegs or (not is_over and not takes.reduction):
        return list(content), ""
    first, *frames = [_decoded(each.data) for each in jpegs]
    told: list[str] = []
    if takes.reduction >= FEWER and len(frames) > FEWER:
        kept = (0, len(frames) // 2, len(frames) - 1)
        told.append(f"Of the {len(frames)} frames these are numbers {', '.join(str(place + 1) for place in kept)}.")
        frames = [frames[place] for place in kept]
    scale = 0.5 ** min(takes.reduction, FEWER - 1)
    frames = [_resized(each, round(scale * each.shape[1]), round(scale * each.shape[0])) for each in frames]
    if is_over and takes.images == 1:
        images = [_sheet([first, *frames], f"Images 1 to {len(frames) + 1}, row by row")]
        told.append("All images are on one sheet, from left to right and row by row.")
    elif is_over:
        images = [first, _sheet(frames, f"Images 2 to {len(frames) + 1}, row by row")]
        told.append("All images after the first are on one sheet, from left to right and row by row.")
    else:
        images = [first, *frames]
    encoded = [_encoded(each, QUALITIES[takes.reduction]) for each in images]
    note = " ".join(told)
    return [*encoded, *((note,) if note else ()), *rest], note or "Frames were sent smaller than they are."


def _sheet(images: Sequence[NDArray[np.uint8]], name: str) -> NDArray[np.uint8]:
    height, width = min((each.shape[:2] for each in images), key=lambda size: size[0] * size[1])
    return named_strip([_resized(each, width, height) for each in images], name)


def _resized(pixels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _decoded(jpeg: bytes) -> NDArray[np.uint8]:
    bgr = np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), np.uint8)
    return bgr[..., ::-1]


def _encoded(pixels: NDArray[np.uint8], quality: int) -> BinaryContent:
    _, data = cv2.imencode(".jpg", pixels[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, quality))
    return BinaryContent(data.tobytes(), media_type=MEDIA_TYPE)
