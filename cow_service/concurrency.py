"""Who may work next where only so many may at the same time: who asked first, however often that was interrupted."""

from __future__ import annotations

import heapq
import itertools
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

LOOK = 0.1  # seconds between looks at whether somebody who waits is still wanted


@dataclass(order=True)
class _Waiting:
    rank: str
    number: int
    called: threading.Event = field(compare=False, default_factory=threading.Event)


def _wanted() -> None:
    """Nobody ends it."""


class Turns:
    """Like a semaphore, but the lowest rank comes first and nobody who comes later takes a turn that was promised.

    Ranks are texts that sort, such as the times at which requests came.
    """

    def __init__(self, at_once: int) -> None:
        self._free = at_once
        self._lock = threading.Lock()
        self._waiting: list[_Waiting] = []
        self._numbers = itertools.count()

    def take(self, rank: str = "", still_wanted: Callable[[], None] = _wanted) -> None:
        """Waits for a turn. What `still_wanted` raises in the meantime ends the wait."""
        with self._lock:
            if self._free and not self._waiting:
                self._free -= 1
                return
            mine = _Waiting(rank, next(self._numbers))
            heapq.heappush(self._waiting, mine)
            self._call()
        try:
            while not mine.called.wait(LOOK):
                still_wanted()
        except BaseException:
            with self._lock:
                if mine.called.is_set():
                    self._free += 1
                else:
                    self._waiting.remove(mine)
                    heapq.heapify(self._waiting)
                self._call()
            raise

    def give(self) -> None:
        """Gives a turn back."""
        with self._lock:
            self._free += 1
            self._call()

    @contextmanager
    def held(self, rank: str = "", still_wanted: Callable[[], None] = _wanted) -> Generator[None]:
        """A turn around the block."""
        self.take(rank, still_wanted)
        try:
            yield
        finally:
            self.give()

    @contextmanager
    def left(self, rank: str = "") -> Generator[None]:
        """Leaves a held turn to others around the block."""
        self.give()
        try:
            yield
        finally:
            self.take(rank)

    def _call(self) -> None:
        while self._free and self._waiting:
            self._free -= 1
            heapq.heappop(self._waiting).called.set()
