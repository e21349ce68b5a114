"""What every task of an evaluation shares: the server that it asks, and where its pictures are kept."""

import asyncio
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx

from cow_service.adaptive import AdaptiveLimit, AdaptivePlaces
from cow_service.client import CONCURRENCY, AsyncClient, protocol
from cow_service.evals.imagination import Imagination
from cow_service.evals.items import Item, Pictures
from cow_service.evals.runs import PICTURES, SERVER
from cow_service.observability import logging
from cow_service.service import Service
from cow_service.settings import load_settings

LOG, ARTIFACTS = "server.log", "artifacts"  # in the folder of the server in the process
TIMEOUT = 600.0  # seconds that a server may say nothing: an MLLM of its own may think for long
_active: list["Session"] = []


@dataclass
class Session:
    """A server and a folder of pictures. Clients are made for the event loop that first asks for one."""

    url: str
    pictures: Pictures
    key: str  # of the run and its round: names its requests
    reply_key: str  # of the run: names its replies
    options: Mapping[str, Any]  # fields of the requests for simulations and answers
    concurrency: int = CONCURRENCY  # most requests at the same time
    items: Sequence[Item] | None = None  # of its tasks; None: each task loads its own
    lenders: Sequence[Item] = ()  # items whose frames others may be shown
    _clients: dict[int, tuple[AsyncClient, Imagination]] = field(default_factory=dict)

    def clients(self) -> tuple[AsyncClient, Imagination]:
        """For the running event loop; all arms share its simulations."""
        loop = id(asyncio.get_running_loop())
        if loop not in self._clients:
            places = AdaptivePlaces(self.concurrency)
            client = AsyncClient(self.url, timeout=TIMEOUT, http_client=_observed(places.limit))
            imagination = Imagination(client, places, self.pictures, self.options, self.key, self.lenders)
            self._clients[loop] = client, imagination
        return self._clients[loop]


def _observed(limit: AdaptiveLimit) -> httpx.AsyncClient:
    """An HTTP client that reports every refusal to a limit, even those that `AsyncClient` retries."""

    async def note_begin(request: httpx.Request) -> None:
        request.extensions["begun"] = time.monotonic()

    async def note_refusal(response: httpx.Response) -> None:
        if not response.is_success:
            await response.aread()
            if protocol.is_refusal(response):
                limit.refuse(response.request.extensions["begun"], protocol.retry_after(response))

    hooks: dict[str, list[Any]] = {"request": [note_begin], "response": [note_refusal]}
    return httpx.AsyncClient(limits=httpx.Limits(max_connections=None), event_hooks=hooks)


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
    """The session in which tasks run; None if they were started by Inspect's own command."""
    return _active[-1] if _active else None


@contextmanager
def _server(folder: Path, settings: Mapping[str, Any]) -> Generator[str]:
    from cow_service.server import serving  # noqa: PLC0415 - where a server is named, none is imported
    from cow_service.workers.pool import WorkerPool  # noqa: PLC0415

    known = load_settings(data_dir=folder / SERVER, host="127.0.0.1", port=0, **settings)
    (folder / SERVER).mkdir(parents=True, exist_ok=True)
    with (folder / SERVER / LOG).open("a", encoding="utf-8") as log, ExitStack() as stack:
        stack.callback(_share_files, folder / PICTURES, folder / SERVER / ARTIFACTS)
        logging.set_up(known, out=log, err=log)
        stack.callback(logging.set_up, known)
        service = Service(known)
        pool = WorkerPool(known, service.metrics, service.artifacts) if known.workers else None
        if pool is not None:
            stack.callback(pool.close)
            pool.start()  # it computes in processes of its own: replies are read, and kept, as they come
        yield stack.enter_context(serving(service, pool))


def _share_files(pictures: Path, artifacts: Path) -> None:
    """Has files of the server be those of the run where they are the same: a picture takes its space once."""
    for path in pictures.rglob("*.*"):
        same = artifacts / path.relative_to(pictures)
        # Some file systems have no hard links: then there are two files.
        with suppress(OSError):
            if same.is_file() and not same.samefile(path):
                (linked := same.with_suffix(".linked")).hardlink_to(path)
                linked.replace(same)
