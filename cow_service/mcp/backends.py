"""Where the work of the tools is done: by a server that runs elsewhere, or by the service in this process."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import asynccontextmanager, suppress
from typing import TYPE_CHECKING, Any, TypeAlias

import anyio
import httpx
from anyio import to_thread
from mcp.server.lowlevel import Server

from cow_service.client import AsyncClient, CowError
from cow_service.client.settings import endpoint_of
from cow_service.errors import StorageUnavailable, Unauthorized
from cow_service.mcp.server import Caller
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
    async def lifespan(self, server: Server[Any]) -> AsyncGenerator[None]:
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
    async def lifespan(self, server: Server[Any]) -> AsyncGenerator[None]:
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
        await to_thread.run_sync(self._stop)

    def _start(self) -> FastAPI:
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

    Whoever started it owns the process and the data folder: keys and limits for others make no sense. It has to end
    soon after its standard input, before it is killed: unfinished jobs go on at the next start.
    """
    return settings.model_copy(
        update={"api_keys": {}, "rate_limit": None, "cors_origins": (), "host": "127.0.0.1", "shutdown_grace": 0.0}
    )


@asynccontextmanager
async def _client(url: str, caller: Caller, http: httpx.AsyncClient) -> AsyncGenerator[AsyncClient]:
    """A client with the caller's key, which stays open until jobs of canceled calls are canceled, too."""
    try:
        client = AsyncClient(url, api_key=caller.key, http_client=http)
    except ValueError as error:
        raise Unauthorized("The key holds characters that no key has.") from error
    try:
        yield client
    finally:
        # Shielded: in a canceled scope this await would end at once.
        with anyio.move_on_after(CANCEL_TIMEOUT_SECONDS, shield=True):
            await client.close()
