"""Range requests (RFC 9110, section 14): which are honoured, which are ignored, which are refused."""

from __future__ import annotations

import re

from cow_service.errors import RangeNotSatisfiable

MOST_RANGES = 8  # more in one request is no way to read a video: the whole is sent instead
_SPEC = re.compile(r"(\d{1,18})-(\d{0,18})|-(\d{1,18})", re.ASCII)


def is_honoured(header: str, size: int) -> bool:
    """Whether a Range header is to be answered with parts of `size` bytes; one that is malformed is ignored.

    Raises `RangeNotSatisfiable` where every range lies outside.
    """
    unit, _, listed = header.partition("=")
    specs = [_SPEC.fullmatch(part.strip()) for part in listed.split(",")[: MOST_RANGES + 1]]
    if unit.strip().lower() != "bytes" or len(specs) > MOST_RANGES or not all(specs):
        return False
    reached = False
    for first, last, suffix in (spec.groups() for spec in specs if spec is not None):
        if first is not None and last and int(last) < int(first):
            return False
        reached |= int(suffix) > 0 if first is None else int(first) < size
    if not reached:
        raise RangeNotSatisfiable(
            f"The artifact has {size} bytes; '{header[:80]}' lies outside.",
            headers={"Content-Range": f"bytes */{size}"},
        )
    return True
