"""Finds out how many calls the other side takes at the same time, as it does not say so (AIMD).

The limit doubles every round trip until the first refusal, then halves. From there it doubles to just below the level
that was refused, approaches that by one a round trip, and stays there for a while before it tries one more.
"""

import asyncio
import math
import threading
import time
from collections.abc import AsyncGenerator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from http import HTTPStatus

FIRST = 8  # calls at the same time, before anything is known
BUSY = frozenset({
    HTTPStatus.TOO_MANY_REQUESTS, HTTPStatus.BAD_GATEWAY, HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.GATEWAY_TIMEOUT,
    529,  # of Anthropic and others: overloaded
})  # fmt: skip
NEAR = 0.9  # share of the refused level up to which the limit doubles
HOLD_ROUNDS, HOLD_CALLS = 8, 64  # both pass at the refused level before one more is tried
MAX_PAUSE_SECONDS = 60.0  # a server that asks for a longer pause is asked again after this time


class AdaptiveLimit:
    """How many calls may be in flight, at least 1 and at most `most`. Thread-safe; it makes no calls and never waits.

    It grows only while calls wait for a place. Calls that were in flight when it was halved do not halve it again.
    Growth is spread over a round trip, so that few calls are refused before the first refusal comes back.
    """

    def __init__(self, most: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.most, self.in_flight = most, 0
        self._limit = float(min(FIRST, most))
        self._clock, self._lock = clock, threading.Lock()
        self._ceiling = math.inf  # calls in flight that were accepted when one more was refused
        self._credit = 0.0  # growth that successes have earned
        self._latency = 0.0  # of the last successes, seconds
        self._full_at = self._grown_at = self._cut_at = self._resumes_at = -math.inf
        self._succeeded = True  # since the last halving

    @property
    def limit(self) -> int:
        """Calls that may be in flight now."""
        return int(self._limit)

    @property
    def seconds_paused(self) -> float:
        """How much longer the other side has asked not to be called."""
        return max(0.0, self._resumes_at - self._clock())

    def seconds_to_wait(self) -> float:
        """Seconds before a call may begin: 0 at once, infinity where another one must end first."""
        with self._lock:
            now = self._clock()
            if self.in_flight >= self.limit:
                self._full_at = now
            seconds_to_grow = self._grown_at + self._latency / (2 * self._limit) - now
            if self._credit >= 1 and seconds_to_grow <= 0:
                self._limit, self._credit, self._grown_at = min(self.most, self._limit + 1), self._credit - 1, now
            if now < self._resumes_at:
                return self._resumes_at - now
            if self.in_flight < self.limit:
                return 0.0
            return max(seconds_to_grow, 0.001) if self._credit >= 1 and self.limit < self.most else math.inf

    def begin(self) -> float:
        """A call begins, once `seconds_to_wait` is 0. Returns the time, by which `end` and `refuse` know the call."""
        with self._lock:
            self.in_flight += 1
            return self._clock()

    def end(self, began: float, *, succeeded: bool) -> None:
        """A call has ended. Only successes count for growth."""
        with self._lock:
            self.in_flight -= 1
            if not succeeded or began <= self._cut_at:
                return
            self._succeeded = True
            seconds = max(self._clock() - began, 1e-6)
            self._latency += (seconds - self._latency) / 4 if self._latency else seconds
            if began <= self._full_at:  # a call waited for a place meanwhile
                self._credit = min(self._credit + self._growth(), self._limit)

    def refuse(self, began: float, retry_after: float | None = None) -> None:
        """The other side was too busy for a call, and maybe said after how many seconds to call again. Still `end` it.

        Also for timeouts and refused connections.
        """
        with self._lock:
            now = self._clock()
            self._resumes_at = max(self._resumes_at, now + min(retry_after or 0.0, MAX_PAUSE_SECONDS))
            if began <= self._cut_at:
                return
            if self._succeeded:  # else nothing works, at whatever level
                self._ceiling = max(1, self.in_flight - 1)
            self._limit = max(1.0, min(self._limit, self.in_flight) / 2)
            self._credit, self._cut_at, self._succeeded = 0.0, now, False

    def _growth(self) -> float:
        """By how much one success raises the limit; there are `limit` of them in a round trip."""
        if self._limit < NEAR * self._ceiling:
            return 1.0
        if self._limit < self._ceiling:
            return 1 / self._limit
        if self._limit < self._ceiling + 1:
            return 1 / max(HOLD_ROUNDS * self._limit, HOLD_CALLS)
        return (self._limit - self._ceiling) / self._limit  # more is accepted than before: faster and faster


@dataclass
class Call:
    """A call that holds a place; its caller reports the outcome."""

    limit: AdaptiveLimit
    began: float
    succeeded: bool = False

    def refuse(self, retry_after: float | None = None) -> None:
        """The other side was too busy."""
        self.limit.refuse(self.began, retry_after)


class AdaptivePlaces:
    """Places for calls on one event loop, first come, first served: as many as an adaptive limit allows."""

    def __init__(self, most: int) -> None:
        self.limit = AdaptiveLimit(most)
        self.waiting = 0  # calls
        self._turn = asyncio.Lock()
        self._ended = asyncio.Event()

    @asynccontextmanager
    async def held(self) -> AsyncGenerator[Call]:
        """Waits for a place, and holds it around the block."""
        self.waiting += 1
        try:
            async with self._turn:
                while (seconds := self.limit.seconds_to_wait()) > 0:
                    self._ended.clear()
                    with suppress(TimeoutError):
                        async with asyncio.timeout(None if seconds == math.inf else seconds):
                            await self._ended.wait()
                call = Call(self.limit, self.limit.begin())
        finally:
            self.waiting -= 1
        try:
            yield call
        finally:
            self.limit.end(call.began, succeeded=call.succeeded)
            self._ended.set()
