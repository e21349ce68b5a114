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
def told(progress: ProgressLike) -> Generator[Callable[[Job], None] | None]:
    """Whom to tell of a job as it goes on; None for nobody.

    Raises `ImportError` where the bar is not installed, and `ValueError` for one that nobody knows.
    """
    if progress is False:
        yield None
    elif callable(progress):
        yield progress
    elif progress is not True and progress not in ("rich", "tqdm"):
        raise ValueError(f"progress must be True, False, 'rich', 'tqdm' or a function, got {progress!r}")
    else:
        with _bar(progress) as tell:
            yield tell


@contextmanager
def _bar(kind: Literal[True, "rich", "tqdm"]) -> Generator[Callable[[Job], None]]:
    if kind is not True:
        with _rich() if kind == "rich" else _tqdm() as tell:
            yield tell
        return
    with _bar("rich" if find_spec("rich") else "tqdm") as tell:
        yield tell


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

        def tell(job: Job) -> None:
            bar.set_description_str(describe(job), refresh=False)
            bar.n = job.progress  # what is added up is not the same to the last digit, and tqdm warns of too much
            bar.refresh()

        yield tell


def describe(job: Job) -> str:
    """What a job is at, in a word."""
    return job.stage if job.status == "running" and job.stage else job.status
