"""Bytes to upright RGB pixels, and pixels to PNG.

This is the seam to pillow: whatever a file holds, `decode` returns a `DecodedImage` or raises a `CowError`.
"""

from __future__ import annotations

import codecs
import hashlib
import io
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.ImageFile import ImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.WebPImagePlugin import WebPImageFile

from cow_service.errors import ImageTooLarge, ImageTypeUnsupported, ImageUnreadable, InternalError
from cow_service.media.image_files import LeanFile, OverfullError, lean_jpeg, lean_png, orientation_of
from cow_service.records import ImageInfo

MAX_IMAGE_MEGAPIXELS_DEFAULT = 25.0  # millions of pixels
MIN_SIDE = 8  # px; nothing that could move has room in less

# The classes rather than `Image.open`: that compares every size with `Image.MAX_IMAGE_PIXELS`, one limit for the whole
# process, which a library must not change under its host; it also fills its table of formats on first use, from
# whichever thread comes first. `JpegImageFile` reads the first picture of a multi-picture file (MPO), as phones write.
_OPENERS: dict[str, Callable[[io.BytesIO], ImageFile]] = {
    "PNG": PngImageFile,
    "JPEG": JpegImageFile,
    "WebP": WebPImageFile,
}

# A WebP file's blocks are handed out as they are, never decoded or joined.
_LEAN: dict[str, Callable[[bytes], LeanFile]] = {"PNG": lean_png, "JPEG": lean_jpeg}

# What pillow raises on damaged files. Its warnings are raised only where the host made warnings errors.
_PILLOW_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    Image.DecompressionBombError,
    LookupError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    Warning,
    struct.error,
    zlib.error,
)

_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}

_FOREIGN_SIGNATURES = (
    (b"GIF8", "a GIF file"),
    (b"BM", "a BMP file"),
    (b"II*\0", "a TIFF file"),
    (b"MM\0*", "a TIFF file"),
    (b"II+\0", "a BigTIFF file"),
    (b"MM\0+", "a BigTIFF file"),
    (b"%PDF", "a PDF file"),
    (b"8BPS", "a Photoshop file"),
    (b"\0\0\1\0", "an icon file"),
    (b"\xff\x0a", "a JPEG XL file"),
    (b"\0\0\0\x0cJXL ", "a JPEG XL file"),
    (b"\0\0\0\x0cjP  ", "a JPEG 2000 file"),
    (b"PK\3\4", "a ZIP archive"),
    (b"\x1f\x8b", "a gzip archive"),
    (b"data:", "a data URL"),
    (b"iVBORw0KGgo", "base64 text, not decoded"),
    (b"/9j/", "base64 text, not decoded"),
    (b"UklGR", "base64 text, not decoded"),
)
_ISO_BRANDS = {b"avif": "an AVIF file", b"avis": "an AVIF file", b"heic": "a HEIC file", b"mif1": "a HEIF file"}
_SNIFFED_BYTES = 1024


@dataclass(frozen=True)
class DecodedImage:
    """The input image as pixels, upright, and the record that names it.

    `pixels` is [H, W, 3] RGB, C-contiguous, W and H as in `info`; `media_type` is that of the bytes as sent.
    """

    pixels: NDArray[np.uint8]
    info: ImageInfo
    media_type: str


