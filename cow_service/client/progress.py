"""Progress of a job and of a batch, on the terminal or in a notebook: as a bar, or passed to your own function."""

import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import timedelta
from typing import TypeAlias

from cow_service.records import Job, Workers

ProgressLike: TypeAlias = bool | Callable[[Job], None]


@contextmanager
def reporting(progress: ProgressLike) -> Generator[Callable[[Job], None] | None]:
    """Shows the progress of a job; yields the function to call with its state, None for none.

    Raises `ValueError` for what is neither a bool nor a function.
    """
    if progress is False:
        yield None
    elif callable(progress):
        yield progress
    elif progress is not True:
        raise ValueError(f"progress must be True, False or a function, got {progress!r}")
    else:
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn  # noqa: PLC0415

        stage, percentage = TextColumn("{task.description:<10}"), TextColumn("{task.percentage:>3.0f}%")
        with Progress(stage, BarColumn(), percentage, TimeElapsedColumn()) as bar:
            task = bar.add_task("queued", total=1.0)
            yield lambda job: bar.update(task, description=describe(job), completed=job.progress)


def describe(job: Job) -> str:
    """The stage of a running job, else its status."""
    return job.stage if job.status == "running" and job.stage else job.status


LINE_SECONDS = 30.0  # between two lines, where there is no terminal
LOOK_SECONDS = 10.0  # between two looks at what the server's jobs wait for


def describe_load(workers: Workers) -> str:
    """What most of the server's jobs wait for; empty if nothing waits or the server does not say."""
    loads = [one.load for process in workers.processes for one in process.workers if one.load is not None]
    cpu, calls = sum(one.cpu_waiting for one in loads), sum(one.mllm_calls for one in loads)
    at_mllm, queued = calls + sum(one.mllm_waiting for one in loads), sum(queue.queued for queue in workers.queues)
    if at_mllm and at_mllm >= cpu:
        limit = sum(one.mllm_limit for one in loads)
        return f"limited by the server's MLLM: {at_mllm} calls wait for it, of {limit} at once"
    if cpu:
        return f"limited by the server's CPU: {cpu} jobs wait for it"
    return f"limited by the server: {queued} jobs are queued" if queued else ""


@dataclass
class BatchProgress:
    """How many questions are done, of how many, where that is known."""

    total: int | None
    succeeded: int = 0
    failed: int = 0
    earlier: int = 0  # of those, found in the folder
    note: str = ""  # what the batch waits for, where it waits
    load: str = ""  # what the server's jobs wait for, where it says so
    looked_at: float = field(default_factory=time.monotonic)  # the server's load
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

    def is_look_due(self) -> bool:
        """Whether to ask the server for its load; not again for a while."""
        due = time.monotonic() - self.looked_at >= LOOK_SECONDS
        if due:
            self.looked_at = time.monotonic()
        return due

    def __str__(self) -> str:
        of = "" if self.total is None else f"/{self.total}"
        rate = (self.done - self.earlier) / max(time.monotonic() - self.began, 1e-6)
        left = ""
        if self.total is not None and rate:
            left = f", {timedelta(seconds=round((self.total - self.done) / rate))} left"
        note = f"; {self.note or self.load}" if self.note or self.load else ""
        return f"{self.done}{of} done, {self.failed} failed, {rate * 60:.3g}/min{left}{note}"


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
