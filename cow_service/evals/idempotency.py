"""Idempotency keys: a run that goes on gets the jobs that it has asked for before, and asks nothing twice."""

from __future__ import annotations

import hashlib
from collections.abc import Awaitable, Callable
from typing import TypeVar

from cow_service.client.errors import Canceled

MAX_INTERRUPTS = 20  # of one run, each of which may have canceled the same job
Result = TypeVar("Result")


async def asked_once(ask: Callable[[str], Awaitable[Result]], *parts: str) -> Result:
    """What `ask` returns under the key of these parts.

    A job that an interrupt has canceled stays so under its key: then there is another key. Raises what `ask` raises.
    """
    for attempt in range(MAX_INTERRUPTS):
        key = hashlib.sha256("\n".join((*parts, str(attempt))).encode()).hexdigest()
        try:
            return await ask(key)
        except Canceled:
            continue
    raise Canceled(f"The same job was canceled {MAX_INTERRUPTS} times.")
