"""Checks and decodes image files, encodes PNG. Exceptions of pillow become `CowError` here.

Before pillow sees a file, everything that is not the picture is stripped: text, profiles, thumbnails. Nothing here
needs them, and decoders spend on them without bound: compressed text grows a thousandfold, an EXIF directory may name
the same bytes thousands of times, blocks are joined in quadratic time. Of EXIF the orientation and the focal length
are read, here.
"""

import base64
import codecs
import hashlib
import io
import math
import re
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, JpegImagePlugin, PngImagePlugin, WebPImagePlugin
from PIL.ImageFile import ImageFile

from cow_service import errors
from cow_service.media.artifacts import media_type_of
from cow_service.records import ImageInfo

MAX_IMAGE_MEGAPIXELS_DEFAULT = 25.0  # millions of pixels
JPEG_QUALITY = 90
MIN_SIDE = 8  # px; nothing that could move has room in less

# The classes rather than `Image.open`: that compares every size with `Image.MAX_IMAGE_PIXELS`, one limit for the whole
# process, which a library must not change under its host; it also fills its table of formats on first use, from
# whichever thread comes first. `JpegImageFile` reads the first picture of a multi-picture file (MPO), as phones write.
_OPENERS: dict[str, tuple[str, Callable[[io.BytesIO], ImageFile]]] = {
    "image/png": ("PNG", PngImagePlugin.PngImageFile),
    "image/jpeg": ("JPEG", JpegImagePlugin.JpegImageFile),
    "image/webp": ("WebP", WebPImagePlugin.WebPImageFile),
}

