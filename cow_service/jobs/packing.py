"""JSON as the job database keeps it: compressed."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from pydantic_core import from_json

DEFLATE_LEVEL = 3  # of zlib: higher ones take several times as long and save a twentieth
ROWS, DECIMALS = "~rows", "~decimals"  # by which earlier versions kept second differences in place of lists of numbers


def packed(json: str) -> bytes:
    """A JSON text."""
    return zlib.compress(json.encode(), DEFLATE_LEVEL)


def unpacked(kept: bytes) -> Any:
    """The values of a JSON text that was packed, by this version or an earlier one."""
    text = zlib.decompress(kept)
    values = from_json(text)
    return _restored(values) if f'"{ROWS}"'.encode() in text else values


def _restored(value: Any) -> Any:
    if isinstance(value, list):
        return [_restored(each) for each in value]
    if not isinstance(value, dict):
        return value
    if ROWS not in value:
        return {key: _restored(each) for key, each in value.items()}
    units = np.array(value[ROWS], np.int64).T.cumsum(axis=0).cumsum(axis=0)
    return (units / 10 ** value[DECIMALS]).tolist()
