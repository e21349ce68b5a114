"""Where the work of the tools is done: by a server that runs elsewhere, or by the service in this process."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
from collections.abc import AsyncGenerator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from itertools import count
from typing import TYPE_CHECKING, Any, TypeAlias

import anyio
import httpx
import uvicorn
from mcp.server.stdio import stdio_server
from mcp.server.transport_security import TransportSecuritySettings

from cow_service.client import AsyncClient, CowError
from cow_service.client.protocol import endpoint_of
from cow_service.errors import StorageUnavailable, Unauthorized
from cow_service.mcp.server import Caller, Connect, create_server
from cow_service.service import Service
from cow_service.settings import Settings, SettingsError

if TYPE_CHECKING:
    from fastapi import FastAPI

    from cow_service.jobs.engine import JobEngine

CANCEL_TIMEOUT_SECONDS = 5.0  # for telling the server that a caller has left

log = logging.getLogger("cow_service")


class RemoteServer:
    """A COW server at a URL."""

    links = True  # others can open the addresses of its artifacts

    def __init__(self, url: str) -> None:
        try:
            self._url = endpoint_of(url, None, None).base_url
        except ValueError as error:  # also for COW_API_KEY
            raise SettingsError(f"Bad settings: {error}.") from error
        self._http: httpx.AsyncClient | None = None

    @asynccontextmanager
    async def connect(self, caller: Caller) -> AsyncGenerator[AsyncClient]:
        """A client for one call."""
        assert self._http is not None
        async with _client(self._url, caller, self._http) as client:
            yield client

    @asynccontextmanager
    async def lifespan(self, _: Any) -> AsyncGenerator[None]:
        """Open while the tools are served."""
        self._http = httpx.AsyncClient(limits=httpx.Limits(max_connections=None))
        async with self._http:
            yield

    async def close(self) -> None:
        """Nothing: the server goes on."""


class LocalService:
    """The service in this process. It starts in the background while the tools are served already."""

    links = False

    def __init__(self, settings: Settings) -> None:
        self._service = Service(settings)
        self._engine: JobEngine | None = None
        self._app: Future[FastAPI] | None = None

    @asynccontextmanager
    async def connect(self, caller: Caller) -> AsyncGenerator[AsyncClient]:
        """A client for one call. It has the caller's address, for limits that depend on it."""
        assert self._app is not None
        # Shielded: a call that ends must not end the start that others wait for.
        app: Any = await asyncio.shield(asyncio.wrap_future(self._app))
        address = caller.address or ("127.0.0.1", 0)
        transport = httpx.ASGITransport(app, raise_app_exceptions=False, client=address)
        async with httpx.AsyncClient(transport=transport) as http, _client("http://cow", caller, http) as client:
            yield client

    @asynccontextmanager
    async def lifespan(self, _: Any) -> AsyncGenerator[None]:
        """Open while the tools are served."""
        thread = ThreadPoolExecutor(1, "cow-start")
        self._app = thread.submit(self._start)
        thread.shutdown(wait=False)
        try:
            yield
        finally:
            with anyio.CancelScope(shield=True):
                await self.close()

    async def close(self) -> None:
        """Stops the service, after the grace period of the settings; unfinished jobs go on at the next start."""
        await anyio.to_thread.run_sync(self._stop)

    def _start(self) -> FastAPI:
        # These take longer to import than all else: clients need not wait for them to see the tools.
        from cow_service.api.app import create_app  # noqa: PLC0415
        from cow_service.observability import tracing  # noqa: PLC0415

        try:
            tracing.start()
            engine = self._start_engine()
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

    def _start_engine(self) -> JobEngine:
        """Agents start one of these each: where another process has the data folder, this one has a folder in it."""
        from cow_service.jobs.engine import JobEngine  # noqa: PLC0415
        from cow_service.jobs.sqlite import FolderHeld  # noqa: PLC0415

        given = self._service.settings
        for number in count(2):
            engine = JobEngine(self._service)
            try:
                engine.start()
            except FolderHeld:
                if given.database_url is not None or given.artifacts is not None:
                    raise
                own = {"data_dir": given.data_dir / f"beside-{number}", "models_dir": given.weights_dir}
                self._service.close()
                self._service = Service(given.model_copy(update=own))
            else:
                return engine
        raise AssertionError("numbers do not end")

    def _stop(self) -> None:
        from cow_service.observability import tracing  # noqa: PLC0415

        if self._app is not None:
            with suppress(CowError):
                self._app.result()
        engine, self._engine = self._engine, None
        if engine is not None:
            engine.close()
            self._service.close()
            tracing.stop()