UPRIGHT = 1  # EXIF orientation, EXIF 2.3, section 4.6.4
MAX_PNG_CHUNKS = 100_000  # a file of 50 MB in pieces of 512 bytes
MAX_JPEG_SEGMENTS = 4096  # cameras write up to a few hundred
MAX_JPEG_SCANS = 100  # encoders write up to about 20; each goes over the whole picture again, however few its bytes

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_KEPT = frozenset((b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND", b"acTL", b"fcTL", b"fdAT"))
# Junk between segments is skipped, as decoders do: segments that they find behind it must be found here, too.
_JPEG_MARKER = re.compile(rb"\xff+([^\xff])", re.DOTALL)
_JPEG_ALONE = frozenset((0x00, 0x01, *range(0xD0, 0xD9)))  # without a length: stuffing, TEM, RST0 to RST7, SOI
_JPEG_END, _JPEG_SCAN, _JPEG_APP1, _JPEG_ADOBE, _JPEG_COMMENT = 0xD9, 0xDA, 0xE1, 0xEE, 0xFE
_JPEG_SCAN_START = b"\xff\xda"
_EXIF = b"Exif\0\0"
_ORIENTATION, _EXIF_DIRECTORY, _FOCAL_ON_FILM = 0x0112, 0x8769, 0xA405
_FILM = math.hypot(36.0, 24.0)  # mm: the diagonal that focal lengths "on 35 mm film" refer to
_WEBP_ANIMATED = 0x02  # flag of the first chunk (RFC 9649, section 2.7)
_TIFF_INTEGERS = {3: 2, 4: 4}  # bytes of a SHORT and a LONG

# By EXIF orientation: whether rows are stored as columns; the steps in which rows and columns are then stored.
_STORED = {
    2: (False, 1, -1),
    3: (False, -1, -1),
    4: (False, -1, 1),
    5: (True, 1, 1),
    6: (True, -1, 1),
    7: (True, -1, -1),
    8: (True, 1, -1),
}

_FOREIGN = {  # by what their first bytes match
    rb"GIF8": "a GIF file",
    rb"BM": "a BMP file",
    rb"II\*\0|MM\0\*": "a TIFF file",
    rb"%PDF": "a PDF file",
    rb"8BPS": "a Photoshop file",
    rb"PK\x03\x04": "a ZIP archive",
    rb"data:": "a data URL",
    rb"iVBORw0KGgo|/9j/|UklGR": "base64 text, not decoded",
    rb".{4}ftypavi[fs]": "an AVIF file",
    rb".{4}ftyp(heic|mif1)": "a HEIC file",
    rb".{4}ftyp": "an MP4 or other ISO media file",
    rb"(?i:(\xef\xbb\xbf)?\s*(<svg|(<\?xml|<!--|<!doctype svg).*<svg))": "an SVG file",
    rb"(?i:(\xef\xbb\xbf)?\s*(<!doctype html|<html))": "an HTML page",
}


@dataclass(frozen=True)
class DecodedImage:
    """The input image, upright, and the record that names it."""

    pixels: NDArray[np.uint8]  # [H, W, 3] RGB, C-contiguous and not to be written to
    info: ImageInfo
    media_type: str  # of the bytes as sent


def check(data: bytes, *, max_megapixels: float = MAX_IMAGE_MEGAPIXELS_DEFAULT) -> str:
    """The media type of a file that `decode` takes, as far as its header shows; raises what `decode` raises.

    The cost depends on the file's bytes and not on its pixels. No decoder sees them: all that runs is Python.
    """
    return _read_header(data, max_megapixels)[0]


def pixels_in(data: bytes) -> int:
    """How many pixels a file has, by its header. Raises what `check` raises."""
    return math.prod(_read_header(data, math.inf)[3])


def decode(data: bytes, *, max_megapixels: float = MAX_IMAGE_MEGAPIXELS_DEFAULT) -> DecodedImage:
    """Decode one PNG, JPEG or WebP file, recognised by its content, to upright 8-bit RGB.

    The EXIF orientation is applied, transparency is laid on white, and 16 bits become 8. Colours are taken as sRGB: an
    embedded ICC profile is ignored. The size is read from the header and refused before any pixel is decoded; text,
    profiles and other blocks beside the pixels are not decoded at all.

    Raises `ImageTypeUnsupported` for other types and for animations, `ImageTooLarge` above `max_megapixels` (millions
    of pixels), and `ImageUnreadable` for damaged files and for sides under `MIN_SIDE` px.
    """
    media_type, stripped, exif, _ = _read_header(data, max_megapixels)
    kind, opener = _OPENERS[media_type]
    with _damage_named(kind, data), opener(io.BytesIO(stripped)) as image:
        _check_frames(kind, int(getattr(image, "n_frames", 1)))
        if kind == "WebP":
            exif = _read_exif(image.info.get("exif", b""))
        pixels = _pixels_of(image, exif.get(_ORIENTATION, UPRIGHT))
    height, width = pixels.shape[:2]
    on_film = exif.get(_FOCAL_ON_FILM, 0)
    focal = on_film / _FILM * math.hypot(width, height) if 5 <= on_film <= 2000 else None  # mm, of any lens
    info = ImageInfo(width=width, height=height, sha256=hashlib.sha256(data).hexdigest(), focal=focal)
    return DecodedImage(pixels, info, media_type)


def _read_header(data: bytes, max_megapixels: float) -> tuple[str, bytes, dict[int, int], tuple[int, int]]:
    """The media type, the file without what is not the picture, its EXIF values, unless it is a WebP file, and its size
    as stored (px)."""
    if not data:
        raise errors.ImageUnreadable("The image is empty (0 bytes): send the bytes of a PNG, JPEG or WebP file.")
    media_type = media_type_of(data)
    if media_type is None or media_type not in _OPENERS:
        raise errors.ImageTypeUnsupported(f"The image is {_describe_foreign(data)}: send it as PNG, JPEG or WebP.")
    kind, opener = _OPENERS[media_type]
    with _damage_named(kind, data):
        if kind == "WebP":
            # Opening a WebP file runs its decoder, and allocates its whole canvas. Its other blocks can stay: they are
            # never decoded or joined by the decoder.
            size = _webp_size(data)
            _check_size(*size, max_megapixels)
            if data[12:16] == b"VP8X" and data[20] & _WEBP_ANIMATED:
                _check_frames(kind, data.count(b"ANMF"))
            return media_type, data, {}, size
        stripped, exif = _strip_png(data) if kind == "PNG" else _strip_jpeg(data)
        with opener(io.BytesIO(stripped)) as image:  # of these two pillow reads the header alone, in Python
            _check_size(image.width, image.height, max_megapixels)
            _check_frames(kind, int(getattr(image, "n_frames", 1)))
            return media_type, stripped, exif, image.size


@contextmanager
def _damage_named(kind: str, data: bytes) -> Generator[None]:
    """Turns what pillow raises on a damaged file into `ImageUnreadable`."""
    try:
        yield
    except (errors.CowError, MemoryError):
        raise
    except Exception as error:  # a dozen kinds
        raise errors.ImageUnreadable(
            f"The {kind} file of {len(data)} bytes could not be decoded: it is damaged or incomplete. Send it whole."
        ) from error


def _check_frames(kind: str, frames: int) -> None:
    if frames > 1:
        raise errors.ImageTypeUnsupported(f"The image is an animated {kind} of {frames} frames: send one frame of it.")


def decode_own(data: bytes) -> NDArray[np.uint8]:
    """Upright RGB pixels [H, W, 3] of a picture that this service wrote. Raises `InternalError` if it is damaged."""
    return np.ascontiguousarray(_decode_own(data, cv2.IMREAD_COLOR)[..., ::-1])


def decode_own_mask(data: bytes) -> NDArray[np.bool_]:
    """The mask [H, W] of a PNG that this service wrote. Raises as `decode_own`."""
    return _decode_own(data, cv2.IMREAD_GRAYSCALE) > 0


def _decode_own(data: bytes, how: int) -> NDArray[np.uint8]:
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), how)
    if pixels is None:
        raise errors.InternalError("A stored picture can no longer be read.")
    return np.asarray(pixels, np.uint8)


