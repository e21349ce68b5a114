"""Progress of a batch: a bar with rate and time left on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field

LINE_EVERY = 30.0  # seconds, where there is no terminal


@dataclass
class Tally:
    """How many questions are done, of how many, where that is known."""

    total: int | None
    succeeded: int = 0
    failed: int = 0
    before: int = 0  # of those, found in the folder
    note: str = ""  # what keeps it from going on, where something does
    began: float = field(default_factory=time.monotonic)

    @property
    def done(self) -> int:
        """All that have an outcome."""
        return self.succeeded + self.failed

    def count(self, succeeded: bool, *, before: bool = False) -> None:
        """One more is done."""
        self.succeeded += succeeded
        self.failed += not succeeded
        self.before += before

    @property
    def rate(self) -> float:
        """Questions done per second since the start."""
        return (self.done - self.before) / max(time.monotonic() - self.began, 1e-6)

    @property
    def left(self) -> float | None:
        """Seconds left at this rate; None where nothing tells."""
        if self.total is None or not self.rate:
            return None
        return (self.total - self.done) / self.rate

    def __str__(self) -> str:
        of = "" if self.total is None else f"/{self.total}"
        left = "" if self.left is None else f", {duration(self.left)} left"
        return f"{self.done}{of} done, {self.failed} failed, {pace(self.rate)}{left}{self.note and '; '}{self.note}"


def pace(rate: float) -> str:
    """A rate in words: per second where that is at least one, else per minute."""
    return f"{rate:.1f}/s" if rate >= 1 else f"{rate * 60:.1f}/min"


def duration(seconds: float) -> str:
    """A time in words: 45 s, 3:20 min, 2:05 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


@contextmanager
def shown(tally: Tally, progress: bool) -> Generator[Callable[[], None]]:
    """Whom to tell that the tally has changed."""
    if not progress:
        yield lambda: None
    elif sys.stderr.isatty():
        with _bar(tally) as tell:
            yield tell
    else:
        last, noted = [time.monotonic()], [tally.note]

        def tell_now_and_then() -> None:
            if time.monotonic() - last[0] >= LINE_EVERY or tally.note != noted[0]:
                last[0], noted[0] = time.monotonic(), tally.note
                print(tally, file=sys.stderr, flush=True)

        yield tell_now_and_then


@contextmanager
def _bar(tally: Tally) -> Generator[Callable[[], None]]:
    from rich.console import Console  # noqa: PLC0415
    from rich.progress import BarColumn, Progress, TextColumn  # noqa: PLC0415

    columns = (BarColumn(bar_width=30), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(str(tally), total=tally.total)

        def tell() -> None:
            bar.update(task, completed=tally.done, description=str(tally))

        tell()
        yield tell
