"""The one way to wait in a test: ask again until what is awaited is there."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from typing import TypeVar

import anyio

TIME_LIMIT = 120.0  # seconds: no test expects something this late, so a busy machine does not fail one
PAUSE = 0.02  # seconds between two looks

Value = TypeVar("Value")


def eventually(look: Callable[[], Value | None]) -> Value:
    """The first true value that `look` returns; fails after `TIME_LIMIT`."""
    until = time.monotonic() + TIME_LIMIT
    while not (found := look()):
        assert time.monotonic() < until, f"not within {TIME_LIMIT:g} s"
        time.sleep(PAUSE)
    return found


async def eventually_async(look: Callable[[], Awaitable[Value | None]]) -> Value:
    """As `eventually`, in an event loop."""
    until = time.monotonic() + TIME_LIMIT
    while not (found := await look()):
        assert time.monotonic() < until, f"not within {TIME_LIMIT:g} s"
        await anyio.sleep(PAUSE)
    return found
