"""How fast the jobs of a queue end."""

from __future__ import annotations

import time
from collections import deque

WINDOW_SECONDS = 300.0  # in which ends count
MAX_ENDS = 1000  # that are kept
MIN_ENDS = 2  # from which on there is a pace


class Pace:
    """Ends of the last minutes. Not thread-safe."""

    def __init__(self) -> None:
        self._ends: deque[float] = deque(maxlen=MAX_ENDS)

    def note(self) -> None:
        """A job has ended now."""
        self._ends.append(time.monotonic())

    def jobs_per_second(self) -> float | None:
        """From the first end in the window until now; None where there were too few."""
        now = time.monotonic()
        while self._ends and now - self._ends[0] > WINDOW_SECONDS:
            self._ends.popleft()
        if len(self._ends) < MIN_ENDS or now <= self._ends[0]:
            return None
        return len(self._ends) / (now - self._ends[0])