def decode_depth(data: bytes, *, max_megapixels: float) -> NDArray[np.uint16]:
    """The values [H, W] of a grey PNG of 16 bits, as they are stored. Raises as `decode`, and for other PNGs."""
    media_type, stripped, _, _ = _read_header(data, max_megapixels)
    kind, opener = _OPENERS[media_type]
    with _damage_named(kind, data), opener(io.BytesIO(stripped)) as image:
        if not image.mode.startswith("I"):
            detail = "It has colours or 8 bits per pixel: save it as 16-bit grey."
            raise errors.ImageTypeUnsupported(detail)
        return np.asarray(image).astype(np.uint16)


def encode_png(pixels: NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.bool_], *, level: int = 1) -> bytes:
    """Encode [H, W, 3] RGB, [H, W, 4] RGBA, [H, W] grey of 8 or 16 bits or an [H, W] mask (one bit each) as PNG.

    `level` is zlib's, 0 (none) to 9 (smallest). Raises `ValueError` for other shapes.
    """
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] not in (3, 4)) or pixels.size == 0:
        raise ValueError(
            f"Pixels of shape {pixels.shape} cannot be encoded: give [H, W, 3] RGB, [H, W, 4] RGBA or [H, W]."
        )
    options = [cv2.IMWRITE_PNG_COMPRESSION, level]
    if pixels.dtype == np.bool_:
        return _encoded(".png", pixels.view(np.uint8) * np.uint8(255), [*options, cv2.IMWRITE_PNG_BILEVEL, 1])
    # One filter for all rows: trying each takes twice as long. Runs alone: other matches are rarer than they cost.
    options += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_PAETH]
    options += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    return _encoded(".png", cast(NDArray[np.uint8], pixels), options)


def encode_jpeg(pixels: NDArray[np.uint8], quality: int = JPEG_QUALITY) -> bytes:
    """Encode [H, W, 3] RGB as JPEG without subsampling of colours: lines that are drawn stay sharp."""
    sampling = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return _encoded(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality, *sampling])


def _encoded(extension: str, pixels: NDArray[np.uint8], options: list[int]) -> bytes:
    order = None if pixels.ndim < 3 else cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    ordered = pixels if order is None else cv2.cvtColor(pixels, order)
    encoded, buffer = cv2.imencode(extension, ordered, options)
    if not encoded:
        raise errors.InternalError(f"Pixels of shape {pixels.shape} could not be encoded as {extension}.")
    return buffer.tobytes()


BAND = 256  # rows that are copied at a time
NEARLY = 0.75  # of a picture's size


def fit_within(pixels: NDArray[np.uint8], max_side: int | None) -> NDArray[np.uint8]:
    """Scale [H, W, 3] or [H, W] down, never up, to `max_side` px at most; None: no limit."""
    height, width = pixels.shape[:2]
    size = size_within(width, height, max_side)
    if size == (width, height):
        return pixels
    # Near its own size, the means of areas differ from linear interpolation by less than one grey level, at five times
    # the cost.
    how = cv2.INTER_LINEAR if max(size) > NEARLY * max(width, height) else cv2.INTER_AREA
    return np.asarray(cv2.resize(pixels, size, interpolation=how), dtype=np.uint8)


