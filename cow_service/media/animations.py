"""A clip in forms that go where no video does: animated GIF and WebP, and a contact sheet."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from itertools import pairwise

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from cow_service.media.images import encode_png, fit_within

MAX_SIDE = 480  # px of an animated picture: a GIF has no compression to speak of
GIF_FPS = 12.5  # that browsers show as they should: times of a GIF are hundredths of a second
SHEET_COLUMNS, SHEET_ROWS, SHEET_SIDE, SHEET_GAP = 4, 3, 320, 4  # px
WEBP_QUALITY = 80

Pixels = NDArray[np.uint8]


def frames_of(video: bytes, max_side: int | None = None) -> tuple[list[Pixels], float]:
    """All frames [h, w, 3] of an mp4, RGB, at most `max_side` px, and how many there are in a second."""
    with av.open(io.BytesIO(video), "r") as container:
        stream = container.streams.video[0]
        rate = float(stream.average_rate or 1)
        frames = (np.asarray(frame.to_ndarray(format="rgb24"), np.uint8) for frame in container.decode(stream))
        return [fit_within(frame, max_side) for frame in frames], rate


def gif(frames: Sequence[Pixels], fps: float) -> bytes:
    """An animated GIF that goes on for ever, at most `MAX_SIDE` px and `GIF_FPS` frames a second."""
    every = max(1, round(fps / GIF_FPS))
    shown = [Image.fromarray(fit_within(frame, MAX_SIDE)) for frame in frames[::every]]
    # One palette for all frames: with one for each, what stands still would flicker. The octree keeps small things'
    # colours, for which the methods that count pixels have none left.
    palette = _sheet(shown, columns=8).quantize(256, method=Image.Quantize.FASTOCTREE)
    drawn = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in shown]
    times = [10 * round(100 * every * place / fps) for place in range(len(shown) + 1)]  # ms, whole hundredths
    return _saved(drawn, "GIF", duration=[after - time for time, after in pairwise(times)], disposal=1)


def webp(frames: Sequence[Pixels], fps: float) -> bytes:
    """An animated WebP that goes on for ever, at most `MAX_SIDE` px."""
    shown = [Image.fromarray(fit_within(frame, MAX_SIDE)) for frame in frames]
    return _saved(shown, "WEBP", duration=round(1000 / fps), quality=WEBP_QUALITY, method=4)


def contact_sheet(frames: Sequence[Pixels], fps: float) -> bytes:
    """A PNG with frames from all over the clip, in rows from left to right."""
    wanted = min(len(frames), SHEET_COLUMNS * SHEET_ROWS)
    chosen = np.linspace(0, len(frames) - 1, wanted).round().astype(int)
    shown = [Image.fromarray(fit_within(frames[index], SHEET_SIDE)) for index in chosen]
    return encode_png(np.asarray(_sheet(shown, SHEET_COLUMNS)))


FORMATS: dict[str, tuple[str, Callable[[Sequence[Pixels], float], bytes]]] = {
    "gif": ("clip.gif", gif),
    "webp": ("clip.webp", webp),
    "sheet": ("sheet.png", contact_sheet),
}
"""By the name of a format: the file that it makes, and what makes its bytes of frames and their rate."""


def animation(video: bytes, format: str) -> bytes:
    """The file of a format of `FORMATS`, made of an mp4. Its frames are held as small as they will be in the file."""
    frames, fps = frames_of(video, SHEET_SIDE if format == "sheet" else MAX_SIDE)
    return FORMATS[format][1](frames, fps)


def _sheet(pictures: Sequence[Image.Image], columns: int) -> Image.Image:
    width, height = pictures[0].size
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    size = columns * (width + SHEET_GAP) - SHEET_GAP, rows * (height + SHEET_GAP) - SHEET_GAP
    sheet = Image.new("RGB", size, (255, 255, 255))
    for place, picture in enumerate(pictures):
        sheet.paste(picture, (place % columns * (width + SHEET_GAP), place // columns * (height + SHEET_GAP)))
    return sheet


def _saved(pictures: Sequence[Image.Image], format: str, **options: int | list[int]) -> bytes:
    out = io.BytesIO()
    pictures[0].save(out, format, save_all=True, append_images=pictures[1:], loop=0, **options)
    return out.getvalue()
