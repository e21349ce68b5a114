"""What `cow top` shows: the processes on a server's job database, once a second."""

import time
from collections.abc import Iterable
from datetime import datetime

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from cow_service.cli.options import open_client, printable
from cow_service.errors import CowError
from cow_service.records import WorkerInfo, Workers

REFRESH_SECONDS = 1.0
TIMEOUT_SECONDS = 5.0  # that the server may say nothing
BAR_WIDTH = 8  # characters
ROLES = {"all": "server", "api": "API server", "worker": "worker"}
ID_LENGTH = 8  # characters that are shown of a job's id


def show_processes(url: str | None, *, once: bool) -> None:
    """Shows a new picture each second, or one; one that cannot be had leaves the last one, and says why."""
    console = Console()
    with open_client(url, timeout=TIMEOUT_SECONDS, retries=0) as client:
        shown = picture(client.workers(), client.base_url)
        if once or not console.is_terminal:
            console.print(shown)
            return
        updated = time.monotonic()
        try:
            with Live(shown, console=console, screen=True, auto_refresh=False) as live:
                while True:
                    time.sleep(REFRESH_SECONDS)
                    try:
                        shown, updated = picture(client.workers(), client.base_url), time.monotonic()
                        live.update(shown, refresh=True)
                    except CowError as error:
                        live.update(with_fault(shown, error.detail, time.monotonic() - updated), refresh=True)
        except KeyboardInterrupt:
            pass


def picture(found: Workers, url: str) -> RenderableType:
    """Everything that a server reports, and what needs somebody."""
    workers = [worker for process in found.processes for worker in process.workers]
    counts = (
        _number(len(found.processes), "process", "processes"),
        f"{_number(len(workers), 'worker')} ({sum(bool(worker.jobs) for worker in workers)} busy)",
        f"{sum(queue.queued for queue in found.queues)} queued",
        datetime.now().astimezone().strftime("%H:%M:%S"),
    )
    parts: list[RenderableType] = [
        Text(printable(url), style="bold").append("  " + ", ".join(counts), style="not bold")
    ]
    for one in found.unserved:
        what = f"workflow version {one.workflow_version}" if one.reason == "version" else f"queue {one.queue}"
        jobs = f"{_number(one.jobs, 'job')} of {printable(what)}"
        parts.append(Text(f"{jobs}: no process takes them (see `cow doctor`)", style="red"))
    queues = _table("queue", right=("queued", "running", "capacity", "oldest", "jobs/min"))
    for queue in found.queues:
        idle = not queue.queued and not queue.running
        queues.add_row(
            Text(printable(queue.name)),
            *(str(number) for number in (queue.queued, queue.running, queue.capacity)),
            "-" if queue.oldest_seconds is None else _duration(queue.oldest_seconds),
            f"{queue.jobs_per_minute:.1f}",
            style="dim" if idle else "red" if not queue.capacity else "",
        )
    parts += [Text(), queues, Text()]
    for process in found.processes:
        takes = ", ".join(map(printable, process.queues)) or "nothing"
        place = "" if process.host is None else f" on {printable(process.host)}"
        pid = "" if process.pid is None else f"pid {process.pid}, "
        head = Text(f"{ROLES[process.role]}{place}", style="bold")
        head.append(f"  {pid}COW {printable(process.version)}, takes {takes}", style="not bold dim")
        parts += [head, _workers(process.workers)] if process.workers else [head]
    return Group(*parts)


def with_fault(shown: RenderableType, fault: str, age: float) -> RenderableType:
    """The last picture, `age` seconds old, and why there is no newer one."""
    return Group(Text(printable(fault), style="red"), Text(f"As it was {_duration(age)} ago:", style="yellow"), shown)


def _workers(workers: Iterable[WorkerInfo]) -> Table:
    table = _table("  worker", right=("pid", "memory", "done"), gap=1)
    for name in ("job", "stage"):
        table.add_column(name, no_wrap=True)
    table.add_column("progress", width=BAR_WIDTH + 5, no_wrap=True)
    table.add_column("time", justify="right", no_wrap=True)
    for worker in workers:
        pid = "-" if worker.pid is None else str(worker.pid)
        left = Text(f"  {printable(worker.name)}"), pid, f"{worker.memory_mb:.0f} MB", str(worker.jobs_done)
        rows: list[tuple[Text, Text, RenderableType, str]] = []
        for job in worker.jobs:
            named = f"{job.kind} {printable(job.id)[:ID_LENGTH]}" if job.id else job.kind
            bar = Table.grid(padding=(0, 1))
            bar.add_row(ProgressBar(total=1.0, completed=job.progress, width=BAR_WIDTH), f"{job.progress:4.0%}")
            rows.append((Text(named), Text(printable(job.stage or "-")), bar, _duration(job.seconds)))
        rows = rows or [(Text("idle", style="dim"), Text(), Text(), "")]
        for number, row in enumerate(rows):
            table.add_row(*(left if number == 0 else ("", "", "", "")), *row)
        for gpu in worker.gpus:
            table.add_row(
                Text(f"    {printable(gpu.device)}", style="dim"),
                "",
                f"{gpu.reserved_mb / 1e3:.1f}/{gpu.total_mb / 1e3:.0f} GB",
            )
    return table


def _table(first: str, right: Iterable[str], gap: int = 2) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, gap, 0, 0))
    table.add_column(first, no_wrap=True)
    for name in right:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _number(number: int, one: str, several: str | None = None) -> str:
    return f"{number} {one if number == 1 else several or one + 's'}"


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