Backend: TypeAlias = RemoteServer | LocalService


def backend_for(settings: Settings, url: str | None) -> Backend:
    """The server at a URL, else the service in this process. Raises `SettingsError`."""
    return RemoteServer(url) if url else LocalService(settings)


def for_its_owner(settings: Settings) -> Settings:
    """Settings of a service that one person starts for themselves, as a child of their own program.

    Its user owns the process and the data folder, so keys and limits for others make no sense. It has to end
    soon after its standard input, before it is killed: unfinished jobs go on at the next start.
    """
    return settings.model_copy(
        update={"api_keys": {}, "cors_origins": (), "host": "127.0.0.1", "shutdown_grace": 0.0}
        | dict.fromkeys(("rate_limit", "rate_limit_mb", "rate_limit_cpu"))
    )


@asynccontextmanager
async def _client(url: str, caller: Caller, http: httpx.AsyncClient) -> AsyncGenerator[AsyncClient]:
    """A client with the caller's key, which stays open until jobs of canceled calls are canceled, too."""
    try:
        client = AsyncClient(url, api_key=caller.key, http_client=http)
    except ValueError as error:
        raise Unauthorized("The key contains characters that are not allowed in keys.") from error
    try:
        yield client
    finally:
        # Shielded: in a canceled scope this await would end at once.
        with anyio.move_on_after(CANCEL_TIMEOUT_SECONDS, shield=True):
            await client.close()


PATH = "/mcp"
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
WILDCARDS = ("0.0.0.0", "::", "")  # listen on every address of the machine, and are the name of none
CLOSE_SECONDS = 5.0  # for open connections, after the grace period of running jobs


def run_stdio(backend: Backend) -> None:
    """Serves the program that started this process, until it closes standard input or sends a signal."""
    server = create_server(backend.connect, backend.lifespan, paths=True, links=backend.links)

    async def exit_on_signal() -> None:
        with anyio.open_signal_receiver(signal.SIGINT, signal.SIGTERM) as signals:
            async for number in signals:
                await backend.close()
                # The thread that reads standard input cannot be woken, and would be waited for.
                os._exit(0 if number == signal.SIGTERM else 128 + number)

    async def serve() -> None:
        async with stdio_server() as (read, write), anyio.create_task_group() as tasks:
            if sys.platform != "win32":
                tasks.start_soon(exit_on_signal)
            await server.run(read, write, server.create_initialization_options())
            tasks.cancel_scope.cancel()

    anyio.run(serve)


def run_http(backend: Backend, settings: Settings, *, names: Sequence[str] = ()) -> None:
    """Serves at `settings.host` and `port`, until a signal ends it; `names` are further allowed host names."""
    from cow_service.api.middleware.access import is_loopback  # noqa: PLC0415

    # Another name is that of a proxy, and nothing is known of the callers of a proxy.
    connect = with_own_keys(backend.connect, everybody=bool(names) or not is_loopback(settings.host))
    server = create_server(connect, backend.lifespan, paths=False, links=backend.links)
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
        timeout_graceful_shutdown=int(settings.shutdown_grace + CLOSE_SECONDS),
    )
    uvicorn.Server(config).run()


def with_own_keys(connect: Connect, *, everybody: bool) -> Connect:
    """The same `connect`, which refuses remote callers without a key, or everybody without one.

    The SDK would use COW_API_KEY instead, which is for callers on this machine.
    """

    @asynccontextmanager
    async def connected(caller: Caller) -> AsyncGenerator[AsyncClient]:
        if (everybody or caller.forwarded) and caller.key is None and os.environ.get("COW_API_KEY"):
            raise Unauthorized("The request has no key. Send the header `Authorization: Bearer <key>`.")
        async with connect(caller) as client:
            yield client

    return connected


def protection(host: str, names: Sequence[str]) -> TransportSecuritySettings:
    """The allowed `Host` and `Origin` headers: a page may give its own name this address (DNS rebinding)."""
    given = [socket.gethostname() if host in WILDCARDS else host, *names]
    hosts = dict.fromkeys([*LOOPBACK, *(f"[{name}]" if name.count(":") > 1 else name.lower() for name in given)])
    both = [form for name in hosts for form in (name, f"{name}:*")]
    return TransportSecuritySettings(
        enable_dns_rebinding_protection=True,
        allowed_hosts=both,
        allowed_origins=[f"{scheme}://{form}" for form in both for scheme in ("http", "https")],
    )
