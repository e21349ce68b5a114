"""Long texts of the job database, deflated: a trajectory is tens of kilobytes of digits."""

from __future__ import annotations

import base64
import zlib

LEAST = 2000  # characters: shorter texts stay as they are
LEVEL = 3  # of zlib: higher ones take several times as long and save a twentieth
MARK = "deflated:"  # no JSON begins like this


def packed(text: str) -> str:
    """The text as the database keeps it."""
    if len(text) < LEAST:
        return text
    return MARK + base64.b64encode(deflated(text)).decode()


def unpacked(kept: str) -> str:
    """The text that was packed; one of an earlier version is as it was written."""
    if not kept.startswith(MARK):
        return kept
    return inflated(base64.b64decode(kept[len(MARK) :]))


def deflated(text: str) -> bytes:
    """The text as a column of bytes keeps it."""
    return zlib.compress(text.encode(), LEVEL)


def inflated(kept: bytes) -> str:
    """The text that was deflated."""
    return zlib.decompress(kept).decode()
