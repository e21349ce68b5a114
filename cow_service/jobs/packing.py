"""JSON as the job database keeps it: compressed, and of long lists of numbers, such as paths, their second differences.

What moves smoothly has second differences of a digit or two, which compress to a third of what the numbers do.
"""

from __future__ import annotations

import zlib
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json, to_json

DEFLATE_LEVEL = 3  # of zlib: higher ones take several times as long and save a twentieth
LEAST_ROWS = 16  # of a list: shorter ones stay as they are
MOST_DECIMALS, MOST = 6, 2.0**40  # of its numbers, and their size in units of the last decimal
ROWS, DECIMALS = "~rows", "~decimals"  # keys of what stands for a list: its columns, and the decimals of its numbers


def packed(json: str) -> bytes:
    """A JSON text."""
    return zlib.compress(json.encode(), DEFLATE_LEVEL)


def packed_paths(json: str) -> bytes:
    """A JSON text with long lists of numbers."""
    return zlib.compress(to_json(_shortened(from_json(json))), DEFLATE_LEVEL)


def unpacked(kept: bytes) -> Any:
    """The values of a JSON text that was packed one way or the other."""
    text = zlib.decompress(kept)
    values = from_json(text)
    return _restored(values) if f'"{ROWS}"'.encode() in text else values


def _shortened(value: Any) -> Any:
    """The same with what stands for its long lists of numbers, or of lists of numbers; of these nothing is lost."""
    if isinstance(value, dict):
        return {key: _shortened(each) for key, each in value.items()}
    if not isinstance(value, list):
        return value
    numbers = _numbers(value)
    if numbers is None:
        return [_shortened(each) for each in value]
    has_negative_zero = bool((np.signbit(numbers) & (numbers == 0)).any())
    for decimals in () if has_negative_zero else range(MOST_DECIMALS + 1):
        units = np.round(numbers * 10**decimals)
        if np.abs(units).max() < MOST and (units / 10**decimals == numbers).all():
            columns = np.diff(units.astype(np.int64), n=2, axis=0, prepend=np.zeros((2, *units.shape[1:]), np.int64))
            return {ROWS: columns.T.tolist(), DECIMALS: decimals}
    return value


def _numbers(rows: list[Any]) -> NDArray[np.float64] | None:
    """A long list of floats [N], or of rows of as many [N, K]; None for any other."""
    first = rows[0] if rows else None
    if len(rows) < LEAST_ROWS or type(first[0] if isinstance(first, list) and first else first) is not float:
        return None
    try:
        numbers = np.array(rows, np.float64)
    except (TypeError, ValueError):  # rows of several lengths, or something else among them
        return None
    leaves = chain.from_iterable(rows) if numbers.ndim == 2 else rows
    return numbers if numbers.ndim < 3 and all(type(each) is float for each in leaves) else None


def _restored(value: Any) -> Any:
    if isinstance(value, list):
        return [_restored(each) for each in value]
    if not isinstance(value, dict):
        return value
    if ROWS not in value:
        return {key: _restored(each) for key, each in value.items()}
    units = np.array(value[ROWS], np.int64).T.cumsum(axis=0).cumsum(axis=0)
    return (units / 10 ** value[DECIMALS]).tolist()
