"""Progress of one job on the terminal or in a notebook: with rich, with tqdm, or by a function of one's own."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
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
        with _bar(progress) as report:
            yield report


@contextmanager
def _bar(kind: Literal[True, "rich", "tqdm"]) -> Generator[Callable[[Job], None]]:
    if kind is not True:
        with _rich() if kind == "rich" else _tqdm() as report:
            yield report
        return
    with _bar("rich" if find_spec("rich") else "tqdm") as report:
        yield report


@contextmanager
def _rich() -> Generator[Callable[[Job], None]]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn  # noqa: PLC0415

    with Progress(TextColumn("{task.description:<10}"), BarColumn(), TextColumn("{task.percentage:>3.0f}%"),
                  TimeElapsedColumn()) as bar:  # fmt: skip
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
