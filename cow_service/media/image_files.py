"""Image files without what is no picture: text, profiles, thumbnails and other blocks never reach the decoder.

Nothing that the service computes needs them, and decoders spend on them without bound: compressed text grows a
thousandfold, an EXIF directory may name the same bytes thousands of times, blocks are joined in quadratic time. Only
the orientation is read, here.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

UPRIGHT = 1  # EXIF 2.3, section 4.6.4
MAX_PNG_CHUNKS = 100_000  # a file of 50 MB in pieces of 512 bytes
MAX_JPEG_SEGMENTS = 4096  # cameras write up to a few hundred
MAX_JPEG_SCANS = 100  # encoders write up to about 20; each goes over the whole picture again, however few its bytes

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PNG_KEPT = frozenset((b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND", b"acTL", b"fcTL", b"fdAT"))
# Junk between segments is skipped, as decoders do: what they find behind it must be found here, too.
_JPEG_MARKER = re.compile(rb"\xff+([^\xff])", re.DOTALL)
_JPEG_ALONE = frozenset((0x00, 0x01, *range(0xD0, 0xD9)))  # without a length: stuffing, TEM, RST0 to RST7, SOI
_JPEG_END, _JPEG_SCAN, _JPEG_APP1, _JPEG_ADOBE, _JPEG_COMMENT = 0xD9, 0xDA, 0xE1, 0xEE, 0xFE
_JPEG_SCAN_START = b"\xff\xda"
_EXIF = b"Exif\0\0"
_ORIENTATION = 0x0112
_TIFF_INTEGERS = {3: "H", 4: "I"}  # SHORT, LONG


class OverfullError(ValueError):
    """A file of more parts than any camera or program writes. The message says what it is."""


@dataclass(frozen=True)
class LeanFile:
    """A file that holds the picture and no more, and the EXIF orientation of what it held before."""

    data: bytes
    orientation: int = UPRIGHT


def lean_png(data: bytes) -> LeanFile:
    """A PNG file without its ancillary chunks, but for transparency and those that tell an animation.

    Raises `OverfullError`.
    """
    kept = [_PNG_SIGNATURE]
    orientation = UPRIGHT
    at = len(_PNG_SIGNATURE)
    for _ in range(MAX_PNG_CHUNKS):
        head = data[at : at + 8]
        if len(head) < 8:  # cut short: for the decoder to say
            return LeanFile(b"".join((*kept, head)), orientation)
        end = at + 12 + int.from_bytes(head[:4])
        name = head[4:]
        if name in _PNG_KEPT:
            kept.append(data[at:end])
        elif name == b"eXIf":
            orientation = orientation_of(data[at + 8 : end - 4])
        if name == b"IEND":
            return LeanFile(b"".join(kept), orientation)
        at = end
    raise OverfullError(f"a PNG file of more than {MAX_PNG_CHUNKS} chunks")


def lean_jpeg(data: bytes) -> LeanFile:
    """A JPEG file without its application segments and comments, but for Adobe's, which tells how colours are stored.

    Raises `OverfullError`.
    """
    kept = [data[:2]]
    orientation = UPRIGHT
    at = 2
    for _ in range(MAX_JPEG_SEGMENTS):
        found = _JPEG_MARKER.search(data, at)
        if found is None:  # cut short: for the decoder to say
            return LeanFile(b"".join(kept), orientation)
        at, marker = found.end(), found[1][0]
        if marker in _JPEG_ALONE:
            continue
        if marker in (_JPEG_SCAN, _JPEG_END):
            rest = data[at - 2 :]
            if (scans := rest.count(_JPEG_SCAN_START)) > MAX_JPEG_SCANS:
                raise OverfullError(f"a JPEG file of {scans} scans, more than {MAX_JPEG_SCANS}")
            return LeanFile(b"".join((*kept, rest)), orientation)
        end = at + int.from_bytes(data[at : at + 2])
        if marker == _JPEG_ADOBE or not (0xE0 <= marker <= 0xEF or marker == _JPEG_COMMENT):
            kept.append(data[at - 2 : end])
        elif marker == _JPEG_APP1 and orientation == UPRIGHT and data.startswith(_EXIF, at + 2):
            orientation = orientation_of(data[at + 2 : end])
        at = end
    raise OverfullError(f"a JPEG file of more than {MAX_JPEG_SEGMENTS} segments")


def orientation_of(exif: bytes) -> int:
    """The orientation (1 to 8) that an EXIF block names in its first directory; 1 where it names none."""
    tiff = exif.removeprefix(_EXIF)
    order = {b"II": "<", b"MM": ">"}.get(tiff[:2])
    if order is None or len(tiff) < 8:
        return UPRIGHT
    start = int(struct.unpack_from(f"{order}I", tiff, 4)[0])
    if start + 2 > len(tiff):
        return UPRIGHT
    entries = int(struct.unpack_from(f"{order}H", tiff, start)[0])
    for entry in range(start + 2, min(start + 2 + 12 * entries, len(tiff) - 11), 12):
        tag, kind, count = struct.unpack_from(f"{order}HHI", tiff, entry)
        if tag == _ORIENTATION and count == 1 and kind in _TIFF_INTEGERS:
            value = int(struct.unpack_from(order + _TIFF_INTEGERS[kind], tiff, entry + 8)[0])
            return value if 1 <= value <= 8 else UPRIGHT
    return UPRIGHT
