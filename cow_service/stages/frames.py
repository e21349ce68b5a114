"""Chosen frames on their way to an artifact: encoded on another thread while the next ones are rendered."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass

from cow_service.media.artifacts import ArtifactWriter
from cow_service.media.images import encode_png, fit_within
from cow_service.records import Frame
from cow_service.vision.types import Image


@dataclass(frozen=True)
class EncodedFrame:
    """A frame of the clip, and its PNG once that is made."""

    index: int
    time: float  # s
    width: int  # px
    height: int
    png: Future[bytes]

    @staticmethod
    def of(pixels: Image, index: int, fps: float, max_side: int | None, encoder: Executor) -> EncodedFrame:
        """Of an image [H, W, 3] that its maker may change afterwards."""
        fitting = fit_within(pixels, max_side)
        picture = pixels.copy() if fitting is pixels else fitting
        height, width = picture.shape[:2]
        return EncodedFrame(index, index / fps, width, height, encoder.submit(encode_png, picture))


def stored(frames: Sequence[EncodedFrame], artifacts: ArtifactWriter) -> tuple[Frame, ...]:
    """Waits for the PNGs and stores them."""
    kept = [artifacts.put(frame.png.result(), "image/png") for frame in frames]
    return tuple(
        Frame(
            index=frame.index,
            time=frame.time,
            url=artifact.url,
            sha256=artifact.sha256,
            width=frame.width,
            height=frame.height,
        )
        for frame, artifact in zip(frames, kept, strict=True)
    )
