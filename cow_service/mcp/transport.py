"""Runs the tools of the Model Context Protocol: over stdio or HTTP, before a server or with the service in here."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
from collections.abc import AsyncGenerator, Awaitable, Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any, Protocol

import anyio
import httpx
import uvicorn
from anyio import to_thread
from mcp.server.lowlevel import Server
from mcp.server.stdio import stdio_server
from mcp.server.transport_security import TransportSecuritySettings

from cow_service.client import AsyncClient, CowError
from cow_service.client.settings import target_of
from cow_service.errors import StorageUnavailable, Unauthorized
from cow_service.mcp.server import Caller, Connect, create_server
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError

if TYPE_CHECKING:
    from fastapi import FastAPI

    from cow_service.jobs.engine import JobEngine

PATH = "/mcp"
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
WILDCARDS = ("0.0.0.0", "::", "")  # listen on every address of the machine, and are the name of none
BEYOND = 5.0  # seconds that open connections are given after running jobs had their time

log = logging.getLogger("cow_service")


class House(Protocol):
    """Where the work is done."""

    links: bool  # whether the addresses of artifacts can be opened by others

    def connect(self, caller: Caller) -> Any:
        """The way there for one call: an asynchronous context manager of an `AsyncClient`."""
        ...

    def lifespan(self, server: Server[Any]) -> Any:
        """Open while the tools are served."""
        ...

    async def close(self) -> None:
        """Lets go of everything; nothing where that was done."""
        ...


class Elsewhere:
    """A COW server that runs."""

    links = True

    def __init__(self, url: str) -> None:
        try:
            self._url = target_of(url, None, None).base_url
        except ValueError as error:  # also for COW_API_KEY
            raise SettingsError(f"Bad settings: {error}.") from error
        self._http: httpx.AsyncClient | None = None

    @asynccontextmanager
    async def connect(self, caller: Caller) -> AsyncGenerator[AsyncClient]:
        """See `House`."""
        assert self._http is not None
        yield _client(self._url, caller, self._http)

    @asynccontextmanager
    async def lifespan(self, server: Server[Any]) -> AsyncGenerator[None]:
        """See `House`."""
        self._http = httpx.AsyncClient(limits=httpx.Limits(max_connections=None))
        async with self._http:
            yield

    async def close(self) -> None:
        """See `House`."""


class Here:
    """The service in this process. It is opened beside the tools, which are served before that is done."""

    links = False

    def __init__(self, settings: Settings) -> None:
        self._service = Service(settings)
        self._engine: JobEngine | None = None
        self._opened: Future[FastAPI] | None = None

    @asynccontextmanager
    async def connect(self, caller: Caller) -> AsyncGenerator[AsyncClient]:
        """See `House`. The address of the caller goes along, for limits that go by it."""
        assert self._opened is not None
        # Shielded: a call that ends must not end the opening that others wait for.
        app: Any = await asyncio.shield(asyncio.wrap_future(self._opened))
        address = caller.address or ("127.0.0.1", 0)
        transport = httpx.ASGITransport(app, raise_app_exceptions=False, client=address)
        async with httpx.AsyncClient(transport=transport) as http:
            yield _client("http://cow", caller, http)

    @asynccontextmanager
    async def lifespan(self, server: Server[Any]) -> AsyncGenerator[None]:
        """See `House`."""
        thread = ThreadPoolExecutor(1, "cow-opening")
        self._opened = thread.submit(self._open)
        thread.shutdown(wait=False)
        try:
            yield
        finally:
            with anyio.CancelScope(shield=True):
                await self.close()

    async def close(self) -> None:
        """See `House`. Running jobs have the time that the settings say; what is not done goes on at the next start."""
        await to_thread.run_sync(self._close)

    def _open(self) -> FastAPI:
        # These take longer to import than all else: clients need not wait for them to see the tools.
        from cow_service.api.app import create_app  # noqa: PLC0415
        from cow_service.jobs.engine import JobEngine  # noqa: PLC0415
        from cow_service.observability import tracing  # noqa: PLC0415

        try:
            tracing.start()
            engine = JobEngine(self._service)
            engine.start()
        except SettingsError as error:
            log.error("%s", error)
            raise StorageUnavailable(f"The service cannot be started here: {error}") from error
        except CowError as error:
            log.error("%s: %s", error.code, error.detail)
            raise
        self._engine = engine
        try:
            self._service.check()
        except CowError as error:  # calls may name another reader or generator
            log.error("%s: %s", error.code, error.detail)
        return create_app(engine)

    def _close(self) -> None:
        from cow_service.observability import tracing  # noqa: PLC0415

        if self._opened is not None:
            with suppress(CowError):
                self._opened.result()
        engine, self._engine = self._engine, None
        if engine is not None:
            engine.close()
            self._service.close()
            tracing.stop()


def _client(url: str, caller: Caller, http: httpx.AsyncClient) -> AsyncClient:
    try:
        return AsyncClient(url, api_key=caller.key, http_client=http)
    except ValueError as error:
        raise Unauthorized("The key holds characters that no key has.") from error


def house_of(settings: Settings, url: str | None) -> House:
    """The server at a URL, else the service in this process. Raises `SettingsError`."""
    return Elsewhere(url) if url else Here(settings)


def for_its_owner(settings: Settings) -> Settings:
    """Settings of a service that one person starts for themselves, as a child of their own program.

    Whoever started it owns the process and the data folder: keys and limits for others make no sense. It has to be
    gone soon after its standard input, before it is killed: what is not done goes on at the next start.
    """
    return settings.model_copy(
        update={"api_keys": {}, "rate_limit": None, "cors_origins": (), "host": "127.0.0.1", "shutdown_grace": 0.0}
    )


def run_stdio(house: House) -> None:
    """Serves the program that started this process, until it closes standard input or sends a signal."""
    server = create_server(house.connect, house.lifespan, paths=True, links=house.links)

    async def served() -> None:
        async with stdio_server() as (read, write), anyio.create_task_group() as tasks:
            if sys.platform != "win32":
                tasks.start_soon(_leave_on_signal, house.close)
            await server.run(read, write, server.create_initialization_options())
            tasks.cancel_scope.cancel()

    anyio.run(served)


async def _leave_on_signal(close: Callable[[], Awaitable[None]]) -> None:
    with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
        async for number in signals:
            await close()
            os._exit(128 + number)  # the thread that reads standard input cannot be woken, and would be waited for


def run_http(house: House, settings: Settings, *, names: Sequence[str] = ()) -> None:
    """Serves at `settings.host` and `port`, until a signal ends it; `names` are others by which it may be asked."""
    # Another name is that of a proxy, and whoever stands before one is not known.
    connect = with_own_keys(house.connect, all_of_them=bool(names) or not is_local(settings.host))
    server = create_server(connect, house.lifespan, paths=False, links=house.links)
    app = server.streamable_http_app(
        streamable_http_path=PATH,
        host=settings.host,
        max_request_body_size=int(settings.max_body_mb * 1_000_000),
        transport_security=protection(settings.host, names),
    )
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=int(settings.shutdown_grace + BEYOND),
    )
    uvicorn.Server(config).run()


def with_own_keys(connect: Connect, *, all_of_them: bool) -> Connect:
    """The same way for callers from elsewhere, or all: COW_API_KEY is for whoever sits at this machine."""

    @asynccontextmanager
    async def connected(caller: Caller) -> AsyncGenerator[AsyncClient]:
        far = all_of_them or caller.forwarded
        if far and caller.key is None and os.environ.get("COW_API_KEY"):  # which the SDK would take instead
            raise Unauthorized("The request has no key. Send the header `Authorization: Bearer <key>`.")
        async with connect(caller) as client:
            yield client

    return connected


def is_local(host: str) -> bool:
    """Whether an address to listen on is reached from this machine alone."""
    from cow_service.api.middleware.origins import is_loopback  # noqa: PLC0415

    return is_loopback(host)


def protection(host: str, names: Sequence[str]) -> TransportSecuritySettings:
    """Under which names the tools may be asked, and by pages of which: a page may give its own name this address."""
    given = [socket.gethostname() if host in WILDCARDS else host, *names]
    bracketed = [f"[{name}]" if ":" in name and _is_ipv6(name) else name for name in given]
    hosts = [*dict.fromkeys([*LOOPBACK, *(name.lower() for name in bracketed)])]
    both = [form for name in hosts for form in (name, f"{name}:*")]
    return TransportSecuritySettings(
        enable_dns_rebinding_protection=True,
        allowed_hosts=both,
        allowed_origins=[f"{scheme}://{form}" for form in both for scheme in ("http", "https")],
    )


def _is_ipv6(name: str) -> bool:
    try:
        socket.inet_pton(socket.AF_INET6, name)
    except (OSError, ValueError):
        return False
    return True
