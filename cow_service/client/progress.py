"""Progress of a job and of a batch, on the terminal or in a notebook: with rich, tqdm, or a function of one's own."""

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Literal, TypeAlias

from cow_service.records import Job

# True takes rich where it is installed, else tqdm.
ProgressLike: TypeAlias = bool | Literal["rich", "tqdm"] | Callable[[Job], None]


@contextmanager
def reporting(progress: ProgressLike) -> Generator[Callable[[Job], None] | None]:
    """Shows the progress of a job; yields the function to call with its state, None for none.

    Raises `ImportError` where the bar is not installed, and `ValueError` for an unknown one.
    """
    if progress is False:
        yield None
    elif callable(progress):
        yield progress
    elif progress is not True and progress not in ("rich", "tqdm"):
        raise ValueError(f"progress must be True, False, 'rich', 'tqdm' or a function, got {progress!r}")
    else:
        is_rich = progress == "rich" or (progress is True and find_spec("rich") is not None)
        with _rich() if is_rich else _tqdm() as report:
            yield report


@contextmanager
def _rich() -> Generator[Callable[[Job], None]]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn  # noqa: PLC0415

    stage, percentage = TextColumn("{task.description:<10}"), TextColumn("{task.percentage:>3.0f}%")
    with Progress(stage, BarColumn(), percentage, TimeElapsedColumn()) as bar:
        task = bar.add_task("queued", total=1.0)
        yield lambda job: bar.update(task, description=describe(job), completed=job.progress)


@contextmanager
def _tqdm() -> Generator[Callable[[Job], None]]:
    from tqdm.auto import tqdm  # noqa: PLC0415

    with tqdm(total=1.0, bar_format="{desc:<10} {percentage:3.0f}%|{bar}| {elapsed}") as bar:

        def report(job: Job) -> None:
            bar.set_description_str(describe(job), refresh=False)
            bar.n = job.progress  # added up by tqdm, rounding could exceed 1, of which it warns
            bar.refresh()

        yield report


def describe(job: Job) -> str:
    """The stage of a running job, else its status."""
    return job.stage if job.status == "running" and job.stage else job.status


LINE_SECONDS = 30.0  # between two lines, where there is no terminal


@dataclass
class BatchProgress:
    """How many questions are done, of how many, where that is known."""

    total: int | None
    succeeded: int = 0
    failed: int = 0
    earlier: int = 0  # of those, found in the folder
    note: str = ""  # what the batch waits for, where it waits
    began: float = field(default_factory=time.monotonic)

    @property
    def done(self) -> int:
        """All that have an outcome."""
        return self.succeeded + self.failed

    def count(self, succeeded: bool, *, earlier: bool = False) -> None:
        """One more is done."""
        self.succeeded += succeeded
        self.failed += not succeeded
        self.earlier += earlier

    @property
    def rate(self) -> float:
        """Questions done per second since the start."""
        return (self.done - self.earlier) / max(time.monotonic() - self.began, 1e-6)

    @property
    def left(self) -> float | None:
        """Seconds left at this rate; None where that is not known."""
        if self.total is None or not self.rate:
            return None
        return (self.total - self.done) / self.rate

    def __str__(self) -> str:
        of = "" if self.total is None else f"/{self.total}"
        left = "" if self.left is None else f", {duration(self.left)} left"
        return (
            f"{self.done}{of} done, {self.failed} failed, {rate_words(self.rate)}{left}{self.note and '; '}{self.note}"
        )


def rate_words(rate: float) -> str:
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
def progress_shown(state: BatchProgress, progress: bool) -> Generator[Callable[[], None]]:
    """A bar or lines on standard error; yields the function to call when the state has changed."""
    if not progress:
        yield lambda: None
    elif sys.stderr.isatty():
        from rich.console import Console  # noqa: PLC0415
        from rich.progress import BarColumn, Progress, TextColumn  # noqa: PLC0415

        columns = (BarColumn(bar_width=30), TextColumn("{task.description}"))
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(str(state), total=state.total)
            yield lambda: bar.update(task, completed=state.done, description=str(state))
    else:
        printed, note = time.monotonic(), state.note

        def print_now_and_then() -> None:
            nonlocal printed, note
            if time.monotonic() - printed >= LINE_SECONDS or state.note != note:
                printed, note = time.monotonic(), state.note
                print(state, file=sys.stderr, flush=True)

        yield print_now_and_then
