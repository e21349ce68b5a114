"""Files that image decoders have trouble with, made by hand: bombs, odd colour types, directories without end."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from PIL import Image

SIGNATURE = b"\x89PNG\r\n\x1a\n"
MEBI = 2**20


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def zeros(length: int) -> bytes:
    """A valid zlib stream of that many zero bytes, without ever holding them."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(MEBI)) + packer.flush(zlib.Z_FULL_FLUSH)
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    rest = packer.compress(bytes(length % MEBI)) + packer.flush(zlib.Z_FINISH)
    adler = (length % 65521) << 16 | 1
    return b"\x78\x9c" + block * (length // MEBI) + rest + struct.pack(">I", adler)


def png_of(width: int, height: int, depth: int, colour_type: int, stream: bytes, between: bytes = b"") -> bytes:
    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    return SIGNATURE + chunk(b"IHDR", header) + between + chunk(b"IDAT", stream) + chunk(b"IEND", b"")


def bomb(width: int, height: int) -> bytes:
    """A valid black PNG, grey with 8 bits."""
    return png_of(width, height, 8, 0, zeros(height * (width + 1)))


def png16(values: NDArray[np.uint16], colour_type: int) -> bytes:
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    return png_of(values.shape[1], values.shape[0], 16, colour_type, zlib.compress(rows))


def with_chunks(png: bytes, chunks: Iterable[bytes]) -> bytes:
    """A PNG with more chunks right behind its header."""
    return png[:33] + b"".join(chunks) + png[33:]


def with_segments(jpeg: bytes, segments: bytes) -> bytes:
    """A JPEG with more segments right behind its start."""
    return jpeg[:2] + segments + jpeg[2:]


def texts(count: int, each: int) -> list[bytes]:
    """Compressed text chunks under keywords of their own, each of `each` characters."""
    packed = zeros(each)
    return [chunk(b"zTXt", b"key%d\0\0" % number + packed) for number in range(count)]


def wide_texts(count: int) -> list[bytes]:
    """Compressed international text: of a MiB in UTF-8, and of four where characters are held in four bytes."""
    packed = zlib.compress(("a" * (MEBI - 4) + "\U0001f600").encode())
    return [chunk(b"iTXt", b"key%d\0\1\0\0\0" % number + packed) for number in range(count)]


def exif_bomb() -> bytes:
    """An EXIF segment whose directory names nearly the same 60,000 bytes 400 times."""
    entries, size = 400, 60_000
    start = 8 + 2 + 12 * entries + 4
    listed = b"".join(struct.pack(">HHII", 0x9000 + i, 1, size, start) for i in range(entries))
    tiff = b"MM\0*" + struct.pack(">IH", 8, entries) + listed + bytes(4 + size)
    body = b"Exif\0\0" + tiff
    return b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body


def scans(jpeg: bytes, count: int) -> bytes:
    """A progressive JPEG whose last scan comes that many times more."""
    last = jpeg[jpeg.rindex(b"\xff\xda") : -2]
    return jpeg[:-2] + last * count + jpeg[-2:]


def saved(image: Image.Image, kind: str = "PNG", **options) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def located(upright: Image.Image, secret: str) -> bytes:
    """A JPEG with a place, an owner and a comment in its EXIF block, XMP and comment segment."""
    exif = Image.Exif()
    exif[0x010F] = secret
    exif.get_ifd(0x8825).update({1: "N", 2: (48.0, 51.0, 29.6), 3: "E", 4: (2.0, 17.0, 40.2), 29: "2024:01:01"})
    exif.get_ifd(0x8769)[0x9286] = b"ASCII\0\0\0" + secret.encode()
    return saved(
        upright, "JPEG", quality=95, exif=exif, comment=secret.encode(), xmp=b"<x>" + secret.encode() + b"</x>"
    )
