"""What every task of an evaluation shares: the server that it asks, where its pictures are kept, and its progress."""

import asyncio
import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from datetime import timedelta
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from cow_service.client import AsyncClient
from cow_service.evals.imagination import Imagination
from cow_service.evals.items import Item, Observation, Pictures
from cow_service.evals.runs import PICTURES, SERVER
from cow_service.observability import logging
from cow_service.service import Service
from cow_service.settings import load_settings

LOG = "server.log"
LINES_EVERY = 15.0  # seconds, where nothing can be redrawn
REDRAWN = 4  # times a second
TIMEOUT = 600.0  # seconds that a server may say nothing: an MLLM of its own may think for long


@dataclass
class Session:
    """A server and a folder of pictures. Clients are made for the event loop that first asks for one."""

    url: str
    pictures: Pictures
    key: str  # of the run and its round: names its requests
    reply_key: str  # of the run: names its replies
    options: Mapping[str, Any]  # fields of the requests for simulations and answers
    items: Sequence[Item] | None = None  # of its tasks; None: each task loads its own
    progress: "Progress | None" = None
    _clients: dict[int, tuple[AsyncClient, Imagination]] = field(default_factory=dict)

    def count(self, arm: str, seen: Observation | None) -> None:
        """Counts a question that has just been asked, where progress is shown; None: it failed."""
        if self.progress is not None:
            self.progress.add(arm, seen)

    def clients(self) -> tuple[AsyncClient, Imagination]:
        """For the running event loop; all arms share its simulations."""
        loop = id(asyncio.get_running_loop())
        if loop not in self._clients:
            client = AsyncClient(self.url, timeout=TIMEOUT)
            self._clients[loop] = client, Imagination(client, self.pictures, self.options, self.key)
        return self._clients[loop]


_active: list[Session] = []


@contextmanager
def session(
    folder: Path, url: str | None, options: Mapping[str, Any], key: str, reply_key: str, **settings: Any
) -> Generator[Session]:
    """The session of all tasks that run meanwhile. Without an address, a server runs in this process meanwhile.

    Raises the `CowError` for which that server cannot be started.
    """
    with nullcontext(url) if url is not None else _server(folder, settings) as address:
        _active.append(Session(address, Pictures(folder / PICTURES), key, reply_key, options))
        try:
            yield _active[-1]
        finally:
            _active.pop()


def active_session() -> Session | None:
    """The session in which tasks run; None where they were started by Inspect's own command."""
    return _active[-1] if _active else None


@contextmanager
def _server(folder: Path, settings: Mapping[str, Any]) -> Generator[str]:
    from cow_service.server import serving  # noqa: PLC0415 - where a server is named, none is imported
    from cow_service.workers.pool import WorkerPool  # noqa: PLC0415

    known = load_settings(data_dir=folder / SERVER, host="127.0.0.1", port=0, **settings)
    (folder / SERVER).mkdir(parents=True, exist_ok=True)
    with (folder / SERVER / LOG).open("a", encoding="utf-8") as log, ExitStack() as stack:
        logging.set_up(known, out=log, err=log)
        stack.callback(logging.set_up, known)
        service = Service(known)
        pool = WorkerPool(known, service.metrics) if known.workers else None
        if pool is not None:
            stack.callback(pool.close)
            pool.start()  # it computes in processes of its own: replies are read, and kept, as they come
        yield stack.enter_context(serving(service, pool))


@dataclass
class ArmCount:
    """How far one arm is."""

    total: int
    done: int = 0
    right: int = 0
    failed: int = 0

    @property
    def share_right(self) -> str:
        """Of those with a reply; empty where there are none."""
        answered = self.done - self.failed
        return f"{self.right / answered:.1%}" if answered else ""


class Progress:
    """Rate, time left and accuracy so far of every arm, on standard error.

    What was done before the process began counts as done, and not for the rate.
    """

    def __init__(self, arms: Iterable[str], questions: int) -> None:
        self._counts = {arm: ArmCount(questions) for arm in arms}
        self._begun = self._told_at = time.monotonic()
        self._done_here = 0
        self._console = Console(stderr=True)

    def add(self, arm: str, seen: Observation | None) -> None:
        """Counts a question that has just been asked; None: it failed."""
        self._done_here += 1
        self._count(arm, seen)
        if not self._console.is_terminal and time.monotonic() - self._told_at > LINES_EVERY:
            self._told_at = time.monotonic()
            self._print_line()

    def add_earlier(self, observations: Iterable[Observation]) -> None:
        """Counts what an earlier process has asked."""
        for each in observations:
            self._count(each.arm, each if each.failure is None else None)

    @property
    def left(self) -> int:
        """Questions that have not been asked."""
        return sum(count.total - count.done for count in self._counts.values())

    @contextmanager
    def shown(self) -> Generator[None]:
        """Shows the progress meanwhile: redrawn in a terminal, else a line now and then."""

        def table() -> Table:
            found = Table(box=None, pad_edge=False, show_footer=True)
            done, total = (sum(getattr(count, name) for count in self._counts.values()) for name in ("done", "total"))
            footers = ("", f"{done} of {total}", *self._pace())
            for name, footer in zip(("arm", "asked", "right", "failed"), footers, strict=True):
                found.add_column(name, footer=footer, justify="left" if name == "arm" else "right")
            for arm, count in self._counts.items():
                found.add_row(arm, f"{count.done} of {count.total}", count.share_right, str(count.failed or ""))
            return found

        if self._console.is_terminal:
            with Live(get_renderable=table, console=self._console, refresh_per_second=REDRAWN):
                yield
        else:
            yield
            self._print_line()

    def _count(self, arm: str, seen: Observation | None) -> None:
        if count := self._counts.get(arm):
            count.done += 1
            count.failed += seen is None
            count.right += seen is not None and seen.right

    def _pace(self) -> tuple[str, str]:
        """Questions per second since the process began, and the time left at this rate."""
        rate = self._done_here / max(time.monotonic() - self._begun, 1e-9)
        left = str(timedelta(seconds=round(self.left / rate))) if rate else "?"
        return f"{rate:.1f}/s", f"{left} left"

    def _print_line(self) -> None:
        parts: list[str] = []
        for arm, count in self._counts.items():
            right = f" {count.share_right} right" if count.share_right else ""
            failed = f", {count.failed} failed" if count.failed else ""
            parts.append(f"{arm} {count.done}/{count.total}{right}{failed}")
        text = f"{'; '.join(parts)}; {', '.join(self._pace())}"
        self._console.print(text, soft_wrap=True, highlight=False)