def decode(data: bytes, *, max_megapixels: float = MAX_IMAGE_MEGAPIXELS_DEFAULT) -> DecodedImage:
    """Decode one PNG, JPEG or WebP file, told by its content, to upright 8-bit RGB.

    The EXIF orientation is applied, transparency is laid on white, and 16 bits become 8. Colours are taken as sRGB: an
    embedded ICC profile is ignored. The size is read from the header and refused before any pixel is decoded; text,
    profiles and other blocks beside the pixels are not decoded at all.

    Raises `ImageTypeUnsupported` for other types and for animations, `ImageTooLarge` above `max_megapixels` (millions
    of pixels), and `ImageUnreadable` for damaged files and for sides under `MIN_SIDE` px.
    """
    kind = _kind(data)
    try:
        pixels = _decode_as(kind, data, max_megapixels)
    except OverfullError as error:
        raise ImageUnreadable(f"The image is {error}: save it anew with another program and send that.") from error
    except _PILLOW_ERRORS as error:
        raise _damaged(kind, data) from error
    height, width = pixels.shape[:2]
    info = ImageInfo(width=width, height=height, sha256=hashlib.sha256(data).hexdigest())
    return DecodedImage(pixels, info, f"image/{kind.lower()}")


def decode_own(data: bytes) -> NDArray[np.uint8]:
    """Upright RGB pixels [H, W, 3] of a PNG that this service wrote. Raises `InternalError` where it is damaged."""
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if pixels is None:
        raise InternalError("A picture that was written before can no longer be read.")
    return np.ascontiguousarray(pixels[..., ::-1], np.uint8)


