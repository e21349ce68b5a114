"""Threads and processes: a semaphore with priorities, and processes that end with the one that started them."""

from __future__ import annotations

import bisect
import ctypes
import gc
import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

CANCEL_POLL_SECONDS = 0.1  # how often a waiting thread checks whether it was canceled
PASSED_SECONDS = 30.0  # that others may pass who waits for many permits


@contextmanager
def on_one_core() -> Generator[None]:
    """Keeps this thread, and the threads that it starts meanwhile, on the core that it runs on.

    For work that a library hands to a thread of its own and waits for, many times a millisecond. Where the system has
    no such thing, or does not allow it, nothing changes.
    """
    cores = set[int]()
    with suppress(OSError, ValueError, AttributeError, TypeError):
        running_on, cores = ctypes.CDLL(None).sched_getcpu(), os.sched_getaffinity(0)
        os.sched_setaffinity(0, {running_on})
    try:
        yield
    finally:
        if cores:
            with suppress(OSError):
                os.sched_setaffinity(0, cores)


M_MMAP_THRESHOLD, LARGE = -3, 8 << 20  # mallopt(3); bytes: more than arrays of a picture of 832 x 480 px take


def return_large_blocks() -> None:
    """Has each large block of memory go back to the system as soon as it is freed, where the C library is glibc.

    By default glibc stops doing so with the first of them: at 24 megapixels a job with masks then took 200 MB more.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, LARGE)


def free_memory() -> None:
    """Gives memory that is no longer used back to the system; what a job leaves behind refers to itself."""
    gc.collect()
    with suppress(OSError, AttributeError):  # of other C libraries than glibc
        ctypes.CDLL(None).malloc_trim(0)


@dataclass(order=True)
class _Waiter:
    priority: str
    number: int
    weight: int = field(compare=False)
    since: float = field(compare=False, default_factory=time.monotonic)
    granted: threading.Event = field(compare=False, default_factory=threading.Event)


class PrioritySemaphore:
    """Lets threads in that hold `permits` together. Of those that wait, the lowest priority comes first, then FIFO.

    Priorities are strings that sort, such as the RFC 3339 times at which requests came. A released permit is granted to
    a waiter at once, so that no later thread can take it first. Who needs more permits than there are at the moment is
    passed by those who need fewer for `PASSED_SECONDS`; then all others wait for it. Who needs more than all takes all.
    """

    def __init__(self, permits: int) -> None:
        self._permits = self._all = permits
        self._lock = threading.Lock()
        self._waiting: list[_Waiter] = []
        self._numbers = itertools.count()

    @property
    def waiting(self) -> int:
        """How many threads wait."""
        return len(self._waiting)

    @contextmanager
    def held(
        self, priority: str = "", check_canceled: Callable[[], None] = lambda: None, weight: int = 1
    ) -> Generator[None]:
        """Holds `weight` permits around the block. What `check_canceled` raises ends the wait. Not reentrant."""
        waiter = _Waiter(priority, next(self._numbers), min(weight, self._all))
        with self._lock:
            bisect.insort(self._waiting, waiter)
            self._grant()
        try:
            while not waiter.granted.wait(CANCEL_POLL_SECONDS):
                check_canceled()
            check_canceled()  # since the last look, or by the one who gave the permit back
            yield
        finally:
            with self._lock:
                if waiter.granted.is_set():
                    self._permits += waiter.weight
                else:
                    self._waiting.remove(waiter)
                self._grant()

    def _grant(self) -> None:
        passed_until = time.monotonic() - PASSED_SECONDS
        for waiter in tuple(self._waiting) if self._permits else ():
            if waiter.weight <= self._permits:
                self._permits -= waiter.weight
                self._waiting.remove(waiter)
                waiter.granted.set()
            elif waiter.since < passed_until:
                return


class BackgroundThread(ABC):
    """A daemon thread that works from `start` to `stop`, and can be started again."""

    def __init__(self, name: str, join_seconds: float | None = None) -> None:
        """`join_seconds`: longest that `stop` waits; by default as long as it takes."""
        self._name, self._join_seconds = name, join_seconds
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()

    def start(self) -> None:
        """Starts the thread."""
        self._stop.clear()
        self._thread = threading.Thread(target=self.run, name=self._name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(self._join_seconds)
            self._thread = None

    @abstractmethod
    def run(self) -> None:
        """Works until `_stop` is set."""


OOM_SCORE = "500"  # the system ends such a process before the one that holds the jobs


class Spawned(NamedTuple):
    """A process that waits for its first message, and the pipe to it."""

    process: subprocess.Popen[bytes]
    pipe: Connection[Any, Any]


_ahead: dict[str, Spawned] = {}


def spawn(module: str) -> Spawned:
    """Starts `python -m MODULE FD`, where FD is its end of the pipe; or returns what `spawn_ahead` started."""
    if module in _ahead:
        return _ahead.pop(module)
    ours, theirs = Pipe()
    with theirs:
        command = [sys.executable, "-m", module, str(theirs.fileno())]
        return Spawned(subprocess.Popen(command, pass_fds=[theirs.fileno()]), ours)


def spawn_ahead(module: str) -> None:
    """Starts a process for the first caller of `spawn`, so that both processes import at the same time."""
    _ahead[module] = spawn(module)


def leave_decisions_to_the_parent() -> None:
    """Called by such a process at its start."""
    # A terminal's Ctrl-C and a service manager's stop reach every process: the one that holds the jobs decides.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    with suppress(OSError):  # elsewhere than on Linux
        Path("/proc/self/oom_score_adj").write_text(OOM_SCORE)
