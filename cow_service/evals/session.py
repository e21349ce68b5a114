"""What every task of an evaluation shares: the server that it asks, where its pictures are kept, and its progress."""

import asyncio
import time
from collections import Counter
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
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


class Progress:
    """Rate, time left and accuracy so far of every arm, on standard error.

    What an earlier process has asked counts as done, and not for the rate.
    """

    def __init__(self, arms: Iterable[str], questions: int, earlier: Iterable[Observation]) -> None:
        self._questions = questions  # of each arm
        self._counts = {arm: Counter[str]() for arm in arms}  # done, of those right and failed
        for each in earlier:
            self._count(each.arm, each if each.failure is None else None)
        self._begun = self._told_at = time.monotonic()
        self._left_before = self.left
        self._console = Console(stderr=True)

    def add(self, arm: str, seen: Observation | None) -> None:
        """Counts a question that has just been asked; None: it failed."""
        self._count(arm, seen)
        if not self._console.is_terminal and time.monotonic() - self._told_at > LINES_EVERY:
            self._told_at = time.monotonic()
            self._print_line()

    @property
    def left(self) -> int:
        """Questions that have not been asked."""
        return sum(self._questions - count["done"] for count in self._counts.values())

    @contextmanager
    def shown(self) -> Generator[None]:
        """Shows the progress meanwhile: redrawn in a terminal, else a line now and then."""
        if self._console.is_terminal:
            with Live(get_renderable=self._table, console=self._console, refresh_per_second=REDRAWN):
                yield
        else:
            yield
            self._print_line()

    def _count(self, arm: str, seen: Observation | None) -> None:
        if arm in self._counts:
            self._counts[arm].update(done=1, failed=int(seen is None), right=int(seen is not None and seen.right))

    def _rows(self) -> Iterator[tuple[str, str, str, str]]:
        """Each arm with what was asked, right and failed; last the rate since the process began, and the time left."""
        for arm, count in self._counts.items():
            answered = count["done"] - count["failed"]
            right = f"{count['right'] / answered:.1%}" if answered else ""
            yield arm, f"{count['done']} of {self._questions}", right, str(count["failed"] or "")
        total = self._questions * len(self._counts)
        rate = (self._left_before - self.left) / max(time.monotonic() - self._begun, 1e-9)
        left = str(timedelta(seconds=round(self.left / rate))) if rate else "?"
        yield "", f"{total - self.left} of {total}", f"{rate:.1f}/s", f"{left} left"

    def _table(self) -> Table:
        *arms, footers = self._rows()
        found = Table(box=None, pad_edge=False, show_footer=True)
        for name, footer in zip(("arm", "asked", "right", "failed"), footers, strict=True):
            found.add_column(name, footer=footer, justify="left" if name == "arm" else "right")
        for row in arms:
            found.add_row(*row)
        return found

    def _print_line(self) -> None:
        *arms, (_, _, *pace) = self._rows()
        told = [
            f"{arm} {asked}" + (f", {right} right" if right else "") + (f", {failed} failed" if failed else "")
            for arm, asked, right, failed in arms
        ]
        self._console.print(f"{'; '.join(told)}; {', '.join(pace)}", soft_wrap=True, highlight=False)
