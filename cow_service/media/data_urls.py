"""Images as data URLs (RFC 2397)."""

from __future__ import annotations

import base64
import binascii
import re

from cow_service.errors import CowError, FieldError, ImageTypeUnsupported, InvalidRequest, field_of

_DATA_URL = re.compile(r"data:(?P<type>[\w.+/-]*)(?:;[\w.+-]+=[^;,]*)*(?P<base64>;base64)?,", re.ASCII)


def decode_data_url(url: str, pointer: str = "/image") -> bytes:
    """The bytes of a base64 data URL; blanks and line ends in it are skipped.

    Raises `InvalidRequest` pointing at the field of the request that holds it, and `ImageTypeUnsupported` where it
    declares something else.
    """
    field = field_of(pointer)
    head = _DATA_URL.match(url[:256])
    if head is None or head["base64"] is None:
        raise _bad_image(f"`{field}` must be a data URL with base64: data:image/png;base64,...", pointer)
    declared = head["type"].lower()
    if not declared.startswith("image/") and declared not in ("", "application/octet-stream"):
        # Of the image types, what the bytes are counts, and not what they are declared to be.
        raise ImageTypeUnsupported(
            f"The data URL of `{field}` declares {declared[:80]}: send image/png, image/jpeg or image/webp."
        )
    try:
        # Tools that write base64 break it into lines.
        return base64.b64decode("".join(url[head.end() :].split()), validate=True)
    except (binascii.Error, ValueError) as error:
        raise _bad_image(
            f"The base64 of `{field}` cannot be decoded ({error}): encode the file's bytes in the standard alphabet.",
            pointer,
        ) from error


def _bad_image(detail: str, pointer: str) -> CowError:
    return InvalidRequest(detail, errors=(FieldError(pointer, detail),))
