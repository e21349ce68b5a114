"""The seam to FFmpeg: frames to an MP4 that every browser plays, and from there to a GIF, a WebP or a contact sheet."""

import errno
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray
from PIL import Image

from cow_service.errors import InternalError, StorageUnavailable
from cow_service.media.images import encode_png, fit_within, tiled

Pixels = NDArray[np.uint8]

_RED, _BLUE = 0.2126, 0.0722
_LUMA = np.array([_RED, 1 - _RED - _BLUE, _BLUE])
_CB = (np.array([0, 0, 1]) - _LUMA) / (2 * (1 - _BLUE))
_CR = (np.array([1, 0, 0]) - _LUMA) / (2 * (1 - _RED))
# Of R, G, B and 1; the second and third row give Cb and Cr.
_TO_LUMA = np.array([[*(_LUMA * 219 / 255), 16]], np.float32)
_TO_CHROMA = np.array([[*(_CB * 224 / 255), 128], [*(_CR * 224 / 255), 128]], np.float32)


class YuvFrames:
    """The planes of one frame after another of a clip."""

    def __init__(self, height: int, width: int) -> None:
        """Of frames [height, width, 3], both even."""
        self._rgb = np.empty((height, width, 3), np.uint8)
        self._planes = np.empty((height * 3 // 2, width), np.uint8)
        self._is_first = True

    def converted(self, rgb: Pixels) -> Pixels:
        """The planes [H * 3 / 2, W] of a frame [H, W, 3], as `yuv420p` lays them out; valid until the next call."""
        height, width = rgb.shape[:2]
        rows, columns = slice(0, height), slice(0, width)
        if not self._is_first:  # the window, of even sides, in which it differs from the frame before
            differs = np.asarray(cv2.absdiff(rgb, self._rgb)).reshape(height, 3 * width)
            left, top, across, down = cv2.boundingRect(differs)
            if not across:
                return self._planes
            rows = slice(top // 2 * 2, (top + down + 1) // 2 * 2)
            columns = slice(left // 3 // 2 * 2, ((left + across - 1) // 3 + 2) // 2 * 2)
        part = rgb[rows, columns]
        self._planes[rows, columns] = cv2.transform(part, _TO_LUMA).reshape(part.shape[:2])
        halved = cv2.resize(part, (part.shape[1] // 2, part.shape[0] // 2), interpolation=cv2.INTER_AREA)
        chroma = self._planes[height:].reshape(2, height // 2, width // 2)
        window = slice(rows.start // 2, rows.stop // 2), slice(columns.start // 2, columns.stop // 2)
        for plane, values in zip(chroma, cv2.split(cv2.transform(halved, _TO_CHROMA)), strict=True):
            plane[window] = values
        self._rgb[rows, columns] = part
        self._is_first = False
        return self._planes


_CRF = "18"  # x264's constant rate factor, 0 (lossless) to 51; 18 looks lossless
# x264's AVX-512 code gives the same frames other bytes from run to run, and so another digest.
_AVX_512 = 13  # OpenCV's number of the feature
_UP_TO_AVX2 = "asm=MMX2,SSE2Fast,SSSE3,SSE4.2,AVX,FMA3,BMI2,AVX2"
_MAX_DENOMINATOR = 1001  # of the frame rate: 30000/1001 is broadcast's 29.97
_BT709 = 1  # code point of its matrix, primaries and transfer alike (ITU-T H.273)


def write_mp4(frames: Iterable[Pixels], path: Path, *, fps: float, width: int, height: int) -> int:
    """Write frames, each [height, width, 3] RGB, as H.264 (High, 4:2:0, BT.709) and return how many there were.

    Frames are taken one at a time, and frame i is shown at exactly i / fps seconds. The index stands before the
    pictures, so that a browser can start before it has all. H.264 4:2:0 needs even sides: an odd one is padded by
    repeating its last row or column.

    Raises `ValueError` for no frames or a frame of another shape; `StorageUnavailable` if the disk is full;
    `InternalError` if FFmpeg fails otherwise. What `frames` raises passes through. After an error no file is left.
    """
    rate = Fraction(fps).limit_denominator(_MAX_DENOMINATOR)
    with ExitStack() as on_error:
        on_error.callback(path.unlink, missing_ok=True)
        try:
            count = _encode(frames, path, rate, width, height)
        except FFmpegError as error:
            if error.errno in (errno.ENOSPC, errno.EDQUOT):
                raise StorageUnavailable(
                    "The disk is full, the video could not be written: free some space and try again."
                ) from error
            # The number and its name alone: the text of the error holds the path.
            raise InternalError(f"The video could not be encoded (FFmpeg: {error.strerror}).") from error
        if count == 0:
            raise ValueError("There are no frames: a video needs at least one.")
        on_error.pop_all()
    return count


def _encode(frames: Iterable[Pixels], path: Path, rate: Fraction, width: int, height: int) -> int:
    options = {"crf": _CRF, "preset": "veryfast", "profile": "high"}
    if cv2.checkHardwareSupport(_AVX_512):
        options["x264-params"] = _UP_TO_AVX2
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=rate, options=options)
        context = stream.codec_context
        context.width, context.height = width + width % 2, height + height % 2
        context.pix_fmt = "yuv420p"
        context.time_base = 1 / rate
        # Without these tags players guess the matrix from the height of the video, and colours shift.
        context.colorspace = context.color_primaries = context.color_trc = _BT709
        context.color_range = ColorRange.MPEG
        context.thread_count = 2
        # Slices, the default, would cost compression.
        context.thread_type = "FRAME"
        planes = YuvFrames(context.height, context.width)
        count = 0
        for pixels in frames:
            if pixels.shape != (height, width, 3) or pixels.dtype != np.uint8:
                shape = f"{pixels.shape} of {pixels.dtype}"
                raise ValueError(f"Frame {count} is {shape}: it must be {(height, width, 3)} of uint8.")
            even = np.ascontiguousarray(pixels)
            if height % 2 or width % 2:
                border = cv2.copyMakeBorder(even, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
                even = np.asarray(border, np.uint8)
            frame = av.VideoFrame.from_ndarray(planes.converted(even), format="yuv420p")
            frame.colorspace, frame.color_range = Colorspace.ITU709, ColorRange.MPEG
            frame.pts, frame.time_base = count, context.time_base
            container.mux(stream.encode(frame))
            count += 1
        if count:
            container.mux(stream.encode(None))
        return count


MAX_SIDE = 480  # px of an animated picture: a GIF has no compression to speak of
GIF_FPS = 12.5  # that browsers show as they should: times of a GIF are hundredths of a second
SHEET_COLUMNS, SHEET_ROWS, SHEET_SIDE, SHEET_GAP = 4, 3, 320, 4  # px
WHITE = 255
WEBP_QUALITY = 80


def frames_of(video: bytes, max_side: int | None = None) -> tuple[list[Pixels], float]:
    """All frames [h, w, 3] of an mp4, RGB, at most `max_side` px, and how many there are in a second."""
    frames, rates = zip(*frames_in(video, max_side), strict=True)
    return list(frames), rates[0]


def frames_in(video: bytes, max_side: int | None = None) -> Iterator[tuple[Pixels, float]]:
    """As `frames_of`, one after another, each with their rate."""
    with av.open(io.BytesIO(video), "r") as container:
        stream = container.streams.video[0]
        rate = float(stream.average_rate or 1)
        for frame in container.decode(stream):
            yield fit_within(np.asarray(frame.to_ndarray(format="rgb24"), np.uint8), max_side), rate


def gif(frames: Sequence[Pixels], fps: float) -> bytes:
    """An animated GIF that goes on for ever, at most `MAX_SIDE` px and `GIF_FPS` frames a second."""
    every = max(1, round(fps / GIF_FPS))
    shown = [fit_within(frame, MAX_SIDE) for frame in frames[::every]]
    # One palette for all frames: with one for each, what stands still would flicker. The octree keeps small things'
    # colours, for which the methods that count pixels have none left.
    palette = Image.fromarray(tiled(shown, 8, SHEET_GAP, WHITE)).quantize(256, method=Image.Quantize.FASTOCTREE)
    drawn = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in shown]
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
    shown = [fit_within(frames[index], SHEET_SIDE) for index in chosen]
    return encode_png(tiled(shown, SHEET_COLUMNS, SHEET_GAP, WHITE))


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


def _saved(pictures: Sequence[Image.Image], format: str, **options: int | list[int]) -> bytes:
    out = io.BytesIO()
    pictures[0].save(out, format, save_all=True, append_images=pictures[1:], loop=0, **options)
    return out.getvalue()
