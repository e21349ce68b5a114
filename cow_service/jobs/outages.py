"""Waits while the database or the disk is away: an outage is no fault of the jobs that it meets."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from cow_service.errors import StorageUnavailable

FIRST_WAIT, LONGEST_WAIT = 0.1, 2.0  # seconds between two tries

Value = TypeVar("Value")
log = logging.getLogger("cow_service")


@dataclass(frozen=True)
class Outages:
    """How long a job waits for storage, and who tells that nobody wants its result any more."""

    budget: float  # seconds, of each outage
    check_canceled: Callable[[], None]

    def wait_through(self, work: Callable[[], Value]) -> Value:
        """What `work` returns, tried again while storage is away.

        Raises `StorageUnavailable` where it is away for longer than the budget, and what `check_canceled` raises.
        """
        began, wait = time.monotonic(), FIRST_WAIT
        while True:
            try:
                return work()
            except StorageUnavailable as error:
                left = began + self.budget - time.monotonic()
                if left <= 0:
                    raise
                log.warning("a job waits: %s", error.detail)
                self._sleep(min(wait, left))
                wait = min(2 * wait, LONGEST_WAIT)

    def _sleep(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            self.check_canceled()
            time.sleep(min(FIRST_WAIT, left))
