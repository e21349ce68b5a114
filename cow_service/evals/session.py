"""What every task of an evaluation shares: the server that it asks, and where its pictures are kept."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cow_service.client import AsyncClient
from cow_service.evals.imagination import Imagination
from cow_service.evals.layout import PICTURES, SERVER
from cow_service.evals.pictures import Pictures
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