def encode_png(pixels: NDArray[np.uint8] | NDArray[np.bool_], *, level: int = 1) -> bytes:
    """Encode [H, W, 3] RGB, [H, W] grey or an [H, W] boolean mask (0 and 255) as PNG.

    `level` is zlib's, 0 (none) to 9 (smallest). Raises `ValueError` for other shapes.
    """
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3) or pixels.size == 0:
        raise ValueError(f"Pixels of shape {pixels.shape} cannot be encoded: give [H, W, 3] RGB or [H, W].")
    grey_or_rgb = pixels.astype(np.uint8) * np.uint8(255) if pixels.dtype == np.bool_ else pixels.astype(np.uint8)
    ordered = cv2.cvtColor(grey_or_rgb, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else grey_or_rgb
    # One filter for all rows: trying each takes twice as long and saves nothing.
    options = [cv2.IMWRITE_PNG_COMPRESSION, level, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
    encoded, buffer = cv2.imencode(".png", ordered, options)
    if not encoded:
        raise InternalError(f"Pixels of shape {pixels.shape} could not be encoded as PNG.")
    return buffer.tobytes()


def fit_within(pixels: NDArray[np.uint8], max_side: int | None) -> NDArray[np.uint8]:
    """Scale [H, W, 3] or [H, W] down so that its longer side is at most `max_side` px; never up.

    The other side is rounded, at least 1 px. None, and pixels that fit already, are returned as they are. Raises
    `ValueError` if `max_side` is under 1.
    """
    if max_side is None:
        return pixels
    if max_side < 1:
        raise ValueError(f"max_side is {max_side}: give at least 1 px, or None for no limit.")
    height, width = pixels.shape[:2]
    longer = max(height, width)
    if longer <= max_side:
        return pixels
    size = (max(1, round(width * max_side / longer)), max(1, round(height * max_side / longer)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _kind(data: bytes) -> str:
    if not data:
        raise ImageUnreadable("The image is empty (0 bytes): send the bytes of a PNG, JPEG or WebP file.")
    if data.startswith(b"\x89PNG\r\n\x1a\n"):
        return "PNG"
    if data.startswith(b"\xff\xd8\xff"):
        return "JPEG"
    if data.startswith(b"RIFF") and data[8:12] == b"WEBP":
        return "WebP"
    raise ImageTypeUnsupported(f"The image is {_describe_foreign(data)}: send it as PNG, JPEG or WebP.")


def _describe_foreign(data: bytes) -> str:
    head = data[:_SNIFFED_BYTES]
    for signature, name in _FOREIGN_SIGNATURES:
        if head.startswith(signature):
            return name
    if head[4:8] == b"ftyp":
        return _ISO_BRANDS.get(head[8:12], "an MP4 or other ISO media file")
    markup = head.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if markup.startswith(b"<svg") or (markup.startswith((b"<?xml", b"<!--", b"<!doctype svg")) and b"<svg" in markup):
        return "an SVG file"
    if markup.startswith((b"<!doctype html", b"<html")):
        return "an HTML page"
    return "text" if _is_text(head) else f"of no known type (it begins with the bytes {data[:8].hex(' ')})"


def _is_text(head: bytes) -> bool:
    try:
        # An incremental decoder waits for the rest of a character that the end of the sample cut in two.
        text = codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return False
    return "".join(text.split()).isprintable()


def _decode_as(kind: str, data: bytes, max_megapixels: float) -> NDArray[np.uint8]:
    if kind == "WebP":
        # Opening a WebP file allocates its whole canvas, so that its size has to be known before.
        _check_size(*_webp_size(data), max_megapixels)
    lean = _LEAN[kind](data) if kind in _LEAN else LeanFile(data)
    with _OPENERS[kind](io.BytesIO(lean.data)) as image:
        _check_size(image.width, image.height, max_megapixels)
        _check_still(kind, image)
        rgb = _to_rgb(image)
        orientation = orientation_of(image.info.get("exif", b"")) if kind == "WebP" else lean.orientation
    turn = _UPRIGHT.get(orientation)
    return np.array(rgb if turn is None else rgb.transpose(turn), dtype=np.uint8)


def _webp_size(data: bytes) -> tuple[int, int]:
    """Width and height in px from the first chunk (RFC 9649, sections 2.5 to 2.7)."""
    chunk, head = data[12:16], data[20:30]
    if chunk == b"VP8X" and len(head) == 10:
        return int.from_bytes(head[4:7], "little") + 1, int.from_bytes(head[7:10], "little") + 1
    if chunk == b"VP8 " and head[3:6] == b"\x9d\x01\x2a" and len(head) == 10:
        return int.from_bytes(head[6:8], "little") & 0x3FFF, int.from_bytes(head[8:10], "little") & 0x3FFF
    if chunk == b"VP8L" and head[:1] == b"\x2f" and len(head) >= 5:
        bits = int.from_bytes(head[1:5], "little")
        return (bits & 0x3FFF) + 1, ((bits >> 14) & 0x3FFF) + 1
    raise _damaged("WebP", data)


def _check_size(width: int, height: int, max_megapixels: float) -> None:
    megapixels = width * height / 1e6
    if megapixels > max_megapixels:
        raise ImageTooLarge(
            f"The image is {width} x {height} px, {megapixels:.2f} megapixels, over the limit of {max_megapixels:g}: "
            "scale it down and send it again."
        )
    if min(width, height) < MIN_SIDE:
        raise ImageUnreadable(
            f"The image is {width} x {height} px, too small to hold an object: "
            f"send one with both sides at least {MIN_SIDE} px."
        )


def _check_still(kind: str, image: ImageFile) -> None:
    frames = int(getattr(image, "n_frames", 1))
    if frames > 1:
        raise ImageTypeUnsupported(f"The image is an animated {kind} of {frames} frames: send one frame of it.")


def _to_rgb(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):
        return Image.fromarray(_grey16_to_8(image)).convert("RGB")
    if image.has_transparency_data:
        white = Image.new("RGBA", image.size, "white")
        return Image.alpha_composite(white, image.convert("RGBA")).convert("RGB")
    return image.convert("RGB")


def _grey16_to_8(image: Image.Image) -> NDArray[np.uint8]:
    # Pillow's own conversion clips at 255 instead of scaling.
    values = np.asarray(image).astype(np.uint32)
    grey = ((values + 128) // 257).astype(np.uint8)
    transparent = image.info.get("transparency")
    if isinstance(transparent, int):
        grey[values == transparent] = 255
    return grey


def _damaged(kind: str, data: bytes) -> ImageUnreadable:
    return ImageUnreadable(
        f"The {kind} file of {len(data)} bytes could not be decoded, it is damaged or incomplete: send it whole."
    )
