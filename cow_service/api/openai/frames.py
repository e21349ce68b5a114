"""The imagined frames as parts of a message, behind the note that introduces them."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

from cow_service.media.artifacts import ArtifactStore
from cow_service.media.images import decode_own, encode_png
from cow_service.readers.base import Imagined
from cow_service.readers.mllm.hypothesis import hypothesis, pictures
from cow_service.readers.prompts import load_prompt
from cow_service.records import Simulation

NOTE = "imagined-frames"  # name in prompts/


@dataclass(frozen=True)
class FrameParts:
    """What is added to a message: a text and images, as parts of OpenAI's protocol."""

    parts: tuple[dict[str, Any], ...]
    prompts: dict[str, int]


def frame_parts(simulation: Simulation, artifacts: ArtifactStore, detail: str | None) -> FrameParts:
    """The note and the frames of a simulation; of two worlds, a named strip of each. CPU work.

    `detail` is that of the caller's own image, so that all images are seen alike. Raises `ArtifactNotFound`.
    """
    pngs = [artifacts.read(frame.sha256) for frame in simulation.frames]
    factual = [artifacts.read(frame.sha256) for frame in simulation.factual_frames]
    frames: tuple[Any, ...] = ()
    if factual:
        frames = tuple(decode_own(png) for png in pngs)
    imagined = Imagined(simulation, frames, tuple(decode_own(png) for png in factual))
    if factual:
        pngs = [encode_png(picture) for picture in pictures(imagined)]
    prompt, told = load_prompt(NOTE), hypothesis(imagined)
    note = prompt.render(**{name: told[name] for name in prompt.inputs})
    shown = {} if detail is None else {"detail": detail}
    images = [{"type": "image_url", "image_url": {"url": _data_url(png), **shown}} for png in pngs]
    return FrameParts(({"type": "text", "text": note}, *images), {prompt.name: prompt.version})


def _data_url(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode()