def size_within(width: int, height: int, max_side: int | None) -> tuple[int, int]:
    """Width and height (px) scaled down, never up, to `max_side` px at most; None: no limit."""
    longer = max(height, width)
    if max_side is None or longer <= max_side:
        return width, height
    return max(1, round(width * max_side / longer)), max(1, round(height * max_side / longer))


def tiled(frames: Sequence[NDArray[np.uint8]], columns: int, gap: int, grey: int) -> NDArray[np.uint8]:
    """Frames [h, w, 3] of one size in rows from left to right, at most `columns` in each, `gap` px of grey apart."""
    height, width = frames[0].shape[:2]
    columns = min(columns, len(frames))
    rows = -(-len(frames) // columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), grey, np.uint8)
    for place, frame in enumerate(frames):
        y, x = place // columns * (height + gap), place % columns * (width + gap)
        sheet[y : y + height, x : x + width] = frame
    return sheet


def _describe_foreign(data: bytes) -> str:
    head = data[:1024]
    for pattern, name in _FOREIGN.items():
        if re.match(pattern, head, re.DOTALL):
            return name
    try:
        # An incremental decoder waits for the rest of a character that the end of the sample cut in two.
        text = codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        text = "\0"
    if "".join(text.split()).isprintable():
        return "text"
    return f"of no known type (it begins with the bytes {data[:8].hex(' ')})"


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
    raise ValueError("no known first chunk")


def _check_size(width: int, height: int, max_megapixels: float) -> None:
    megapixels = width * height / 1e6
    if megapixels > max_megapixels:
        raise errors.ImageTooLarge(
            f"The image is {width} x {height} px, {megapixels:.2f} megapixels, over the limit of {max_megapixels:g}: "
            "scale it down and send it again."
        )
    if min(width, height) < MIN_SIDE:
        raise errors.ImageUnreadable(
            f"The image is {width} x {height} px, too small to hold an object: "
            f"send one with both sides at least {MIN_SIDE} px."
        )


def _to_rgb(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):
        # 16 bits. Pillow's own conversion clips at 255 instead of scaling.
        values = np.asarray(image).astype(np.uint32)
        grey = ((values + 128) // 257).astype(np.uint8)
        transparent = image.info.get("transparency")
        if isinstance(transparent, int):
            grey[values == transparent] = 255
        return Image.fromarray(grey).convert("RGB")
    if image.has_transparency_data:
        white = Image.new("RGBA", image.size, "white")
        return Image.alpha_composite(white, image.convert("RGBA")).convert("RGB")
    return image if image.mode == "RGB" else image.convert("RGB")


def _pixels_of(image: Image.Image, orientation: int) -> NDArray[np.uint8]:
    """RGB [H, W, 3], upright, converted and copied in bands: at once, pillow would make several copies on the way."""
    width, height = image.size
    is_turned, down, across = _STORED.get(orientation, (False, 1, 1))
    pixels = np.empty((width, height, 3) if is_turned else (height, width, 3), np.uint8)
    stored = (pixels.swapaxes(0, 1) if is_turned else pixels)[::down, ::across]
    for top in range(0, height, BAND):
        stored[top : top + BAND] = np.asarray(_to_rgb(image.crop((0, top, width, min(top + BAND, height)))))
    return pixels


def _strip_png(data: bytes) -> tuple[bytes, dict[int, int]]:
    """A PNG file without its ancillary chunks, except transparency and animation; and its EXIF values."""
    kept = [_PNG_SIGNATURE]
    exif: dict[int, int] = {}
    at = len(_PNG_SIGNATURE)
    for _ in range(MAX_PNG_CHUNKS):
        head = data[at : at + 8]
        if len(head) < 8:  # truncated: the decoder reports it
            return b"".join((*kept, head)), exif
        end = at + 12 + int.from_bytes(head[:4])
        name = head[4:]
        if name in _PNG_KEPT:
            kept.append(data[at:end])
        elif name == b"eXIf":
            exif = _read_exif(data[at + 8 : end - 4])
        if name == b"IEND":
            return b"".join(kept), exif
        at = end
    raise _overfull(f"a PNG file of more than {MAX_PNG_CHUNKS} chunks")


def _strip_jpeg(data: bytes) -> tuple[bytes, dict[int, int]]:
    """A JPEG file without application segments and comments, except Adobe's colours; and its EXIF values."""
    kept = [data[:2]]
    exif: dict[int, int] = {}
    at = 2
    for _ in range(MAX_JPEG_SEGMENTS):
        found = _JPEG_MARKER.search(data, at)
        if found is None:  # truncated: the decoder reports it
            return b"".join(kept), exif
        at, marker = found.end(), found[1][0]
        if marker in _JPEG_ALONE:
            continue
        if marker in (_JPEG_SCAN, _JPEG_END):
            rest = data[at - 2 :]
            if (scans := rest.count(_JPEG_SCAN_START)) > MAX_JPEG_SCANS:
                raise _overfull(f"a JPEG file of {scans} scans, more than {MAX_JPEG_SCANS}")
            return b"".join((*kept, rest)), exif
        end = at + int.from_bytes(data[at : at + 2])
        if marker == _JPEG_ADOBE or not (0xE0 <= marker <= 0xEF or marker == _JPEG_COMMENT):
            kept.append(data[at - 2 : end])
        elif marker == _JPEG_APP1 and not exif and data.startswith(_EXIF, at + 2):
            exif = _read_exif(data[at + 2 : end])
        at = end
    raise _overfull(f"a JPEG file of more than {MAX_JPEG_SEGMENTS} segments")


def _overfull(what: str) -> errors.ImageUnreadable:
    """For a file of more parts than any camera or program writes."""
    return errors.ImageUnreadable(f"The image is {what}: save it again with another program and send that.")


def _read_exif(exif: bytes) -> dict[int, int]:
    """By their tags, the orientation (1 to 8) and the focal length on 35 mm film (mm), where an EXIF block has them."""
    tiff, found = exif.removeprefix(_EXIF), dict[int, int]()
    if tiff[:2] not in (b"II", b"MM"):
        return found
    order: Literal["little", "big"] = "little" if tiff[:2] == b"II" else "big"

    def number(at: int, size: int) -> int:
        return int.from_bytes(tiff[at : at + size], order)

    def read(start: int, wanted: tuple[int, ...]) -> None:
        for entry in range(start + 2, min(start + 2 + 12 * number(start, 2), len(tiff) - 11), 12):
            tag, kind, count = number(entry, 2), number(entry + 2, 2), number(entry + 4, 4)
            if tag in wanted and tag not in found and count == 1 and kind in _TIFF_INTEGERS:
                found[tag] = number(entry + 8, _TIFF_INTEGERS[kind])

    read(number(4, 4), (_ORIENTATION, _EXIF_DIRECTORY))
    if _EXIF_DIRECTORY in found:
        read(found.pop(_EXIF_DIRECTORY), (_FOCAL_ON_FILM,))
    return found


_DATA_URL = re.compile(r"data:(?P<type>[\w.+/-]*)(?:;[\w.+-]+=[^;,]*)*(?P<base64>;base64)?,", re.ASCII)


def decode_data_url(url: str, pointer: str = "/image") -> bytes:
    """The bytes of a base64 data URL; blanks and line ends in it are skipped.

    Raises `InvalidRequest` pointing at the field of the request that holds it, and `ImageTypeUnsupported` where it
    declares something else.
    """
    field = errors.field_of(pointer)
    head = _DATA_URL.match(url[:256])
    if head is None or head["base64"] is None:
        fault = f"`{field}` must be a data URL with base64: data:image/png;base64,..."
        raise errors.InvalidRequest(fault, errors=(errors.FieldError(pointer, fault),))
    declared = head["type"].lower()
    if not declared.startswith("image/") and declared not in ("", "application/octet-stream"):
        # The image type is detected from the bytes; the declared type is ignored.
        raise errors.ImageTypeUnsupported(
            f"The data URL of `{field}` declares {declared[:80]}: send image/png, image/jpeg or image/webp."
        )
    try:
        # Tools that write base64 break it into lines.
        return base64.b64decode("".join(url[head.end() :].split()), validate=True)
    except ValueError as error:
        fault = (
            f"The base64 of `{field}` cannot be decoded ({error}): encode the file's bytes in the standard alphabet."
        )
        raise errors.InvalidRequest(fault, errors=(errors.FieldError(pointer, fault),)) from error
