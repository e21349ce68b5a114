"""The command `cow-scenes`: make, check, pack, eye. Code 2 and one line for bad arguments, 1 for what failed."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TextColumn, TimeRemainingColumn
from rich.text import Text

from .check import check_set
from .errors import CheckError, ScenesError, UsageError
from .eye.commands import app as eye
from .make import make_set, missing
from .pack import pack_set
from .plan import FAMILIES, LEVELS, TASKS
from .pool import Failed
from .settings import Settings

app = typer.Typer(add_completion=False, no_args_is_help=True, help=__doc__, pretty_exceptions_enable=False)
app.add_typer(eye, name="eye")
DEFAULT = Settings()
ArgumentError: Any = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")
"""The base of typer's argument errors; where its module is differs between versions of typer."""


class Rate(ProgressColumn):
    """Seconds per item so far."""

    def render(self, task: Task) -> Text:
        """The rate, or a dash before the first item is done."""
        return Text(f"{1 / task.speed:.1f} s/item" if task.speed else "- s/item")


def chosen(values: list[str], known: tuple[str, ...], option: str) -> tuple[str, ...]:
    """The named values in their known order; `all` or none means every one."""
    for value in values:
        if value not in (*known, "all"):
            raise UsageError(f"{option} {value!r} is not known; choose from {', '.join(known)}, all")
    return known if not values or "all" in values else tuple(k for k in known if k in values)


@app.command()
def make(
    out: Annotated[Path, typer.Option(help="Folder of the set; run again to go on with it.")],
    count: Annotated[int, typer.Option(help="Items in all, spread over tasks and levels.")] = DEFAULT.count,
    seed: Annotated[int, typer.Option(help="Same seed and arguments, same bytes.")] = DEFAULT.seed,
    family: Annotated[str, typer.Option(help=f"{' or '.join(FAMILIES)}: Bullet and Blender, or MuJoCo.")] = "first",
    task: Annotated[list[str] | None, typer.Option(help=f"{', '.join(TASKS)} or all.")] = None,
    level: Annotated[list[str] | None, typer.Option(help="L1 or L2; both if not given.")] = None,
    width: Annotated[int, typer.Option(help="Pixels; of `other` a scale of its sizes, 832 is 1.")] = DEFAULT.width,
    height: Annotated[int, typer.Option(help="Pixels.")] = DEFAULT.height,
    samples: Annotated[int, typer.Option(help="Cycles samples per pixel.")] = DEFAULT.samples,
    quality: Annotated[int, typer.Option(help="JPEG quality.")] = DEFAULT.quality,
    processes: Annotated[int, typer.Option(help="Processes that make items.")] = 1,
    shard_rows: Annotated[int, typer.Option(help="Rows per parquet file.")] = DEFAULT.shard_rows,
) -> None:
    """Make a set of items, or go on with one that was cut off."""
    tasks, levels = chosen(task or [], TASKS, "--task"), chosen(level or [], LEVELS, "--level")
    settings = Settings(seed, count, tasks, levels, width, height, samples, quality, shard_rows, family)
    events = make_set(out, settings, processes)
    total = len(settings.plan())
    columns = (TextColumn("items"), BarColumn(), MofNCompleteColumn(), Rate(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("items", total=total, completed=total - len(missing(out, settings)))
        for event in events:
            if isinstance(event, Failed):
                progress.console.print(f"{event.key.id}: {event.reason}", markup=False)
            progress.advance(bar)
    print(f"{total} items in {out}")


@app.command()
def check(folder: Annotated[Path, typer.Argument(help="A made set.")]) -> None:
    """Verify a made set: files, pictures, answers against the truth, balance."""
    report = check_set(folder)
    for (subset, level, answer), count in sorted(report.answers.items()):
        print(f"{subset:14} {level}  {answer:10} {count}")
    for problem in report.problems:
        print(problem, file=sys.stderr)
    if report.problems:
        raise CheckError(f"{len(report.problems)} problems in {len(report.ids)} items of {folder}")
    print(f"{len(report.ids)} items, no problem")


@app.command()
def pack(
    folder: Annotated[Path, typer.Argument(help="A made set.")],
    file: Annotated[Path, typer.Argument(help="Release file: NAME.tar.zst or NAME.zip.")],
    limit_mb: Annotated[float, typer.Option(help="Refuse a larger file (MB of 1,000,000 bytes).")] = 20.0,
) -> None:
    """Pack a made set into one release file."""
    print(f"{file}: {pack_set(folder, file, limit_mb) / 1e6:.2f} MB")


def main() -> None:
    """Run the command; errors end in one line."""
    try:
        code = app(standalone_mode=False)
    except (typer.Abort, KeyboardInterrupt):
        print("stopped; the same command goes on", file=sys.stderr)
        sys.exit(130)
    except ScenesError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, UsageError) else 1)
    except ArgumentError as error:
        print(f"error: {error.format_message()}", file=sys.stderr)
        sys.exit(2)
    sys.exit(code if isinstance(code, int) else 0)
