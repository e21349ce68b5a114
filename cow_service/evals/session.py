"""What every task of an evaluation shares: the server that it asks, and where its pictures are kept."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table

from cow_service.client import AsyncClient
from cow_service.evals.imagination import Imagination
from cow_service.evals.items import Observation, Pictures
from cow_service.evals.runs import PICTURES, SERVER
from cow_service.observability import logging
from cow_service.service import Service
from cow_service.settings import load_settings

LOG = "server.log"
TIMEOUT = 600.0  # seconds that a server may say nothing: an MLLM of its own may think for long


@dataclass
class Session:
    """A server and a folder of pictures. Clients are made for the event loop that first asks for one."""

    url: str
    pictures: Pictures
    key: str  # of the run and its round: names its requests
    reply_key: str  # of the run: names its replies
    options: Mapping[str, Any]  # fields of the requests for simulations and answers
    _clients: dict[int, tuple[AsyncClient, Imagination]] = field(default_factory=dict)

    def client(self) -> AsyncClient:
        """For the running event loop."""
        return self._of_loop()[0]

    def imagination(self) -> Imagination:
        """For the running event loop; all arms share its simulations."""
        return self._of_loop()[1]

    def _of_loop(self) -> tuple[AsyncClient, Imagination]:
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
    with _server(folder, url, settings) as address:
        _active.append(Session(address, Pictures(folder / PICTURES), key, reply_key, options))
        try:
            yield _active[-1]
        finally:
            _active.pop()


def active_session() -> Session | None:
    """The session in which tasks run; None where they were started by Inspect's own command."""
    return _active[-1] if _active else None


@contextmanager
def _server(folder: Path, url: str | None, settings: Mapping[str, Any]) -> Generator[str]:
    if url is not None:
        yield url
        return
    from cow_service.server import serving  # noqa: PLC0415 - where a server is named, none is imported
    from cow_service.workers.pool import WorkerPool  # noqa: PLC0415

    known = load_settings(data_dir=folder / SERVER, host="127.0.0.1", port=0, **settings)
    (folder / SERVER).mkdir(parents=True, exist_ok=True)
    with (folder / SERVER / LOG).open("a", encoding="utf-8") as log:
        logging.set_up(known, out=log, err=log)
        service = Service(known)
        pool = WorkerPool(known, service.metrics) if known.workers else None
        try:
            if pool is not None:
                pool.start()  # it computes in processes of its own: replies are read, and kept, as they come
            with serving(service, pool) as address:
                yield address
        finally:
            if pool is not None:
                pool.close()
            logging.set_up(known)


def own_folder() -> Path:
    """A folder for pictures and a server of tasks that Inspect's own command runs; left to the system to clean."""
    return Path(tempfile.mkdtemp(prefix="cow-eval-"))


LINES_EVERY = 15.0  # seconds, where nothing can be redrawn
REDRAWN = 4  # times a second


@dataclass
class Count:
    """Of one arm."""

    total: int
    done: int = 0
    right: int = 0
    failed: int = 0


@dataclass
class Progress:
    """Counts of all arms. What was done before the process began counts as done, and not for the rate."""

    counts: dict[str, Count]
    begun: float = field(default_factory=time.monotonic)
    done_here: int = 0

    def add(self, arm: str, seen: Observation | None) -> None:
        """Counts a question that has just been asked; None: it failed."""
        self.done_here += 1
        self._count(arm, seen)

    def add_earlier(self, observations: Sequence[Observation]) -> None:
        """Counts what an earlier process has asked."""
        for each in observations:
            if each.arm in self.counts:
                self._count(each.arm, each if each.failure is None else None)

    def _count(self, arm: str, seen: Observation | None) -> None:
        count = self.counts[arm]
        count.done += 1
        count.failed += seen is None
        count.right += seen is not None and seen.right

    @property
    def rate(self) -> float:
        """Questions per second since the process began."""
        return self.done_here / max(time.monotonic() - self.begun, 1e-9)

    @property
    def seconds_left(self) -> float | None:
        """At this rate; None before the first question was answered."""
        return self.left / self.rate if self.done_here else None

    @property
    def left(self) -> int:
        """Questions that have not been asked."""
        return sum(count.total - count.done for count in self.counts.values())

    def table(self) -> Table:
        """A row per arm, and the rate and time left below."""
        table = Table(box=None, pad_edge=False, show_footer=True)
        done = sum(count.done for count in self.counts.values())
        total = sum(count.total for count in self.counts.values())
        footers = ("", f"{done} of {total}", f"{self.rate:.1f}/s", f"{_clock(self.seconds_left)} left")
        for name, footer in zip(("arm", "asked", "right", "failed"), footers, strict=True):
            table.add_column(name, footer=footer, justify="left" if name == "arm" else "right")
        for arm, count in self.counts.items():
            answered = count.done - count.failed
            share = f"{count.right / answered:.1%}" if answered else ""
            table.add_row(arm, f"{count.done} of {count.total}", share, str(count.failed or ""))
        return table

    def line(self) -> str:
        """The same in one line."""
        parts: list[str] = []
        for arm, count in self.counts.items():
            answered = count.done - count.failed
            share = f" {count.right / answered:.1%} right" if answered else ""
            failed = f", {count.failed} failed" if count.failed else ""
            parts.append(f"{arm} {count.done}/{count.total}{share}{failed}")
        return f"{'; '.join(parts)}; {self.rate:.1f}/s, {_clock(self.seconds_left)} left"


def _clock(seconds: float | None) -> str:
    if seconds is None:
        return "?"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class _Shown:
    """Where progress is shown just now."""

    progress: Progress | None = None
    live: Live | None = None
    console: Console | None = None
    last_line: float = 0.0

    def update(self, progress: Progress) -> None:
        if self.live is not None:
            self.live.update(progress.table())
        elif self.console is not None and time.monotonic() - self.last_line > LINES_EVERY:
            self.last_line = time.monotonic()
            self.console.print(progress.line(), soft_wrap=True, highlight=False)


_shown = _Shown()


@contextmanager
def shown(progress: Progress) -> Generator[None]:
    """Shows progress meanwhile: redrawn in a terminal, else a line now and then."""
    _shown.console = Console(stderr=True)
    _shown.progress = progress
    _shown.last_line = time.monotonic()
    try:
        if _shown.console.is_terminal:
            with Live(progress.table(), console=_shown.console, refresh_per_second=REDRAWN) as _shown.live:
                yield
        else:
            yield
            _shown.console.print(progress.line(), soft_wrap=True, highlight=False)
    finally:
        _shown.progress = _shown.live = _shown.console = None


def count(arm: str, seen: Observation | None) -> None:
    """Counts a question that has just been asked, where progress is shown; None: it failed."""
    if _shown.progress is not None and arm in _shown.progress.counts:
        _shown.progress.add(arm, seen)
        _shown.update(_shown.progress)
